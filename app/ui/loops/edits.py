"""The user's word on a loop: proposed first, shown as a ghost, then committed or not; undo, redo, files."""

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Command, EditLoop, RedoLoop, Snapshot, TryLoop, UndoLoop
from app.slam.errors import HemislamError
from app.slam.loops import edit_files
from app.slam.loops.types import Accept, LoopEdge, LoopEdit, Pair, Preview, Reject, SetWeight, Solve, Verdict
from app.ui.html import box
from app.ui.loops.kinds import say
from app.ui.loops.overlay import Ghost
from app.ui.loops.words import forecast, headline
from app.ui.widgets import by_user, show, unchanged

_REST_S: Final = 0.3


class Proposal:
    """What would change by the command that is being considered, with Commit and Cancel."""

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        send: Callable[[Command], None],
        snapshot: Callable[[], Snapshot],
        committed: Callable[[LoopEdit], None],
    ) -> None:
        gui = server.gui
        self._send, self._snapshot, self._committed = send, snapshot, committed
        self._ghost = Ghost(server.scene, root)
        self._folder = gui.add_folder("Before you decide", visible=False)
        with self._folder:
            self._words = gui.add_html("")
            self._commit = gui.add_button("Commit", icon=viser.Icon.CHECK)
            cancel = gui.add_button("Cancel", icon=viser.Icon.X, color="gray")
        self.command: LoopEdit | None = None
        self._last_notice = 0
        self._told: tuple[object, ...] = ()
        self._commit.on_click(by_user(lambda _, __: self.commit()))
        cancel.on_click(by_user(lambda _, __: self.cancel()))

    def propose(self, command: LoopEdit) -> None:
        """Ask the engine what it would change."""
        notices = self._snapshot().notices
        self._last_notice = notices[-1].number if notices else 0
        self.command = command
        self._send(TryLoop(command))

    def commit(self) -> None:
        """Do it."""
        command, self.command = self.command, None
        if command is not None:
            self._send(EditLoop(command))
            self._send(TryLoop(None))
            self._committed(command)

    def cancel(self) -> None:
        """Leave it."""
        if self.command is not None:
            self.command = None
            self._send(TryLoop(None))

    def draw(self, snapshot: Snapshot) -> None:
        """Panel and ghost; called by the drawing thread, often."""
        command, tried = self.command, snapshot.loops.tried
        preview = tried[1] if tried is not None and tried[0] == command else None
        poses = snapshot.keyframe_poses if snapshot.keyframe_poses is not None else np.empty((0, 4, 4))
        self._ghost.draw(preview.poses if command is not None and preview is not None else None, poses)
        problem = self._problem(snapshot) if preview is None else ""
        told = (command, preview, snapshot.loops.residuals, problem)
        if unchanged(self._told, told):
            return
        self._told = told
        self._folder.visible = command is not None
        if command is not None:
            self._commit.disabled = preview is None
            self._words.content = self._forecast(command, preview, poses, snapshot, problem)

    def _forecast(
        self, command: LoopEdit, preview: Preview | None, poses: Any, snapshot: Snapshot, problem: str
    ) -> str:
        return forecast(command, preview, poses, snapshot.loops.residuals, problem)

    def _problem(self, snapshot: Snapshot) -> str:
        """What the engine had to say against it since it was proposed."""
        told = [n.text for n in snapshot.notices if n.number > self._last_notice and n.level == "error"]
        return told[-1] if told else ""


class VerdictPanel:
    """Accept, reject and weight of the chosen loop."""

    def __init__(
        self, gui: viser.GuiApi, propose: Callable[[LoopEdit], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._propose, self._now = propose, now
        self._pair: Pair | None = None
        self._dragged: tuple[float, float] | None = None
        self._headline = gui.add_html("")
        self._accept = gui.add_button("Accept it …", icon=viser.Icon.THUMB_UP, color="teal")
        self._reject = gui.add_button("Reject it …", icon=viser.Icon.THUMB_DOWN, color="red")
        self._weight = gui.add_slider(
            "weight", 0.1, 10.0, 0.1, 1.0, hint="Divides its covariance in the graph; 1 is what registration said."
        )
        self._accept.on_click(by_user(lambda _, __: self._say(Accept)))
        self._reject.on_click(by_user(lambda _, __: self._say(Reject)))
        self._weight.on_update(by_user(self._drag))

    def draw(self, edge: LoopEdge | None, weighing: float | None) -> None:
        """Show how the loop stands. weighing: the weight that is being considered."""
        self._pair = edge.pair if edge is not None else None
        if edge is None:
            self._dragged = None
            return
        self._headline.content = headline(edge)
        self._accept.visible = edge.verdict is not Verdict.ACCEPTED
        self._reject.visible = edge.verdict is not Verdict.REJECTED
        self._weight.disabled = edge.verdict is not Verdict.ACCEPTED
        dragged = self._dragged
        if dragged is None:
            value = edge.weight if weighing is None else weighing
            show(self._weight, min(max(value, 0.1), 10.0))
        elif self._now() - dragged[1] >= _REST_S:
            self._dragged = None
            self._propose(SetWeight(edge.older, edge.newer, dragged[0]))

    def _drag(self, weight: float, _: Any) -> None:
        self._dragged = (weight, self._now())

    def _say(self, verb: type[Accept] | type[Reject]) -> None:
        if self._pair is not None:
            self._propose(verb(*self._pair))


class SolvePanel:
    """All factors solved at once, on request."""

    def __init__(self, gui: viser.GuiApi, propose: Callable[[LoopEdit], None]) -> None:
        self._button = gui.add_button(
            "Solve all at once …",
            icon=viser.Icon.MATH_FUNCTION,
            color="gray",
            hint="Levenberg-Marquardt over all factors, instead of one keyframe after the other; first see what it"
            " would change.",
        )
        self._where = gui.add_html(
            box("What it would change stands further up, under <b>Before you decide</b>."), visible=False
        )
        self._button.on_click(by_user(lambda _, __: propose(Solve())))

    def draw(self, snapshot: Snapshot, considered: bool) -> None:
        """Nothing to ask for where it is so already, or where there is no loop. considered: it is being decided."""
        loops = snapshot.loops
        self._where.visible = considered
        self._button.disabled = Solve() in loops.undo or not any(edge.counts for edge in loops.edges)


class EditsPanel:
    """Undo, redo, and the list of edits as a file."""

    def __init__(self, gui: viser.GuiApi, send: Callable[[Command], None], snapshot: Callable[[], Snapshot]) -> None:
        self._send, self._snapshot = send, snapshot
        self._undo = gui.add_button("Undo", icon=viser.Icon.ARROW_BACK_UP, color="gray", hint="Ctrl Z")
        self._redo = gui.add_button("Redo", icon=viser.Icon.ARROW_FORWARD_UP, color="gray", hint="Ctrl Shift Z")
        self._save = gui.add_button(
            "Save edits", icon=viser.Icon.DOWNLOAD, color="gray", hint="As edits.yaml for `hemislam run --loops`."
        )
        load = gui.add_upload_button(
            "Load edits …", icon=viser.Icon.UPLOAD, color="gray", mime_type=".yaml,.yml,text/*"
        )
        self._undo.on_click(by_user(lambda _, __: send(UndoLoop())))
        self._redo.on_click(by_user(lambda _, __: send(RedoLoop())))
        self._save.on_click(by_user(lambda _, client: self._download(client)))
        load.on_upload(lambda event: self._load(event.target.value.content, event.client))
        gui.add_command("Undo the last edit of a loop", hotkey="Z", modifier="cmd/ctrl").on_trigger(
            lambda _: send(UndoLoop())
        )
        gui.add_command("Redo the edit undone last", hotkey="Z", modifier="cmd/ctrl+shift").on_trigger(
            lambda _: send(RedoLoop())
        )

    def draw(self, snapshot: Snapshot) -> None:
        """Say what would be undone and redone."""
        for button, verb, commands in (
            (self._undo, "Undo", snapshot.loops.undo),
            (self._redo, "Redo", snapshot.loops.redo),
        ):
            label = f"{verb}: {say(commands[-1])}" if commands else verb
            if button.label != label:
                button.label = label
            button.disabled = not commands
        count = len(snapshot.loops.undo)
        label = f"Save edits ({count})" if count else "Save edits"
        if self._save.label != label:
            self._save.label = label
        self._save.disabled = not count

    def _download(self, client: viser.ClientHandle) -> None:
        text = edit_files.write(self._snapshot().loops.undo)
        client.send_file_download("edits.yaml", text.encode(), save_immediately=True)

    def _load(self, content: bytes, client: viser.ClientHandle | None) -> None:
        try:
            commands = edit_files.read(content.decode(errors="replace"), "The file")
        except HemislamError as error:
            if client is not None:
                client.add_notification("Error", str(error), color="red", auto_close_seconds=None)
            return
        for command in commands:
            self._send(EditLoop(command))
