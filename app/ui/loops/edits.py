"""Editing loops: the effect of an edit, before and after, shown as a ghost trajectory; undo, redo, files."""

from collections.abc import Callable
from typing import Final

import numpy as np
import viser

from app.server.protocol import EditLoop, RedoLoop, Snapshot, TryLoop, UndoLoop
from app.slam.loops import edit_files
from app.slam.loops.edits import Accept, LoopEdit, Reject, SetWeight
from app.slam.loops.types import LoopEdge, Pair, Preview, Verdict
from app.slam.types import F64
from app.ui.colours import Rgb
from app.ui.html import panel
from app.ui.loops.words import BRIDGE, describe_edit, forecast, kind_of, what_happened, what_was_undone
from app.ui.nodes import add_lines, clear, segments
from app.ui.widgets import ROOT, Changes, Edit, Page, add_button, add_command, as_set, by_user, show

_REST_S: Final = 0.3
_GHOST: Final[dict[bool, Rgb]] = {False: (255, 232, 70), True: (120, 90, 0)}
"""Yellow on a dark and on a light background: for every kind of colour vision unlike the path and edited loops."""
_STICK: Final[Rgb] = (150, 140, 100)
_LEAST_SHIFT_M: Final = 0.005
_SEEN: Final = 0.03
"""Shifts are enlarged until the largest is nearly this share of the walk's extent: to scale, few would be visible."""


def enlarged(shifts: F64, extent: float) -> int:
    """Factor 1, 2, 5, 10 … 100 by which (k, 3) shifts (m) are drawn on a walk of this extent (m); 0: too small."""
    largest = float(np.linalg.norm(shifts, axis=1).max(initial=0.0))
    if largest < _LEAST_SHIFT_M:
        return 0
    return max((times for times in (1, 2, 5, 10, 20, 50, 100) if times * largest <= _SEEN * extent), default=1)


class Ghost:
    """The trajectory that an edit would produce, or the one before an edit, tied by lines to the present one.

    Attributes:
        key: colour and name for the legend; empty while nothing is drawn.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self.key: list[tuple[Rgb, str]] = []
        self._nodes: list[viser.LineSegmentsHandle] = []
        self._changes = Changes()

    def draw(self, other: F64 | None, present: F64, name: str, light: bool) -> None:
        """Show (k, 4, 4) poses beside the present ones, with enlarged shifts; None removes them."""
        if not self._changes(other, present if other is not None else None, name, light):
            return
        clear(self._nodes)
        self.key = []
        if other is None or min(len(other), len(present)) < 2:
            return
        here, there = present[: len(other), :3, 3], other[: len(present), :3, 3]
        times = enlarged(there - here, float(np.linalg.norm(np.ptp(here, axis=0))))
        if times:
            there = here + times * (there - here)
            sticks, root = np.stack((here, there), axis=1).astype(np.float32), f"{ROOT}/ghost"
            self._nodes.append(add_lines(self._scene, f"{root}/path", segments(there), _GHOST[light], 3.0))
            self._nodes.append(add_lines(self._scene, f"{root}/moves", sticks, _STICK, 1.0))
            self.key = [(_GHOST[light], name + (f", shift × {times}" if times > 1 else ""))]


def decided(command: LoopEdit) -> Pair | None:
    """The loop whose verdict the edit decides; None for another kind of edit."""
    return command.pair if isinstance(command, Accept | Reject) else None


class Proposal:
    """The effect that a proposed edit would have, with Apply and Cancel; then its actual effect, with Undo.

    Attributes:
        command: the proposed edit. preview: the engine's answer on it, or on an edit that is only previewed.
        ghost: the trajectory beside the present one.
        last: the last applied edit, until it is undone or another edit follows.
        happened: HTML that says what the last edit, undo or redo did. about: the loop whose verdict it changed.
    """

    def __init__(self, page: Page, applied: Callable[[LoopEdit], None]) -> None:
        gui = page.gui
        self._send, self._snapshot, self._applied = page.send, page.snapshot, applied
        self.ghost = Ghost(page.scene)
        self._folder = gui.add_folder("Before you decide", visible=False)
        with self._folder:
            self._words = gui.add_html("")
            self._apply = add_button(gui, "Apply", lambda _: self.apply(self.command), viser.Icon.CHECK, color=None)
            add_button(gui, "Cancel", lambda _: self.cancel(), viser.Icon.X)
        self._done = gui.add_folder("Last edit", visible=False)
        with self._done:
            self._happened = gui.add_html("")
            self._undo = _undo_button(page)
        self.command: LoopEdit | None = None
        self.preview: Preview | None = None
        self._asked: tuple[LoopEdit | None, object] = None, None  # the edit tried, and the loops then
        self.last: LoopEdit | None = None
        self.happened = ""
        self.about: Pair | None = None
        self._before: F64 | None = None  # poses before it, until another loop is chosen
        self._after: tuple[LoopEdge, ...] | None = None  # the loops with it, once a snapshot has them
        self._seen = Snapshot()
        self._last_notice = 0
        self._changes = Changes()

    def propose(self, command: LoopEdit) -> None:
        self._last_notice = self._snapshot().last_notice
        self.command, self.last, self._before, self.happened = command, None, None, ""

    def apply(self, command: LoopEdit | None) -> None:
        if command is None:
            return
        self.command, self.last, self._after = None, command, None
        self._before = self._snapshot().keyframe_poses
        self._send(EditLoop(command))
        self._applied(command)

    def cancel(self) -> None:
        self.command = self._before = None
        if self.last is None:
            self.happened = ""

    def see(self, snapshot: Snapshot) -> None:
        """Record the effect of the last edit once the snapshot contains it, or of an undo or redo."""
        seen, self._seen = self._seen, snapshot
        edits, now, before, poses = seen.loops.undo, snapshot.loops.undo, seen.keyframe_poses, snapshot.keyframe_poses
        last = self.last
        if last is not None and self._after is None and now[-1:] == (last,):
            self._after = snapshot.loops.edges
            self.happened, self.about = what_happened(last, before, poses), decided(last)
        elif edits and now == edits[:-1] and snapshot.session == seen.session:
            self.last = self._before = None
            self.happened = what_was_undone(edits[-1], snapshot.loops.edges, before, poses)
            self.about = decided(edits[-1])
        elif seen.loops.redo and now == (*edits, seen.loops.redo[-1]):
            self.happened, self.about = what_happened(now[-1], before, poses), decided(now[-1])
        elif last is not None and self._after is not None and now[-1:] != (last,):
            self.last, self.happened = None, ""

    def draw(self, snapshot: Snapshot, looked_at: LoopEdit | None, chosen: Pair | None, light: bool) -> None:
        """Show the proposed edit and the last applied one.

        Args:
            looked_at: an edit to preview while none is proposed.
            chosen: the loop for which `VerdictPanel` shows what happened. light: a light background.
        """
        self._done.visible = bool(self.happened) and (self.about is None or self.about != chosen)
        self._undo.visible = self.last is not None
        if self._done.visible:
            self._happened.content = self.happened + panel("into_view")
        command, loops, poses = self.command, snapshot.loops, snapshot.keyframe_poses
        shown = command or looked_at
        asked = shown, loops.edges if shown is not None else None
        if asked[0] != self._asked[0] or asked[1] is not self._asked[1]:
            self._asked = asked
            self._send(TryLoop(shown))
        preview = self.preview = (
            loops.tried[1] if shown is not None and loops.tried and loops.tried[0] == shown else None
        )
        if self.last is not None and self._before is not None:
            self.ghost.draw(self._before if loops.edges is self._after else None, poses, "path before the edit", light)
        else:
            name = f"path if you {describe_edit(shown)}" if shown is not None else ""
            self.ghost.draw(preview.poses if preview is not None else None, poses, name, light)
        problem = self._problem(snapshot) if preview is None else ""
        if not self._changes(command, preview, snapshot.loops.residuals, problem):
            return
        self._folder.visible = command is not None
        if command is not None:
            self._apply.disabled = preview is None
            words = forecast(command, preview, poses, snapshot.loops.residuals, problem)
            self._words.content = words + panel("into_view")

    def _problem(self, snapshot: Snapshot) -> str:
        """The engine's newest error since the edit was proposed."""
        errors = [n.text for n in snapshot.notices if n.number > self._last_notice and n.level == "error"]
        return errors[-1] if errors else ""


class VerdictPanel:
    """Buttons to accept or reject the chosen loop, and its weight.

    Args:
        apply: applies an edit at once; Undo reverts it. propose: first shows what an edit would change.
    """

    def __init__(self, page: Page, apply: Callable[[LoopEdit], None], propose: Callable[[LoopEdit], None]) -> None:
        gui = page.gui
        self._apply, self._propose, self._now = apply, propose, page.now
        self._pair: Pair | None = None
        self._dragged: Edit | None = None
        self._headline = gui.add_html("")
        hint = "Add it to the graph now, as a factor of its own; Undo reverts this."
        self._accept = add_button(
            gui, "Accept it", lambda _: self._decide(Accept), viser.Icon.THUMB_UP, color="teal", hint=hint
        )
        hint = "Remove it from the graph now; Undo restores it."
        self._reject = add_button(
            gui, "Reject it", lambda _: self._decide(Reject), viser.Icon.THUMB_DOWN, color="red", hint=hint
        )
        # In the same place, so that it is under the mouse. Accepting again would add the loop as a factor of its own.
        self._undo = _undo_button(page)
        self._reason = gui.add_html("")
        self._words = gui.add_html("")
        self._weight = gui.add_slider(
            "weight",
            0.1,
            10.0,
            0.1,
            1.0,
            hint="Divides the covariance of the loop in the graph; 1 keeps it as registered.",
        )
        self._weight.on_update(as_set(lambda weight, _: self._drag(weight)))

    def draw(self, edge: LoopEdge | None, weighing: float | None, words: str, undo: bool) -> None:
        """Show the loop's verdict.

        Args:
            weighing: the proposed weight. words: what the last edit did, or what the other verdict would do.
            undo: whether the verdict was the last edit, so that Undo reverts it.
        """
        self._pair = edge.pair if edge is not None else None
        if edge is None:
            self._dragged = None
            return
        colour = kind_of(edge).colour
        self._headline.content = panel("loops.headline", edge, colour)
        self._reason.content = panel("bridged", BRIDGE, panel("loops.reason", edge, colour))
        self._words.content = words
        self._undo.visible = undo
        self._accept.visible = not undo and edge.verdict is not Verdict.ACCEPTED
        self._reject.visible = not undo and edge.verdict is not Verdict.REJECTED
        self._weight.disabled = edge.verdict is not Verdict.ACCEPTED
        dragged = self._dragged
        if dragged is None:
            value = edge.weight if weighing is None else weighing
            show(self._weight, min(max(value, 0.1), 10.0))
        elif self._now() - dragged.at >= _REST_S:
            self._dragged = None
            self._propose(SetWeight(edge.older, edge.newer, dragged.value))

    def _drag(self, weight: float) -> None:
        self._dragged = Edit(weight, self._now())

    def _decide(self, verb: type[Accept] | type[Reject]) -> None:
        if self._pair is not None:
            self._apply(verb(*self._pair))


def _undo_button(page: Page) -> viser.GuiButtonHandle:
    return add_button(page.gui, "Undo", lambda _: page.send(UndoLoop()), viser.Icon.ARROW_BACK_UP, hint="Ctrl Z")


class EditsPanel:
    """Undo, redo, and the list of edits as a file."""

    def __init__(self, page: Page) -> None:
        gui, send = page.gui, page.send
        self._send, self._snapshot = send, page.snapshot
        self._undo = _undo_button(page)
        self._redo = add_button(
            gui, "Redo", lambda _: send(RedoLoop()), viser.Icon.ARROW_FORWARD_UP, hint="Ctrl Shift Z"
        )
        hint = "As edits.yaml for `hemislam run --loops`."
        self._save = add_button(gui, "Save edits", self._download, viser.Icon.DOWNLOAD, hint=hint)
        load = gui.add_upload_button("Load edits…", icon=viser.Icon.UPLOAD, color="gray", mime_type=".yaml,.yml,text/*")
        load.on_upload(by_user(lambda file, _: self._load(file.content)))
        undo, redo = (lambda _: send(UndoLoop())), (lambda _: send(RedoLoop()))
        add_command(gui, "Undo the last loop edit", undo, hotkey="Z", modifier="cmd/ctrl")
        add_command(gui, "Redo the last undone loop edit", redo, hotkey="Z", modifier="cmd/ctrl+shift")

    def draw(self, snapshot: Snapshot) -> None:
        for button, verb, commands in (
            (self._undo, "Undo", snapshot.loops.undo),
            (self._redo, "Redo", snapshot.loops.redo),
        ):
            label = f"{verb}: {describe_edit(commands[-1])}" if commands else verb
            button.label = label
            button.disabled = not commands
        count = len(snapshot.loops.undo)
        self._save.label = f"Save edits ({count})" if count else "Save edits"
        self._save.disabled = not count

    def _download(self, client: viser.ClientHandle) -> None:
        text = edit_files.write(self._snapshot().loops.undo)
        client.send_file_download("edits.yaml", text.encode(), save_immediately=True)

    def _load(self, content: bytes) -> None:
        for command in edit_files.read(content.decode(errors="replace"), "The file"):
            self._send(EditLoop(command))
