"""The work of the engine's process: takes commands, does one piece of work at a time, and publishes changes."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import NOTHING_KEPT, Kept
from app.mapping.session import EFFECT, Session
from app.mapping.session_file import SUFFIX, SavedSession, SessionWriter, State, new_path, read_session
from app.server import protocol
from app.server.georeferencing import Georeferencing
from app.server.keeping import KeptCommand, changed
from app.server.loop_commands import LoopCommands
from app.server.player import Player
from app.server.protocol import Command
from app.server.publisher import Publisher, opened_recording
from app.slam.errors import HemislamError
from app.slam.loops.edits import Edits
from app.slam.params import Params

log = logging.getLogger(__name__)

_OF_THE_DEVICE = ("recording.", "sensor.")
POLL_S = 0.02
"""s between two checks for results of other threads and processes."""
_AT_ONCE = protocol.OpenRecording | protocol.Restart | protocol.SetSpeed | protocol.SetBreakpoints
"""Commands that do not wait while a session is being opened."""
_FOR_THE_FRAME = (
    protocol.LoopCommand
    | KeptCommand
    | protocol.EditLabels
    | protocol.UndoLabels
    | protocol.Georeference
    | protocol.CompareWith
    | protocol.Save
)
"""Commands that wait until a reopened session has reached its frame."""


OpenSession = Callable[[Path, Path | None, Params, tuple[float, float | None] | None], Session]
"""Opens a recording with its truth and parameters, or a part (start, duration; s) of it. Raises HemislamError."""


class Controller:
    """The open session and its transport. One thread calls `handle` and `work`.

    Args:
        page: receives all changes. params: initial parameters.
        resolve: returns the parameters of a recording, before the user's changes; None: use the present ones.
        session_folder: for session files; None: write none. kept: user data of a live session that another process
            began. clock: monotonic seconds.
    """

    def __init__(
        self,
        page: Publisher,
        params: Params,
        open_session: OpenSession,
        *,
        resolve: Callable[[Path], Params] | None = None,
        session_folder: Path | None = None,
        kept: Kept = NOTHING_KEPT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._page = page
        self._loops, self._player, self._writer = LoopCommands(page), Player(page, clock), SessionWriter()
        self._georeferencing = Georeferencing(page)
        self._saves: deque[tuple[protocol.Save, Future[Any]]] = deque()
        self._share = 0.0  # share of the running save
        self._shown_share: protocol.Progress | None = None
        self._open_session, self._resolve, self._session_folder = open_session, resolve, session_folder
        self._params = self._base = params  # with and without the user's changes
        self._kept = kept
        self._resuming: SavedSession | None = None  # the session that is being repeated
        self._opening: tuple[protocol.Progress, Callable[[], None]] | None = None  # opens the next session
        self._waiting: list[Command] = []  # until that session has reached its frame
        self._of_before = 0  # how many of these already waited when another session was requested

    def open(self, path: Path, truth: Path | None, *, play: bool = False) -> None:
        """Open a recording with exactly the present parameters, or a session file with its own parameters."""

        def opening() -> None:
            self._open(path, truth, self._params)
            self._page.show(playing=play)

        self._open_soon(path, opening)

    # --- commands --------------------------------------------------------------------------------
    def handle(self, command: Command) -> None:
        """Carry out a command. If that is impossible, publish a notice; nothing is raised."""
        opening = self._opening is not None and not isinstance(command, _AT_ONCE)
        if opening or (self._resuming is not None and isinstance(command, _FOR_THE_FRAME)):
            self._waiting.append(command)
            return
        try:
            self._handle(command)
        except HemislamError as error:
            self._page.notice("error", str(error))

    def _handle(self, command: Command) -> None:
        match command:
            case protocol.Play():
                session = self._need_session()
                if session.ended:
                    self._handle(protocol.Seek(0) if session.feed.repeatable else protocol.Restart())
                self._player.play()
            case protocol.Pause():
                self._player.halt()
            case protocol.StepFrame(frames):
                self._player.step(self._need_session(), frames)
            case protocol.SetSpeed(factor):
                self._player.set_speed(factor)
            case protocol.Seek(frame):
                self._player.seek(self._need_session(), frame)
            case protocol.SetBreakpoints(breakpoints):
                self._set_breakpoints(breakpoints)
            case KeptCommand():
                self._keep(changed(self._kept, command, self._need_session().frame))
            case protocol.Georeference(survey):
                self._georeferencing.choose(self._need_session(), survey)
            case protocol.SetParams(values):
                self._set_params(self._params.with_values(values))
            case protocol.LoadParams(text):
                self._set_params(Params().merged_yaml(text))
            case protocol.OpenRecording(path, truth):
                self._open_soon(path, lambda: self._open(path, truth))
            case protocol.CompareWith(trajectory):
                self._need_session().compare_with(trajectory)
                self._page.put(recording=opened_recording(self._need_session()), urgent=True)
            case protocol.Calibrated(text):
                self._need_session().calibration = text
                if text:
                    self._page.notice("warning", text)
            case protocol.Restart(stay):
                self._open_soon(self._need_session().feed.info.path, lambda: self._reopen(stay))
            case protocol.Save(folder, formats, choice):
                session = self._need_session()
                saved = session.saved(self._state(session))
                save = session.save(folder, session=saved, formats=formats, choice=choice, progress=self._set_share)
                self._saves.append((command, save))
            case protocol.EditLabels(keyframe, labels):
                self._need_session().keyframes.edit(keyframe, labels)
                self._page.show_again(keyframe)
            case protocol.UndoLabels():
                self._page.show_again(self._need_session().keyframes.undo())
            case protocol.LoopCommand():
                loops = self._need_session().loops
                if loops is None:
                    raise HemislamError("The loop search is off; set loops.enabled and restart.")
                self._loops.handle(command, loops)

    def relabel(self) -> None:
        """Relabel the frame if ground parameters changed, so that the page gets both together and draws once."""
        if self._opening is None:
            self._player.relabel()

    def _set_params(self, params: Params) -> None:
        changed = self._params.changed(params)
        self._params = params
        if self._player.session is not None:
            self._player.session.choose(params)
            self._player.relabelling |= any(EFFECT[path] == "now" for path in changed)
        self._show_params()

    def _set_breakpoints(self, breakpoints: Breakpoints) -> None:
        self._player.breakpoints = breakpoints
        self._page.put(breakpoints=breakpoints, urgent=True)

    def _set_share(self, share: float) -> None:
        """Store the progress; called by the saving thread, and shown by `work`."""
        self._share = share

    def _show_share(self, share: float | None) -> None:
        """Show the progress of a save, in steps of 1 %; None: it has ended. Opening waits for the save."""
        shown = self._opening[0] if self._opening is not None else None
        if share is not None:
            then = f", then {shown.title[0].lower()}{shown.title[1:]}" if shown is not None else ""
            shown = protocol.Progress(f"Saving{then}", math.floor(share * 100) / 100)
        if shown != self._shown_share:
            self._shown_share = shown
            self._page.put(progress=shown, urgent=True)

    def _keep(self, kept: Kept) -> None:
        before, self._kept = self._kept.kept(), kept
        others = {name: value for name, value in kept.kept().items() if value is not before[name]}
        self._page.put(**others, urgent=bool(others))

    def _show_params(self) -> None:
        session = self._player.session
        pending = tuple(session.params.changed(self._params)) if session is not None else ()
        self._page.put(params=self._params, pending_restart=pending, urgent=True)

    def _need_session(self) -> Session:
        if (session := self._player.session) is None:
            raise HemislamError("No recording is open; open one first.")
        return session

    # --- work ------------------------------------------------------------------------------------
    def work(self) -> float | None:
        """Do the next piece of work. Returns seconds until more is due; None: not before the next command."""
        wait = self._work()
        session = self._player.session
        if session is not None and self._resuming is None:
            self._write(session.saved(self._state(session)))
        return wait

    def _write(self, saved: SavedSession) -> None:
        """Write to the session file. Say so once it cannot be written any more."""
        path = self._writer.path
        self._writer.write(saved.frame, saved.state, ended=saved.ended, known=saved.known)
        if self._writer.path != path:
            self._page.put(session_file=None)
            self._page.notice("warning", self._writer.error)

    def _work(self) -> float | None:
        saving = bool(self._saves)
        while self._saves and self._saves[0][1].done():
            command, save = self._saves.popleft()
            self._share = 0.0
            error = save.exception()
            mendable = error is None or isinstance(error, HemislamError)
            if not mendable:
                log.error("Saving to %s failed", command.folder, exc_info=error)
            self._show_share(None)
            why = "" if error is None else str(error) or type(error).__name__
            self._page.saved(protocol.Saved(command.folder, why, command.fetched, mendable))
        if self._saves:
            self._show_share(self._share)
        if self._opening is not None and saving:
            return POLL_S if self._saves else 0.0  # first let the page show the opening
        if self._opening is not None:
            self._do_opening(self._opening[1])
            return 0.0
        wait, session = self._player.work(), self._player.session
        if session is None:
            return wait
        if (saved := self._resuming) is not None:
            arrived = session.frame >= saved.frame and not saved.ended
            if arrived or session.ended or session.heading < saved.frame:  # reached it, or the user went elsewhere
                self._resuming = None
                self._player.settle_labels(session)
                self._handle_waiting()
        loops = self._loops.update(session, show=not self._player.page_behind)
        labelled = session.keyframes.find_moving(last=self._player.still or session.ended)
        if labelled is not None and labelled[1]:
            self._page.show_again(labelled[0], urgent=False)
        at_work = self._resuming is None and self._georeferencing.update(session, still=self._player.still)
        poll = POLL_S if self._saves or loops or at_work else None
        waits = [wait, poll, 0.0 if labelled else None, self._player.look_at_source(session)]
        return min((seconds for seconds in waits if seconds is not None), default=None)

    def _state(self, session: Session) -> State:
        return State(
            params=self._params,
            history=session.history,
            edits=session.edits.done,
            undone=session.edits.undone,
            truth=session.truth_path,
            survey=session.survey,
            breakpoints=self._player.breakpoints,
            speed=self._page.transport.speed,
            labels=session.keyframes.edits,
            calibration=session.calibration,
            **self._kept.kept(),
        )

    # --- opening ---------------------------------------------------------------------------------
    def _open_soon(self, path: Path, opening: Callable[[], None]) -> None:
        """Let `work` open it later, so that the page can first show the progress."""
        self._opening, self._of_before = (protocol.Progress.opening(path), opening), len(self._waiting)
        self._page.put(progress=self._opening[0], urgent=True)

    def _do_opening(self, opening: Callable[[], None]) -> None:
        """Open the recording; if that is impossible, everything stays unchanged."""
        self._opening = None
        try:
            opening()
        except HemislamError as error:
            self._page.notice("error", str(error))
        except Exception as error:
            self._player.fail("The recording cannot be opened", error)
        self._page.put(progress=None, urgent=True)
        self._handle_waiting()

    def _open(self, path: Path, truth: Path | None, base: Params | None = None) -> None:
        """Open a session file, or a recording with its own parameters (or `base`) and the user's changes.

        Changes that describe the device apply only to the recording that they were made for.
        """
        if path.suffix == SUFFIX:
            self._resume(path)
            return
        base = base or (self._resolve(path) if self._resolve else self._params)
        before, changed = self._player.session, self._base.changed(self._params).items()
        again = before is not None and before.feed.info.path == path
        params = base.with_values({n: value for n, value in changed if again or not n.startswith(_OF_THE_DEVICE)})
        session = self._open_session(path, truth, params, None)
        session.calibration = before.calibration if before is not None and again else ""
        self._base, self._params = base, params
        self._player.halt()
        self._take(session)
        if not session.feed.repeatable:
            self._player.play()

    def _reopen(self, stay: bool) -> None:
        """Restart with the present parameters. User data stays; loop edits stay only if the keyframes are the same."""
        before, kept = self._need_session(), self._kept
        aim = self._player.aim(before) if stay else 0
        self._of_before = 0
        info, edits = before.feed.info, before.edits
        session = self._open_session(info.path, before.truth_path, self._params, (info.start_s, info.part_s))
        session.calibration = before.calibration
        self._take(session)
        if not session.feed.repeatable:  # a live source begins another map, where notes have no place
            return
        session.survey = before.survey
        self._keep(kept)
        if session.loops is not None and edits != Edits():
            session.edit_loops(edits.done, edits.undone)
            if any(params.keyframe != self._params.keyframe for _, params in before.history):
                session.loops.leave_out(0)
        if stay:
            self._player.resume(session, aim, to_end=False)

    def _resume(self, path: Path) -> None:
        """Open the recording of a session file, and repeat the session up to its frame."""
        saved = read_session(path)
        opened, state = saved.opened, saved.state
        gone = state.truth is not None and not state.truth.exists()
        session = self._open_session(
            opened.recording, None if gone else state.truth, saved.first_params, (opened.start_s, opened.duration_s)
        )
        self._base = self._params = state.params
        self._player.halt()
        self._take(session, saved)
        self._set_breakpoints(state.breakpoints)
        self._player.set_speed(state.speed)
        if saved.left_out:
            self._page.notice("warning", saved.left_out)
        if gone:
            self._page.notice("warning", f"The session was compared with {state.truth}, which no longer exists.")

    def _take(self, session: Session, saved: SavedSession | None = None) -> None:
        """Replace the present session by this one, at its first frame or at the frame of `saved`."""
        if self._player.session is not None:
            self._player.session.close()
        self._leave_waiting()
        self._begin_file(session)
        self._loops.clear()
        self._player.take(session)
        self._page.put(resumed=saved is not None)
        if session.frame < 0:  # otherwise it continues where a process died
            state = saved.state if saved is not None else State(self._params)
            self._keep(Kept(**state.kept()))
        self._resuming = None
        if saved is not None:
            # Written now, since this process may die on the way there.
            self._write(saved)
            session.resume(saved)
            self._player.resume(session, saved.frame, to_end=saved.ended)
            self._resuming = saved
        self._show_params()

    def _begin_file(self, session: Session) -> None:
        self._writer.close()
        self._writer = SessionWriter()
        if self._session_folder is not None and session.feed.repeatable:
            self._writer = SessionWriter(new_path(self._session_folder, session.feed.info.path), session.opened)
        self._page.put(session_file=self._writer.path)
        if self._writer.error:
            self._page.notice("warning", self._writer.error)

    def _leave_waiting(self) -> None:
        """Another session begins: drop the commands that waited for the previous one."""
        for command in self._waiting[: self._of_before]:
            if isinstance(command, protocol.Save):
                why = "Another recording was opened before it was saved."
                self._page.saved(protocol.Saved(command.folder, why, command.fetched))
        del self._waiting[: self._of_before]

    def _handle_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for command in waiting:
            self.handle(command)

    def close(self) -> None:
        """Finish the saves in progress and close the recording."""
        session = self._player.session
        if session is not None:
            session.finish_saves()
            if self._resuming is None:  # otherwise the target frame is already written
                self._write(session.saved(self._state(session)))
            session.close()
        self._writer.close()
