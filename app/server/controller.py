"""What happens in the engine's process: commands in, one piece of work at a time, changes out."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Protocol, assert_never

from app.mapping.breakpoints import Breakpoints
from app.mapping.session import EFFECT, Session
from app.mapping.session_file import (
    SUFFIX,
    Note,
    SavedSession,
    SessionWriter,
    State,
    new_path,
    read_session,
)
from app.server.loop_commands import LoopCommands
from app.server.player import Player
from app.server.protocol import (
    AddNote,
    Command,
    CompareWith,
    EditLoop,
    InspectLoop,
    LoadParams,
    OpenedRecording,
    OpenRecording,
    Pause,
    Play,
    Progress,
    RedoLoop,
    Restart,
    Save,
    Saved,
    Seek,
    SetBreakpoints,
    SetParams,
    SetSpeed,
    StepFrame,
    TryLoop,
    UndoLoop,
)
from app.server.publisher import Publisher
from app.slam.errors import HemislamError
from app.slam.loops.schedule import LoopSchedule
from app.slam.params import Params

log = logging.getLogger(__name__)

SOURCE_PERIOD_S = 0.5
POLL_S = 0.02
"""How often to look for what other threads and processes are at work on."""
MOST_NOTES = 1000
"""Of a session: every page and every answer by REST has all of them."""

_AT_ONCE = OpenRecording | Restart | SetSpeed | SetBreakpoints
"""Commands that do not wait until what is being opened is open."""
_FOR_THE_FRAME = EditLoop | UndoLoop | RedoLoop | TryLoop | InspectLoop | AddNote | CompareWith | Save


class OpenSession(Protocol):
    """Opens a recording, or the part of it from start for a duration (s), with a new engine; raises HemislamError."""

    def __call__(
        self, path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None = None, /
    ) -> Session: ...


class Controller:
    """The open session and its transport. One thread calls `handle` and `work`.

    Args:
        page: takes everything that changes.
        params: to begin with.
        open_session: opens a recording.
        resolve: parameters that a recording is opened with, before changes by hand; None: the present ones.
        session_folder: folder in which session files are kept; None: nowhere.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        page: Publisher,
        params: Params,
        open_session: OpenSession,
        *,
        resolve: Callable[[Path], Params] | None = None,
        session_folder: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._page = page
        self._loops = LoopCommands(page)
        self._player = Player(page, clock)
        self._saves: deque[tuple[Path, Future[Any]]] = deque()
        self._session_folder = session_folder
        self._writer: SessionWriter | None = None
        self._clock, self._looked_at_source = clock, -1e9
        self._open_session = open_session
        self._resolve = resolve
        self._params = self._base = params
        self._notes: tuple[Note, ...] = ()
        self._resuming: SavedSession | None = None  # what is still being repeated
        # What is wanted but not done yet:
        self._opening: Callable[[], None] | None = None
        self._after_opening: list[Command] = []
        self._after_resuming: list[Command] = []

    def open(self, path: Path, truth: Path | None, *, play: bool = False) -> None:
        """Open a recording with exactly the parameters given so far, or a session file with its own."""

        def opening() -> None:
            if path.suffix == SUFFIX:
                self._resume(path)
            else:
                self._take(self._open_session(path, truth, self._params))
            self._page.show(playing=play)

        self._open_soon(path, opening)

    # --- commands --------------------------------------------------------------------------------
    def handle(self, command: Command) -> None:
        """Take in a command. What cannot be done becomes a notice; nothing is raised."""
        if self._opening is not None and not isinstance(command, _AT_ONCE):
            self._after_opening.append(command)  # it is meant for what will be open then
            return
        if self._resuming is not None and isinstance(command, _FOR_THE_FRAME):
            self._after_resuming.append(command)  # it is meant for the frame that the session goes to
            return
        try:
            self._handle(command)
            if self._writer is not None and self._player.session is not None:
                self._writer.did(self._player.session.frame, command)
        except HemislamError as error:
            self._page.notice("error", str(error))

    def _handle(self, command: Command) -> None:
        match command:
            case Play():
                if self._need_session().ended:
                    self._handle(Restart())
                self._player.play()
            case Pause():
                self._player.halt()
            case StepFrame(frames):
                self._player.step(self._need_session(), frames)
            case SetSpeed(factor):
                self._player.set_speed(factor)
            case Seek(frame):
                self._player.seek(self._need_session(), frame)
            case SetBreakpoints(breakpoints):
                self._set_breakpoints(breakpoints)
            case AddNote(text):
                if len(self._notes) >= MOST_NOTES:
                    raise HemislamError(f"A session keeps {MOST_NOTES:,} notes; this one was not kept.")
                if text.strip():
                    self._show_notes((*self._notes, Note(self._need_session().frame, text.strip())))
            case SetParams(values):
                self._set_params(self._params.with_values(values))
            case LoadParams(text):
                self._set_params(Params().merged_yaml(text))
            case OpenRecording(path, truth):
                self._open_soon(path, lambda: self._open_other(path, truth))
            case CompareWith(trajectory):
                session = self._need_session()
                session.compare_with(trajectory)
                self._page.put(recording=OpenedRecording.of(session), urgent=True)
            case Restart():
                self._open_soon(self._need_session().feed.info.path, self._reopen)
            case Save(folder, trajectory_only):
                session = self._need_session()
                saved = None if trajectory_only else session.saved(self._state(session))
                save = session.save(folder, session=saved, trajectory_only=trajectory_only)
                self._saves.append((folder, save))
            case EditLoop() | UndoLoop() | RedoLoop() | TryLoop() | InspectLoop():
                self._loops.handle(command, self._need_loops())
            case _:
                assert_never(command)

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

    def _show_notes(self, notes: tuple[Note, ...]) -> None:
        self._notes = notes
        self._page.put(notes=notes, urgent=True)

    def _show_params(self) -> None:
        """Show the parameters, and of which the engine still has another value, since they act on restart."""
        session = self._player.session
        pending = tuple(session.params.changed(self._params)) if session is not None else ()
        self._page.put(params=self._params, pending_restart=pending, urgent=True)

    def _need_session(self) -> Session:
        if self._player.session is None:
            raise HemislamError("No recording is open; open one first.")
        return self._player.session

    def _need_loops(self) -> LoopSchedule:
        loops = self._need_session().loops
        if loops is None:
            raise HemislamError("Loops are not looked for; set loops.enabled and restart.")
        return loops

    # --- work ------------------------------------------------------------------------------------
    def work(self) -> float | None:
        """Do the next piece of due work.

        Returns:
            Seconds until there may be more: 0 if there is more already; None if nothing will be due
            before the next command.
        """
        wait = self._work()
        session = self._player.session
        if self._writer is not None and session is not None and self._resuming is None:
            self._writer.write(session.frame, self._state(session), ended=session.ended, settled=wait is None)
        return wait

    def _work(self) -> float | None:
        while self._saves and self._saves[0][1].done():
            self._report(*self._saves.popleft())
        if self._opening is not None:
            self._do_opening(self._opening)
            return 0.0
        wait, session = self._player.work(), self._player.session
        if session is None:
            return wait
        if self._resuming is not None and _is_over(self._resuming, session):
            self._resumed(session)
        saving = POLL_S if self._saves else None
        waits = [wait, saving, self._look_at_loops(session), self._look_at_source(session)]
        return min((seconds for seconds in waits if seconds is not None), default=None)

    def _report(self, folder: Path, save: "Future[Any]") -> None:
        """Show that a save has ended."""
        error = save.exception()
        if error is not None and not isinstance(error, HemislamError):
            log.error("Saving to %s failed", folder, exc_info=error)
        self._page.saved(Saved(folder, "" if error is None else str(error) or type(error).__name__))

    def _look_at_source(self, session: Session) -> float | None:
        """Show now and then how a live source is doing. Returns when (s) to look again."""
        if self._page.transport.finished or session.feed.info.duration_s is not None:
            return None
        now = self._clock()
        if now - self._looked_at_source >= SOURCE_PERIOD_S:
            self._looked_at_source = now
            try:
                state = session.feed.live_state()
            except HemislamError as error:
                self._player.fail("Nothing more comes live", error)
                self._page.show(finished=True)
                return None
            self._page.put(live=state, recording=OpenedRecording.of(session))
        return SOURCE_PERIOD_S

    def _look_at_loops(self, session: Session) -> float | None:
        """Take in what came of them. Returns when (s) to look again if something is awaited."""
        loops = session.loops
        if loops is None:
            return None
        if self._loops.update(loops, show=not self._player.page_behind):
            self._page.map_moved(session)
        return None if loops.idle else POLL_S

    def _state(self, session: Session) -> State:
        """All that the present state of the session follows from."""
        return State(
            params=self._params,
            history=session.history,
            edits=session.edits[0],
            undone=session.edits[1],
            truth=session.truth_path,
            notes=self._notes,
            breakpoints=self._player.breakpoints,
            speed=self._page.transport.speed,
        )

    # --- opening ---------------------------------------------------------------------------------
    def _open_soon(self, path: Path, opening: Callable[[], None]) -> None:
        """Leave the opening to `work`, so that the page can say first that it takes a moment."""
        self._opening, self._after_opening = opening, []
        self._page.put(progress=Progress(f"Opening {path.name}", math.nan), urgent=True)

    def _do_opening(self, opening: Callable[[], None]) -> None:
        """Open; if that is not possible, everything stays as it is."""
        self._opening = None
        try:
            opening()
        except HemislamError as error:
            self._page.notice("error", str(error))
        except Exception as error:
            self._player.fail("The recording cannot be opened", error)
        self._page.put(progress=None, urgent=True)
        waiting, self._after_opening = self._after_opening, []
        for command in waiting:
            self.handle(command)

    def _open_other(self, path: Path, truth: Path | None) -> None:
        """Open another recording with its own parameters, and on top those changed by hand.

        What was changed by hand about the device stays with the recording it was meant for.
        """
        if path.suffix == SUFFIX:
            self._resume(path)
            return
        base = self._resolve(path) if self._resolve else self._params
        by_hand = {
            name: value
            for name, value in self._base.changed(self._params).items()
            if name.partition(".")[0] not in ("recording", "sensor")
        }
        params = base.with_values(by_hand)
        session = self._open_session(path, truth, params)
        self._base, self._params = base, params
        self._player.halt()
        self._take(session)

    def _reopen(self) -> None:
        session = self._need_session()
        info = session.feed.info
        self._take(self._open_session(info.path, session.truth_path, self._params, (info.start_s, info.part_s)))

    def _resume(self, path: Path) -> None:
        """Open what a session file opened, and repeat it as it went up to the frame that it was at."""
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
        if gone:
            self._page.notice("warning", f"The session was compared with {state.truth}, which is gone.")

    def _take(self, session: Session, saved: SavedSession | None = None) -> None:
        """Let go of the present session and show the first frame of this one, or that at which it was saved."""
        if self._player.session is not None:
            self._player.session.close()
        self._begin_file(session)
        if saved is not None and self._writer is not None:
            self._writer.write(
                saved.frame, saved.state, ended=saved.ended
            )  # at once: it may be killed on the way there
        self._loops.clear()
        self._player.take(session)
        self._show_notes(saved.state.notes if saved is not None else ())
        self._resuming, self._after_resuming = None, []
        if saved is not None:
            session.resume(saved)
            self._player.resume(session, saved.frame, to_end=saved.ended)
            self._resuming = saved
        self._show_params()

    def _begin_file(self, session: Session) -> None:
        """Begin a session file; a session that cannot be repeated has none."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._page.put(session_file=None)
        if self._session_folder is not None and session.feed.repeatable:
            path = new_path(self._session_folder, session.feed.info.path)
            self._writer = SessionWriter(path, session.opened)
            self._page.put(session_file=path)
            if self._writer.error:
                self._page.notice("warning", self._writer.error)

    def _resumed(self, session: Session) -> None:
        """A reopened session is where it was, or the user has left its way."""
        self._resuming = None
        self._player.settle_labels(session)
        waiting, self._after_resuming = self._after_resuming, []
        for command in waiting:
            self.handle(command)

    def close(self) -> None:
        """Finish the saves under way and close the recording."""
        session = self._player.session
        if session is not None:
            session.finish_saves()
            if self._writer is not None:
                self._writer.write(session.frame, self._state(session), ended=session.ended, settled=True)
        if self._writer is not None:
            self._writer.close()
        if session is not None:
            session.close()


def _is_over(saved: SavedSession, session: Session) -> bool:
    """Whether nothing of a saved session is left to be repeated: it is where it was, or goes on differently."""
    arrived = session.frame >= saved.frame and not saved.ended
    return arrived or session.ended or session.planned < saved.frame
