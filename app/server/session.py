"""What happens in the engine's process: commands in, one unit of work at a time, changes out."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, assert_never

from app.server.breakpoints import Breakpoints, Moment, reasons
from app.server.checkpoints import NEAR
from app.server.delta import Outbox
from app.server.journal import SUFFIX, Journal, Opened, SavedSession, State, new_path, read_session, size_of
from app.server.live import LiveRun, tells
from app.server.loop_desk import LoopDesk
from app.server.pacing import Pacer
from app.server.protocol import (
    Command,
    InspectLoop,
    LoadParams,
    OpenRecording,
    OverruleLoop,
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
    Shutdown,
    StepFrame,
    TryLoop,
    UndoLoop,
)
from app.server.publisher import Publisher
from app.server.run import EFFECT, Quiet, Run, in_force
from app.server.saver import Saver
from app.slam.errors import HemislamError
from app.slam.loops.line import LoopLine
from app.slam.params import Params
from app.slam.types import DroppedScan, StepResult

log = logging.getLogger(__name__)

SLOWEST = 0.1
LONG_SEEK = 20
"""Frames to process on the way to a frame, from which on progress is shown."""
SOURCE_PERIOD_S = 0.5
POLL_S = 0.02
"""How often to look for what others are at work on."""


@dataclass(frozen=True, slots=True)
class Journey:
    """The way to a frame that was asked for.

    Attributes:
        target: the frame. origin: where it began, for progress.
        again_to: frames up to this one are taken as they were, unseen until its end; later ones anew.
        stepping: asked for step by step; further steps add up.
        back: first to the checkpoint before `again_to`, which may be later than here.
    """

    target: int
    again_to: int
    stepping: bool
    back: bool
    origin: int


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
        chunk_voxel: edge of the voxels (m) in which keyframe clouds are thinned for the page.
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
        chunk_voxel: float = 0.05,
        journals: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._outbox = outbox
        self._page = Publisher(outbox, chunk_voxel)
        self._desk = LoopDesk(outbox)
        self._pacer = Pacer(clock)
        self._clock, self._looked_at_source = clock, -1e9
        self._saver = Saver()
        self._open_run = open_run
        self._resolve = resolve
        self._params = self._base = params
        self._run: Run | None = None
        self._journals = journals
        self._journal: Journal | None = None
        self._resuming: SavedSession | None = None
        # What is wanted but not done yet:
        self._opening: Callable[[], None] | None = None
        self._after_opening: list[Command] = []
        self._relabelling = False
        self._journey: Journey | None = None
        self._unseen: StepResult | None = None
        self._page_behind = False
        self._breakpoints = Breakpoints()
        self._moment: Moment | None = None  # the frame that the page shows

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
        if self._opening is not None and isinstance(command, Play | Pause | StepFrame | Seek | Save):
            self._after_opening.append(command)  # it is meant for what will be open then
            return
        try:
            self._handle(command)
            if self._journal is not None and self._run is not None:
                self._journal.did(self._run.frame, command)
        except HemislamError as error:
            self._outbox.notice("error", str(error))

    def _handle(self, command: Command) -> None:
        match command:
            case Play():
                if self._need_run().finished:
                    self._handle(Restart())
                self._pacer.release()
                self._page.show(playing=True)
            case Pause() | Shutdown():
                self._halt()
            case StepFrame(frames):
                self._step(frames)
            case SetSpeed(factor):
                if not factor >= SLOWEST:
                    raise HemislamError(f"The speed can not be {factor}; choose one from {SLOWEST} to inf.")
                self._pacer.speed = factor
                self._page.show(speed=factor)
            case Seek(frame):
                self._seek(frame)
            case SetBreakpoints(breakpoints):
                self._breakpoints = breakpoints
                self._outbox.put(breakpoints=breakpoints, urgent=True)
            case SetParams(values):
                self._set_params(self._params.with_values(values))
            case LoadParams(text):
                self._set_params(Params().merged_yaml(text))
            case OpenRecording(path, truth):
                self._open_soon(path, lambda: self._open_other(path, truth))
            case Restart():
                path = self._need_run().opened.path
                self._open_soon(path, self._reopen)
            case Save(folder, trajectory_only):
                run = self._need_run()
                session = SavedSession(opened_of(run), self._state(run), run.frame)
                self._saver.start(folder, run.saver(folder, session, trajectory_only=trajectory_only))
            case OverruleLoop() | UndoLoop() | RedoLoop() | TryLoop() | InspectLoop():
                self._desk.handle(command, self._need_loops())
            case _:
                assert_never(command)

    def _halt(self) -> None:
        """Stay at the present frame, also if one was being sought."""
        if self._journey is not None:
            self._journey = None
            self._outbox.put(progress=None)
        self._catch_up()
        self._page.show(playing=False, frames_per_second=0.0)

    def _step(self, frames: int) -> None:
        """Steps asked for while the last one is not done yet add up."""
        run, journey = self._need_run(), self._journey
        if run.live and frames < 0:
            raise HemislamError("A live source can only go on; record it, and open the recording to go back in it.")
        if journey is not None and journey.stepping:
            self._page.show(playing=False, frames_per_second=0.0)
            start, again_to = journey.target, journey.again_to
        else:
            self._halt()
            start = again_to = run.frame
        frame = max(start + frames, 0)
        self._go_to(frame, min(again_to, frame), stepping=True)

    def _seek(self, frame: int) -> None:
        run = self._need_run()
        if run.live:
            raise HemislamError("A live source can only go on; record it, and open the recording to go back in it.")
        frame = max(0, min(frame, run.opened.frames - 1))
        self._go_to(frame, min(frame, run.known))

    def _go_to(self, frame: int, again_to: int, *, stepping: bool = False) -> None:
        """Go to a frame as fast as possible, then go on as before; see `Journey`."""
        run = self._need_run()
        nearest = run.checkpoints.before(again_to)
        back = again_to < run.frame or (nearest is not None and run.frame < nearest)
        self._journey = Journey(frame, again_to, stepping, back, run.frame)
        if not back and run.frame >= frame:
            self._catch_up()
            self._approach(run.frame)

    def _set_params(self, params: Params) -> None:
        changed = self._params.changed(params)
        self._params = params
        if self._run is not None:
            run = self._run
            usable = run.usable(self._params)
            if usable != run.params:
                run.forget_after(run.frame if self._journey is None else max(run.frame, self._journey.again_to))
                run.choose(usable)
            self._relabelling |= any(EFFECT[path] == "now" for path in changed)
        self._page.params(params, self._pending_restart())

    def _pending_restart(self) -> tuple[str, ...]:
        """Names of parameters that the engine still has another value of, since it can not change them."""
        if self._run is None:
            return ()
        return tuple(path for path in self._run.params.changed(self._params) if EFFECT[path] == "restart")

    def _need_run(self) -> Run:
        if self._run is None:
            raise HemislamError("No recording is open; open one first.")
        return self._run

    def _need_loops(self) -> LoopLine:
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
        if self._relabelling:
            self._relabel()
            return 0.0
        if self._journey is not None and self._journey.back and self._run is not None:
            self._go_back(self._run, self._journey)
            return 0.0
        moving = self._page.transport.playing or self._journey is not None
        wait = self._advance(self._run) if self._run is not None and moving else None
        if isinstance(self._run, LiveRun):
            self._look_at_source(self._run)
        looking = SOURCE_PERIOD_S if isinstance(self._run, LiveRun) and not self._page.transport.finished else None
        waits = [wait, POLL_S if self._saver.busy else None, self._look_at_loops(), looking]
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
                    self._fail("Nothing more comes live", error)
                    self._page.show(finished=True)

    def _look_at_loops(self) -> float | None:
        """Take in what came of them. Returns when (s) to look again if something is awaited."""
        loops = self._run.engine.loops if self._run is not None else None
        if self._run is None or loops is None:
            return None
        if self._desk.update(loops) and not self._page_behind:
            self._page.map_moved(self._run)
        return None if loops.idle else POLL_S

    def _go_back(self, run: Run, journey: Journey) -> None:
        """To the checkpoint, and on by a frame: there is something to show then, should that be the end of it."""
        self._saver.wait()  # it may read keyframes that are about to be replaced
        try:
            run.go_before(journey.again_to)
        except Exception as error:
            self._fail("The frames before can not be gone back to", error)
            return
        self._journey = replace(journey, back=False, origin=run.frame)
        self._page_behind, self._unseen = True, None
        self._pacer.release()
        while self._journey is not None and self._page_behind and self._unseen is None:
            self._advance(run)

    def _advance(self, run: Run) -> float | None:
        """Process the next frame if it is due."""
        journey = self._journey
        try:
            entry = run.peek()
        except Exception as error:  # what was processed stays; the rest can not be read
            self._fail("The recording can not be read on from here", error)
            self._page.show(finished=True)
            return None
        again = journey is not None and run.frame < journey.again_to
        if entry is None:
            self._halt()
            self._page.show(finished=True)
            return None
        if isinstance(entry, Quiet):
            if entry.status is not None:
                level: Literal["warning", "info"] = "warning" if tells(entry.status) else "info"
                self._outbox.notice(level, f"Live: {entry.status.text}.")
            return 0.0
        if isinstance(entry, DroppedScan):
            if again:
                return 0.0
            self._page.show(dropped=run.log.dropped.total(), urgent=False)
            self._page.notice_once(f"A scan was left out: {entry.reason}.", entry.stamp_ns)
            return 0.0
        if journey is None and not run.live and (wait := self._pacer.wait(entry.scan.stamp_ns)) > 0:
            return wait
        if self._resuming is not None and not again:
            self._follow(run, self._resuming)
        try:
            result = run.step(again=again)
        except Exception as error:
            if again:  # as it did then
                return 0.0
            self._fail(f"The frame after frame {run.frame} could not be processed and is left out", error)
            return None
        if again and journey is not None:
            run.readouts.row(result)
            self._page_behind, self._unseen = True, result
            run.remember(near=journey.again_to - run.frame <= NEAR)
            if run.frame >= journey.again_to:
                self._catch_up()
        else:
            self._page.frame(run, result)
            self._page.show(frames_per_second=self._pacer.tick(), urgent=False)
            run.remember()
            self._passed(run, result, played=journey is None)
        if self._resuming is not None and run.frame >= self._resuming.frame:
            self._resumed(run)
        self._approach(run.frame)
        return 0.0

    def _passed(self, run: Run, result: StepResult, *, played: bool) -> None:
        """Pause where a breakpoint holds, unless the frame is one on the way to another."""
        before, self._moment = self._moment, Moment(result, run.readouts.error)
        if played and (why := reasons(self._breakpoints, before, self._moment)):
            self._halt()
            self._outbox.notice("info", f"Paused at frame {run.frame:,}. {' '.join(why)}")

    def _catch_up(self) -> None:
        """Show the frame that was gone to, if the page does not."""
        if self._page_behind and self._run is not None:
            run, result = self._run, self._unseen
            self._page_behind, self._unseen = False, None
            self._page.arrived(run, result)
            self._moment = Moment(result, run.readouts.error) if result is not None else None
            then = run.params_of(run.frame)
            changed = then.changed(run.params) if then is not None else {}
            self._relabelling = any(EFFECT[path] == "now" for path in changed)

    def _approach(self, frame: int) -> None:
        """At a frame of the journey, if there is one: end it there or say how far it is."""
        journey = self._journey
        if journey is None:
            return
        if frame >= journey.target:
            self._journey = None
            self._pacer.release()
            self._outbox.put(progress=None, urgent=True)
        elif journey.target - journey.origin > LONG_SEEK:
            fraction = (frame - journey.origin) / (journey.target - journey.origin)
            self._outbox.put(progress=Progress(f"Going to frame {journey.target}", fraction))

    def _relabel(self) -> None:
        self._relabelling = False
        if self._run is None or self._page.result is None:
            return
        try:
            self._page.relabelled(self._run.engine.relabel(self._page.result))
        except Exception as error:
            self._fail("The ground of this frame could not be found again", error)

    def _fail(self, what: str, error: Exception) -> None:
        """Tell the user, pause, and go on living."""
        if isinstance(error, HemislamError):
            reason = str(error)
        else:
            log.error("%s", what, exc_info=error)
            reason = f"{type(error).__name__}: {error}"
        self._halt()
        self._outbox.notice("error", f"{what}. {reason}")

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
            self._fail("The recording can not be opened", error)
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
        self._halt()
        self._take(run)

    def _reopen(self) -> None:
        run = self._need_run()
        self._take(self._open_run(run.opened.path, run.opened.truth, self._params, run.part))

    def _take(self, run: Run) -> None:
        """Let go of the present run and show the first frame of this one."""
        if self._run is not None:
            self._saver.wait()
            self._run.close()
        self._run = run
        self._resuming = None
        self._begin_journal(run)
        self._relabelling = self._page_behind = False
        self._moment = None
        self._unseen = None
        run.remember()
        self._desk.clear()
        if run.frame >= 0:
            self._page.taken_over(run)
        else:
            self._page.opened(run)
        self._page.params(self._params, self._pending_restart())
        self._pacer.release()
        if run.frame < 0:
            self._go_to(0, -1)

    # --- the session as a file -------------------------------------------------------------------
    def _begin_journal(self, run: Run) -> None:
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        self._outbox.put(journal=None)
        if not run.live:  # a live one shows how its source is doing when it knows
            self._outbox.put(live=None)
        if self._journals is not None and not run.live:
            path = new_path(self._journals, run.opened.path)
            self._journal = Journal(path, opened_of(run))
            self._outbox.put(journal=path)
            if self._journal.error:
                self._outbox.notice("warning", self._journal.error)

    def _note(self, *, settled: bool) -> None:
        if self._journal is not None and self._run is not None and self._resuming is None:
            self._journal.note(self._run.frame, self._state(self._run), settled=settled)

    def _state(self, run: Run) -> State:
        loops = run.engine.loops.state if run.engine.loops is not None else None
        overrulings, undone = (loops.undo, loops.redo) if loops is not None else ((), ())
        return State(self._params, run.history, overrulings, undone)

    def _resume(self, path: Path) -> None:
        """Open what a session file opened and go, as it went, to the frame that it was at."""
        saved = read_session(path)
        opened, state = saved.opened, saved.state
        first = state.history[0][1] if state.history else state.params
        run = self._open_run(opened.recording, opened.truth, first, (opened.start_s, opened.duration_s))
        self._base = self._params = state.params
        self._halt()
        self._take(run)
        if state.overrulings or state.undone:
            run.overrule(state.overrulings, state.undone)
        self._resuming = saved
        if self._journal is not None:
            self._journal.note(saved.frame, state)
        self._go_to(max(saved.frame, 0), -1)

    def _follow(self, run: Run, saved: SavedSession) -> None:
        """Choose for the next frame what was in force at it then."""
        params = in_force(saved.state.history, run.frame + 1)
        if params is not None and params != run.params:
            run.choose(params)

    def _resumed(self, run: Run) -> None:
        """The frame that the session was at is reached: from here on what is chosen now is in force."""
        self._resuming = None
        run.choose(run.usable(self._params))

    def close(self) -> None:
        """Finish the saves under way and close the recording."""
        self._saver.close()
        self._note(settled=True)
        if self._journal is not None:
            self._journal.close()
        self._page.close()
        if self._run is not None:
            self._run.close()


def opened_of(run: Run) -> Opened:
    """What a session file says of where a run comes from."""
    opened = run.opened
    return Opened(opened.path.resolve(), opened.truth and opened.truth.resolve(), *run.part, size_of(opened.path))
