"""What happens in the engine's process: commands in, one piece of work at a time, changes out."""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Protocol

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
from app.server import protocol
from app.server.loop_commands import LoopCommands
from app.server.player import Player
from app.server.protocol import Command
from app.server.publisher import Publisher, opened_recording
from app.slam.errors import HemislamError
from app.slam.params import Params

log = logging.getLogger(__name__)

SOURCE_PERIOD_S = 0.5
POLL_S = 0.02
"""How often to look for what other threads and processes are at work on."""
MOST_NOTES = 1000
"""Of a session: every page and every answer by REST has all of them."""

_AT_ONCE = protocol.OpenRecording | protocol.Restart | protocol.SetSpeed | protocol.SetBreakpoints
"""Commands that do not wait until what is being opened is open."""
_FOR_THE_FRAME = protocol.LoopCommand | protocol.AddNote | protocol.CompareWith | protocol.Save
"""Commands that wait until a reopened session is at its frame again."""


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
        self._writer = SessionWriter()
        self._clock, self._looked_at_source = clock, -1e9
        self._open_session = open_session
        self._resolve = resolve
        self._params = self._base = params
        self._notes: tuple[Note, ...] = ()
        self._resuming: SavedSession | None = None  # what is still being repeated
        self._opening: Callable[[], None] | None = None  # what is to be opened
        self._waiting: list[Command] = []  # for that, or for the end of the repetition

    def open(self, path: Path, truth: Path | None, *, play: bool = False) -> None:
        """Open a recording with exactly the parameters given so far, or a session file with its own."""

        def opening() -> None:
            self._open(path, truth, self._params)
            self._page.show(playing=play)

        self._open_soon(path, opening)

    # --- commands --------------------------------------------------------------------------------
    def handle(self, command: Command) -> None:
        """Take in a command. What cannot be done becomes a notice; nothing is raised."""
        opening = self._opening is not None and not isinstance(command, _AT_ONCE)
        if opening or (self._resuming is not None and isinstance(command, _FOR_THE_FRAME)):
            self._waiting.append(command)  # it is meant for what is open then, or the frame that is shown then
            return
        try:
            self._handle(command)
            if self._player.session is not None:
                self._writer.did(self._player.session.frame, command)
        except HemislamError as error:
            self._page.notice("error", str(error))

    def _handle(self, command: Command) -> None:
        match command:
            case protocol.Play():
                if self._need_session().ended:
                    self._handle(protocol.Restart())
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
            case protocol.AddNote(text):
                if len(self._notes) >= MOST_NOTES:
                    raise HemislamError(f"A session keeps {MOST_NOTES:,} notes; this one was not kept.")
                if text.strip():
                    self._show_notes((*self._notes, Note(self._need_session().frame, text.strip())))
            case protocol.SetParams(values):
                self._set_params(self._params.with_values(values))
            case protocol.LoadParams(text):
                self._set_params(Params().merged_yaml(text))
            case protocol.OpenRecording(path, truth):
                self._open_soon(path, lambda: self._open(path, truth))
            case protocol.CompareWith(trajectory):
                session = self._need_session()
                session.compare_with(trajectory)
                self._page.put(recording=opened_recording(session), urgent=True)
            case protocol.Restart():
                self._open_soon(self._need_session().feed.info.path, self._reopen)
            case protocol.Save(folder, trajectory_only):
                session = self._need_session()
                saved = None if trajectory_only else session.saved(self._state(session))
                save = session.save(folder, session=saved, trajectory_only=trajectory_only)
                self._saves.append((folder, save))
            case protocol.LoopCommand():
                loops = self._need_session().loops
                if loops is None:
                    raise HemislamError("Loops are not looked for; set loops.enabled and restart.")
                self._loops.handle(command, loops)

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

    # --- work ------------------------------------------------------------------------------------
    def work(self) -> float | None:
        """Do the next piece of due work.

        Returns:
            Seconds until there may be more: 0 if there is more already; None if nothing will be due
            before the next command.
        """
        wait = self._work()
        session = self._player.session
        if session is not None and self._resuming is None:
            self._writer.write(session.frame, self._state(session), ended=session.ended, settled=wait is None)
        return wait

    def _work(self) -> float | None:
        while self._saves and self._saves[0][1].done():
            folder, save = self._saves.popleft()
            error = save.exception()
            if error is not None and not isinstance(error, HemislamError):
                log.error("Saving to %s failed", folder, exc_info=error)
            self._page.saved(protocol.Saved(folder, "" if error is None else str(error) or type(error).__name__))
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
            self._page.put(live=state, recording=opened_recording(session))
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
        self._opening, self._waiting = opening, []
        self._page.put(progress=protocol.Progress(f"Opening {path.name}", math.nan), urgent=True)

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
        self._handle_waiting()

    def _open(self, path: Path, truth: Path | None, base: Params | None = None) -> None:
        """Open a recording with its own parameters, or `base`, and on top those changed by hand; or a session file.

        What was changed by hand about the device stays with the recording it was meant for.
        """
        if path.suffix == SUFFIX:
            self._resume(path)
            return
        base = base or (self._resolve(path) if self._resolve else self._params)
        changed = self._base.changed(self._params).items()
        by_hand = {name: value for name, value in changed if name.partition(".")[0] not in ("recording", "sensor")}
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
        if saved is not None:  # at once: it may be killed on the way there
            self._writer.write(saved.frame, saved.state, ended=saved.ended)
        self._loops.clear()
        self._player.take(session)
        self._show_notes(saved.state.notes if saved is not None else ())
        self._resuming = None
        if saved is not None:
            session.resume(saved)
            self._player.resume(session, saved.frame, to_end=saved.ended)
            self._resuming = saved
        self._show_params()

    def _begin_file(self, session: Session) -> None:
        """Begin a session file; a session that cannot be repeated has none."""
        self._writer.close()
        self._writer = SessionWriter()
        if self._session_folder is not None and session.feed.repeatable:
            self._writer = SessionWriter(new_path(self._session_folder, session.feed.info.path), session.opened)
        self._page.put(session_file=self._writer.path)
        if self._writer.error:
            self._page.notice("warning", self._writer.error)

    def _resumed(self, session: Session) -> None:
        """A reopened session is where it was, or the user has left its way."""
        self._resuming = None
        self._player.settle_labels(session)
        self._handle_waiting()

    def _handle_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for command in waiting:
            self.handle(command)

    def close(self) -> None:
        """Finish the saves under way and close the recording."""
        session = self._player.session
        if session is not None:
            session.finish_saves()
            self._writer.write(session.frame, self._state(session), ended=session.ended, settled=True)
            session.close()
        self._writer.close()


def _is_over(saved: SavedSession, session: Session) -> bool:
    """Whether nothing of a saved session is left to be repeated: it is where it was, or goes on differently."""
    arrived = session.frame >= saved.frame and not saved.ended
    return arrived or session.ended or session.planned < saved.frame
