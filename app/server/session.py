"""What happens in the engine's process: commands in, one unit of work at a time, changes out."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, assert_never

from app.server.breakpoints import Breakpoints
from app.server.delta import Outbox
from app.server.journal import SUFFIX, SavedSession, State, read_session
from app.server.keeper import Keeper, opened_of
from app.server.live import LiveRun
from app.server.loop_desk import LoopDesk
from app.server.player import Player
from app.server.protocol import (
    AddNote,
    Command,
    CompareWith,
    EditLoop,
    InspectLoop,
    LoadParams,
    Note,
    OpenRecording,
    Pause,
    Play,
    Progress,
    RedoLoop,
    Restart,
    Save,
    Seek,
    SetBreakpoints,
    SetParams,
    SetSpeed,
    StepFrame,
    TryLoop,
    UndoLoop,
)
from app.server.publisher import Publisher
from app.server.run import EFFECT, Run
from app.server.saver import Saver
from app.slam.errors import HemislamError
from app.slam.loops.schedule import LoopSchedule
from app.slam.params import Params

SOURCE_PERIOD_S = 0.5
POLL_S = 0.02
"""How often to look for what others are at work on."""
MOST_NOTES = 1000
"""Of a session: every page and every state by REST has them all."""

_AT_ONCE = OpenRecording | Restart | SetSpeed | SetBreakpoints
"""Commands that do not wait until what is being opened is open."""
_FOR_THE_FRAME = EditLoop | UndoLoop | RedoLoop | TryLoop | InspectLoop | AddNote | CompareWith | Save


class OpenRun(Protocol):
    """Opens a recording, or the part of it from start for a duration (s), with a new engine; raises HemislamError."""

    def __call__(
        self, path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None = None, /
    ) -> Run: ...


class Session:
    """The open recording, its engine and the transport.

    Commands only note what is wanted; `work` does it, a short piece a call. One thread calls both.

    Args:
        outbox: takes everything that changes.
        params: to begin with.
        open_run: opens a recording.
        resolve: parameters that a recording is opened with, before changes by hand; None: the present ones.
        journals: folder in which sessions are kept while they go on; None: nowhere.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        outbox: Outbox,
        params: Params,
        open_run: OpenRun,
        *,
        resolve: Callable[[Path], Params] | None = None,
        journals: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._outbox = outbox
        self._page = Publisher(outbox)
        self._desk = LoopDesk(outbox)
        self._saver = Saver()
        self._player = Player(outbox, self._page, self._saver, clock)
        self._keeper = Keeper(outbox, journals)
        self._clock, self._looked_at_source = clock, -1e9
        self._open_run = open_run
        self._resolve = resolve
        self._params = self._base = params
        self._notes: tuple[Note, ...] = ()
        self._resuming = False  # whether a session that was reopened is not yet where it was
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
                self._take(self._open_run(path, truth, self._params))
            self._page.show(playing=play)

        self._open_soon(path, opening)

    # --- commands --------------------------------------------------------------------------------
    def handle(self, command: Command) -> None:
        """Take in a command. What can not be done becomes a notice; nothing is raised."""
        if self._opening is not None and not isinstance(command, _AT_ONCE):
            self._after_opening.append(command)  # it is meant for what will be open then
            return
        if self._resuming and isinstance(command, _FOR_THE_FRAME):
            self._after_resuming.append(command)  # it is meant for the frame that is gone to
            return
        try:
            self._handle(command)
            if self._player.run is not None:
                self._keeper.did(self._player.run, command)
        except HemislamError as error:
            self._outbox.notice("error", str(error))

    def _handle(self, command: Command) -> None:
        match command:
            case Play():
                if self._need_run().finished:
                    self._handle(Restart())
                self._player.play()
            case Pause():
                self._player.halt()
            case StepFrame(frames):
                self._player.step(self._need_run(), frames)
            case SetSpeed(factor):
                self._player.set_speed(factor)
            case Seek(frame):
                self._player.seek(self._need_run(), frame)
            case SetBreakpoints(breakpoints):
                self._set_breakpoints(breakpoints)
            case AddNote(text):
                if len(self._notes) >= MOST_NOTES:
                    raise HemislamError(f"A session keeps {MOST_NOTES:,} notes; this one was not kept.")
                if text.strip():
                    self._show_notes((*self._notes, Note(self._need_run().frame, text.strip())))
            case SetParams(values):
                self._set_params(self._params.with_values(values))
            case LoadParams(text):
                self._set_params(Params().merged_yaml(text))
            case OpenRecording(path, truth):
                self._open_soon(path, lambda: self._open_other(path, truth))
            case CompareWith(trajectory):
                self._compare_with(trajectory)
            case Restart():
                path = self._need_run().opened.path
                self._open_soon(path, self._reopen)
            case Save(folder, trajectory_only):
                run = self._need_run()
                session = SavedSession(opened_of(run), self._state(run), run.frame)
                self._saver.start(folder, run.saver(folder, session, trajectory_only=trajectory_only))
            case EditLoop() | UndoLoop() | RedoLoop() | TryLoop() | InspectLoop():
                self._desk.handle(command, self._need_loops())
            case _:
                assert_never(command)

    def _set_params(self, params: Params) -> None:
        changed = self._params.changed(params)
        self._params = params
        run = self._player.run
        if run is not None:
            usable = run.usable(self._params)
            if usable != run.params:
                run.forget_after(self._player.last_known(run))
                run.choose(usable)
            self._player.relabelling |= any(EFFECT[path] == "now" for path in changed)
        self._page.params(params, self._pending_restart())

    def _compare_with(self, path: Path | None) -> None:
        run = self._need_run()
        if run.live:
            raise HemislamError("A live walk can not be compared with a trajectory; record it, and open the recording.")
        run.compare_with(path)
        self._page.compared(run)

    def _set_breakpoints(self, breakpoints: Breakpoints) -> None:
        self._player.breakpoints = breakpoints
        self._outbox.put(breakpoints=breakpoints, urgent=True)

    def _show_notes(self, notes: tuple[Note, ...]) -> None:
        self._notes = notes
        self._outbox.put(notes=notes, urgent=True)

    def _pending_restart(self) -> tuple[str, ...]:
        """Names of parameters that the engine still has another value of, since it can not change them."""
        run = self._player.run
        if run is None:
            return ()
        return tuple(path for path in run.params.changed(self._params) if EFFECT[path] == "restart")

    def _need_run(self) -> Run:
        if self._player.run is None:
            raise HemislamError("No recording is open; open one first.")
        return self._player.run

    def _need_loops(self) -> LoopSchedule:
        loops = self._need_run().engine.loops
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
        self._note(settled=wait is None)
        return wait

    def _work(self) -> float | None:
        while (saved := self._saver.ended()) is not None:
            self._page.saved(saved)
        if self._opening is not None:
            self._do_opening(self._opening)
            return 0.0
        wait, run = self._player.work(), self._player.run
        if run is None:
            return POLL_S if self._saver.busy else wait
        if self._resuming and (run.followed_to < 0 or run.finished):
            self._resumed(run)
        if isinstance(run, LiveRun):
            self._look_at_source(run)
        looking = SOURCE_PERIOD_S if isinstance(run, LiveRun) and not self._page.transport.finished else None
        waits = [wait, POLL_S if self._saver.busy else None, self._look_at_loops(run), looking]
        return min((seconds for seconds in waits if seconds is not None), default=None)

    def _look_at_source(self, run: LiveRun) -> None:
        """Show now and then how a live source is doing."""
        now = self._clock()
        if now - self._looked_at_source >= SOURCE_PERIOD_S:
            self._looked_at_source = now
            run.grown()
            try:
                self._outbox.put(live=run.state(), recording=run.opened)
            except HemislamError as error:
                if not self._page.transport.finished:
                    self._player.fail("Nothing more comes live", error)
                    self._page.show(finished=True)

    def _look_at_loops(self, run: Run) -> float | None:
        """Take in what came of them. Returns when (s) to look again if something is awaited."""
        loops = run.engine.loops
        if loops is None:
            return None
        if self._desk.update(loops, show=not self._player.page_behind):
            self._page.map_moved(run)
        return None if loops.idle else POLL_S

    def _note(self, *, settled: bool) -> None:
        run = self._player.run
        if run is not None and not self._resuming and self._keeper.keeping:
            self._keeper.note(run.frame, self._state(run), settled=settled)

    def _state(self, run: Run) -> State:
        """All that the present state of the session follows from."""
        loops = run.engine.loops.state if run.engine.loops is not None else None
        return State(
            params=self._params,
            history=run.history,
            edits=loops.undo if loops is not None else (),
            undone=loops.redo if loops is not None else (),
            notes=self._notes,
            breakpoints=self._player.breakpoints,
            speed=self._page.transport.speed,
        )

    # --- opening ---------------------------------------------------------------------------------
    def _open_soon(self, path: Path, opening: Callable[[], None]) -> None:
        """Leave the opening to `work`, so that the page can say first that it takes a moment."""
        self._opening, self._after_opening = opening, []
        self._outbox.put(progress=Progress(f"Opening {path.name}", math.nan), urgent=True)

    def _do_opening(self, opening: Callable[[], None]) -> None:
        """Open; if that is not possible, everything stays as it is."""
        self._opening = None
        try:
            opening()
        except HemislamError as error:
            self._outbox.notice("error", str(error))
        except Exception as error:
            self._player.fail("The recording can not be opened", error)
        self._outbox.put(progress=None, urgent=True)
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
        run = self._open_run(path, truth, params)
        self._base, self._params = base, params
        self._player.halt()
        self._take(run)

    def _reopen(self) -> None:
        run = self._need_run()
        self._take(self._open_run(run.opened.path, run.opened.truth, self._params, run.part))

    def _resume(self, path: Path) -> None:
        """Open what a session file opened and go, as it went, to the frame that it was at."""
        saved = read_session(path)
        opened, state = saved.opened, saved.state
        first = state.history[0][1] if state.history else state.params
        gone = opened.truth is not None and not opened.truth.exists()
        truth = None if gone else opened.truth
        run = self._open_run(opened.recording, truth, first, (opened.start_s, opened.duration_s))
        self._base = self._params = state.params
        self._player.halt()
        self._take(run, saved)
        self._set_breakpoints(state.breakpoints)
        self._player.set_speed(state.speed)
        if gone:
            self._outbox.notice("warning", f"The session was compared with {opened.truth}, which is gone.")

    def _take(self, run: Run, saved: SavedSession | None = None) -> None:
        """Let go of the present run and show the first frame of this one, or that at which it was saved."""
        if self._player.run is not None:
            self._saver.wait()
            self._player.run.close()
        self._keeper.begin(run)
        if saved is not None:
            self._keeper.note(saved.frame, saved.state)  # at once: it may be killed on the way there
        self._desk.clear()
        self._player.take(run)
        self._show_notes(saved.state.notes if saved is not None else ())
        self._resuming, self._after_resuming = saved is not None, []
        if saved is not None:
            run.resume(saved)
            self._player.go_to(max(saved.frame, 0), -1)
        self._page.params(self._params, self._pending_restart())

    def _resumed(self, run: Run) -> None:
        """A reopened session is where it was, or the user has left its way."""
        self._resuming = False
        self._player.settle_labels(run)
        waiting, self._after_resuming = self._after_resuming, []
        for command in waiting:
            self.handle(command)

    def close(self) -> None:
        """Finish the saves under way and close the recording."""
        self._saver.close()
        self._note(settled=True)
        self._keeper.close()
        if self._player.run is not None:
            self._player.run.close()
