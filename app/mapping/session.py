"""A session: a feed of measurements, the engine that processes them, loops, and the log of the frames so far."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from app.export.points import EVERYTHING, Choice
from app.export.results import Results
from app.georeference.survey import Survey
from app.mapping.checkpoints import NEAR, Checkpoint, Checkpoints
from app.mapping.feed import Feed, Quiet
from app.mapping.labels import LabelledKeyframes
from app.mapping.moving import MovingPoints
from app.mapping.saving import write_all
from app.mapping.session_file import Opened, SavedSession, State, size_of
from app.mapping.truth import compared
from app.sensors.findings import Finding
from app.slam import lie
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.frames import Frame
from app.slam.log import Log
from app.slam.loops.edits import Edits, LoopEdit
from app.slam.loops.keyframe_log import KeyframeLog
from app.slam.loops.messages import LoopClient
from app.slam.loops.schedule import LoopSchedule
from app.slam.map_frame import MapFrame
from app.slam.params import Params, leaves
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import read_tum, time_apart
from app.slam.types import F64, DroppedScan, Measurement, StepResult

EFFECT = {leaf.path: leaf.effect for leaf in leaves()}
_NO_LOOPS = MapFrame()


class Session:
    """One pass through a feed, frame by frame. `serve`, `run`, `replay` and `evaluate` all drive this.

    After going back, the session knows the frames up to `known` until it continues differently. A session that repeats
    a file knows its frames up to `planned`.

    Args:
        loops: makes the client that looks for loops, such as `InlineLoops`; None: odometry alone.
        truth: a trajectory (TUM) to compare with. checkpoints: to go back to; None: the session only goes forward.

    Attributes:
        frame: index of the newest frame, -1 before the first. result: of this frame; None before the first frame and
            right after going back.
        frames: all known frames, including those after `frame`. planned: the last frame of a session file, or -1.
        heading: frames up to this one are repeated as they were; see `go_to`.
        params: for frames not yet processed; set them with `choose`.
        history: parameters by the frame from which they apply, ascending.
        ended: whether the feed is at its end. keyframes: with all layers of labels.
        calibration: what the recording shows about its sensors, in a sentence, for the report; "" if nothing.
        survey: what georeferences the results, or None. adjustment: of the map, by the survey and by gravity.

    Raises:
        HemislamError: the truth cannot be read.
    """

    def __init__(
        self,
        feed: Feed,
        engine: Engine,
        *,
        loops: Callable[[KeyframeLog], LoopClient] | None = None,
        truth: Path | None = None,
        checkpoints: Checkpoints | None = None,
    ) -> None:
        self.truth, self.truth_path = read_tum(truth) if truth else None, truth
        self.feed, self.engine, self.params = feed, engine, engine.params
        self.loops = LoopSchedule(loops, engine.keyframes, engine.params.loops) if loops else None
        if self.loops and not feed.repeatable:
            self.loops.never_go_back()
        self.frame = self.planned = self.heading = -1
        self.result: StepResult | None = None
        self.history: tuple[tuple[int, Params], ...] = ()
        self.ended = False
        self.frames: Log[Frame] = Log()
        self._moving = MovingPoints(engine.keyframes, engine.params.moving)
        self.keyframes = LabelledKeyframes(engine.keyframes, self._moving)
        self.survey: Survey | None = None
        self.calibration = ""
        self.adjustment = _NO_LOOPS
        self._shown = _NO_LOOPS, _NO_LOOPS, _NO_LOOPS
        self.checkpoints = checkpoints
        self._waiting: Measurement | None = None
        self._dropped: tuple[str, ...] = ()  # why scans since the newest frame were dropped
        self._saves = ThreadPoolExecutor(max_workers=1, thread_name_prefix="save")
        self._remember()

    # --- going on --------------------------------------------------------------------------------
    def peek(self) -> Measurement | DroppedScan | Quiet | None:
        """What `advance` will process; None at the end. Anything but a measurement is returned only once.

        Raises:
            HemislamError: the feed cannot be read any further.
        """
        if self._waiting is None:
            had_ended, self.ended = self.ended, True  # also if reading fails: it cannot be resumed
            entry = self.feed.next()
            self.ended = entry is None
            if self.ended and not had_ended and self.loops:
                self.loops.finish()
            if isinstance(entry, DroppedScan):
                self._dropped = (*self._dropped, entry.reason)
            if not isinstance(entry, Measurement):
                return entry
            self._waiting = entry
        return self._waiting

    def advance(self) -> StepResult | DroppedScan | Quiet | None:
        """Process the next frame. Returns its result, or what `peek` gives if that is not a measurement.

        Repeated frames (`go_to`) use the parameters that they had. A scan on which the engine fails is left out; when
        the scan is repeated, a `DroppedScan` is returned.

        Raises:
            HemislamError: the feed cannot be read any further. Exception: the engine failed.
        """
        entry = self.peek()
        if not isinstance(entry, Measurement):
            return entry
        self._waiting = None
        frame, repeated = self.frame + 1, self.frame < self.heading
        params = (self.params_of(frame) if repeated else None) or self.params
        if self.params_of(frame) != params:
            self._forget_after(self.frame)
            self.history = (*self.history, (frame, params))
        try:
            result = self._step(entry, frame, params)
        except Exception as error:
            if not repeated:
                raise
            return DroppedScan(entry.scan.stamp_ns, f"the engine failed: {error}")
        if frame > self.known:
            self.frames.append(Frame.of(result, self._dropped))
        self.frame, self.result, self._dropped = frame, result, ()
        self._remember(near=repeated and self.heading - frame <= NEAR)
        return result

    def _step(self, measurement: Measurement, frame: int, params: Params) -> StepResult:
        """Put due loops into effect, then do the engine's step."""
        begin = perf_counter()
        news = self.loops.due(frame) if self.loops else ()
        loops_s = perf_counter() - begin
        self.engine.params = params
        try:
            result = self.engine.step(measurement.scan, measurement.imu)
        finally:
            self.engine.params = self.params
        notices = (*measurement.notices, *result.notices)
        if self.loops:
            begin = perf_counter()
            if result.keyframe is not None:
                self.loops.add(result.keyframe, params.loops)
            notices = (*notices, *self.loops.take_notices())
            loops_ms = (loops_s + perf_counter() - begin) * 1e3
            timings = result.timings_ms | {"loops": loops_ms, "total": result.timings_ms["total"] + loops_ms}
            result = replace(result, T_map_odom=self.map_frame.newest, loops=news, timings_ms=timings)
        return replace(result, notices=notices, dropped=len(self._dropped))

    @property
    def known(self) -> int:
        """The last frame that was processed and is still valid; -1 if there is none."""
        return len(self.frames) - 1

    @property
    def furthest(self) -> int:
        """The last frame that is known or planned, so that `go_to` repeats it as it was."""
        return max(self.known, self.planned)

    @property
    def log(self) -> RunLog:
        """The frames up to the newest, for results."""
        return RunLog(self.frames[: self.frame + 1], self._dropped)

    @property
    def dropped(self) -> int:
        """Number of scans dropped up to the newest frame, and since then."""
        return sum(len(one.dropped) for one in self.frames[: self.frame + 1]) + len(self._dropped)

    @property
    def map_frame(self) -> MapFrame:
        """The transform from odometry to the map by the loops, at the newest frame."""
        return self.loops.frame if self.loops else _NO_LOOPS

    @property
    def shown_frame(self) -> MapFrame:
        """The same with the adjustment."""
        if self._shown[0] is not self.map_frame or self._shown[1] is not self.adjustment:
            self._shown = self.map_frame, self.adjustment, self.adjustment.over(self.map_frame)
        return self._shown[2]

    # --- parameters and edits --------------------------------------------------------------------
    def choose(self, params: Params) -> None:
        """Use these for all frames not yet processed, except parameters that take effect on restart."""
        waiting = [path for path in self.params.changed(params) if EFFECT[path] == "restart"]
        usable = params.with_values({path: self.params.value(path) for path in waiting})
        if usable != self.params:
            self._forget_after(max(self.frame, self.heading))
            if self.loops and usable.keyframe != self.params.keyframe and self.known >= self.heading:
                self.loops.leave_out(sum(one.keyframe for one in self.frames))
            self.params = self.engine.params = usable
            self._moving.choose(usable.moving)

    def params_of(self, frame: int) -> Params | None:
        """The parameters at a known or planned frame; for a later frame, those of the last of these."""
        return next((params for first, params in reversed(self.history) if first <= frame), None)

    def edit_loops(self, edits: tuple[LoopEdit, ...], undone: tuple[LoopEdit, ...] = ()) -> None:
        """Replace all loop edits; the undone ones can be redone. Raises HemislamError: the loop search is off."""
        if self.loops is None:
            raise HemislamError("The loop search is off, so there are no loops to edit; set loops.enabled.")
        self.loops.command(lambda _: Edits(edits, undone))

    def resume(self, saved: SavedSession) -> None:
        """Plan to repeat a session of this recording: `go_to` its frame does so. Raises as `edit_loops`."""
        state = saved.state
        self.choose(state.params)
        if state.edits or state.undone:
            self.edit_loops(state.edits, state.undone)
        self.history, self.planned, self.keyframes.edits = state.history, saved.known, state.labels
        self.survey, self.calibration = state.survey, state.calibration

    @property
    def edits(self) -> Edits:
        """The edits of loops, including those that are requested but not yet in effect."""
        return self.loops.edits if self.loops else Edits()

    @property
    def opened(self) -> Opened:
        """What a session file says about the feed."""
        info = self.feed.info
        return Opened(info.path.resolve(), info.start_s, info.part_s, size_of(info.path))

    def saved(self, state: State) -> SavedSession:
        """The session as a file holds it, with this state."""
        return SavedSession(self.opened, state, self.frame, self.ended, self.furthest)

    # --- going back ------------------------------------------------------------------------------
    def go_to(self, frame: int) -> None:
        """Head for a frame that is known or planned: `advance` repeats all frames up to it.

        The session goes to the nearest checkpoint if that saves frames. It first waits for saves in progress, since
        these read keyframes that are about to be replaced.

        Raises:
            HemislamError: the feed cannot go back, or a checkpoint cannot be read; nothing has changed.
        """
        heading = min(frame, self.furthest)
        nearest = self.checkpoints.before(min(heading, self.known)) if self.checkpoints else None
        behind = heading < self.frame or (heading == self.frame >= 0 and self.result is None)
        if behind or (nearest is not None and nearest > self.frame):
            if nearest is None or self.checkpoints is None:
                raise HemislamError("This session cannot go back; open its recording to do that.")
            self.finish_saves()
            self.return_to(self.checkpoints.get(nearest))
        self.heading = heading

    def stay(self) -> None:
        """Stop heading for a frame: the next frames are processed with the present parameters."""
        self.heading = self.frame

    @property
    def revisits(self) -> bool:
        """Whether the next frame was processed before and is repeated as it was."""
        return self.frame < min(self.heading, self.known)

    def checkpoint(self) -> Checkpoint:
        """The present state. Call this between two frames, not after `peek`."""
        assert self._waiting is None
        return Checkpoint(self.frame, self.engine.checkpoint(), self.feed.place())

    def return_to(self, checkpoint: Checkpoint) -> None:
        """Go to the state of a checkpoint of this session."""
        self.feed.go_to(checkpoint.place)
        self.engine.restore(checkpoint.engine)
        self.engine.params = self.params
        self.frame, self.result = checkpoint.frame, None
        if self.loops:
            self.loops.go_to(self.frame + 1)
        self._waiting, self._dropped, self.ended = None, (), False

    def _forget_after(self, frame: int) -> None:
        """Forget the frames after this one; different ones will follow."""
        self.frames.truncate(frame + 1)
        count = sum(one.keyframe for one in self.frames)
        self.keyframes.forget_after(count)
        self.planned, self.heading = min(self.planned, frame), min(self.heading, frame)
        self.history = tuple(entry for entry in self.history if entry[0] <= frame)
        if self.loops:
            self.loops.forget_after(frame)
        if self.checkpoints:
            self.checkpoints.drop([other for other in self.checkpoints.frames if other > frame])

    def _remember(self, *, near: bool = False) -> None:
        if self.checkpoints and self.checkpoints.wanted(self.frame, near=near):
            self.checkpoints.add(self.frame, self.checkpoint())

    # --- results ---------------------------------------------------------------------------------
    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the feed and the truth."""
        info, truth = self.feed.info, self.truth
        if truth is None or info.duration_s is None:
            return info.findings
        apart = time_apart(str(self.truth_path), truth.stamps_ns, info.start_ns, info.duration_s)
        return (*info.findings, *([Finding("truth", "needs you", apart)] if apart else []))

    def compare_with(self, path: Path | None) -> None:
        """Compare with another trajectory, or none.

        Raises:
            HemislamError: the session is live, or the trajectory cannot be read or shares no time with it.
        """
        info = self.feed.info
        if info.duration_s is None:
            raise HemislamError("A live session cannot be compared with a trajectory; record it, then open the file.")
        truth = read_tum(path) if path else None
        if truth and (apart := time_apart(str(path), truth.stamps_ns, info.start_ns, info.duration_s)):
            raise HemislamError(apart)
        self.truth, self.truth_path = truth, path

    def errors(self) -> F64:
        """(frame + 1,) m, distances to the truth, which is aligned to the frames so far; nan without truth."""
        if self.truth is None:
            return np.full(self.frame + 1, np.nan)
        ours = self.map_frame.trajectory(self.log.odometry)
        return compared(self.truth.stamps_ns, self.truth.positions, ours.stamps_ns, ours.positions)[1]

    def results(self, stopped: str = "") -> Results:
        """The input of result files: the frames so far, with all loops, in effect or not. stopped: as in `save`."""
        info = self.feed.info
        made_from = RunInfo(
            info.path, self.params, info.start_s, info.part_s, self.truth, self.truth_path, stopped, self.calibration
        )
        loops = self.loops.results() if self.loops else None
        results = Results(self.log, self.keyframes.now(), made_from, loops)
        results.adjustment = self.levelling(loops.frame if loops else _NO_LOOPS)
        results.levelled_deg = float(np.degrees(np.linalg.norm(lie.log(results.adjustment.newest[:3, :3]))))
        return results

    def save(
        self,
        folder: Path,
        *,
        session: SavedSession | None = None,
        formats: Sequence[str] = (),
        choice: Choice = EVERYTHING,
        progress: Callable[[float], None] = lambda share: None,
        replace: bool = True,
        stopped: str = "",
    ) -> "Future[dict[str, Any]]":
        """Write the results of the frames so far in a separate thread, with all loops, whether in effect or not.

        Args:
            session: to be written beside the files of a run. formats: of `EXPORTS`, instead of the files of a run.
            choice: of points. progress: called in that thread with the share that is written, 0-1.
            replace: overwrite older results. stopped: why the session ended early, if it did.

        Returns:
            The content of report.json, or HemislamError if the folder cannot be written to.
        """
        results = self.results(stopped)
        results.choice, results.progress = choice, progress
        return self._saves.submit(
            write_all, folder, results, self.survey, self.edits.done, session, formats, replace=replace
        )

    def levelling(self, frame: MapFrame) -> MapFrame:
        """The rotation that levels the map by gravity, which is known better now than at the start."""
        return MapFrame.levelling(frame.newest[:3, :3] @ self.engine.g_odom)

    def georeference(self) -> "Future[Results]":
        """Georeference the present map by the survey, in a separate thread; see `earth.georeference`."""
        from app.mapping.earth import georeference

        assert self.survey is not None
        return self._saves.submit(georeference, self.results(), self.survey, self.edits.done)

    def finish_saves(self) -> None:
        """Wait until no save is in progress."""
        self._saves.submit(lambda: None).result()  # saves run one after the other

    def close(self) -> None:
        """Finish the saves and release all resources."""
        self._saves.shutdown()
        self.feed.close()
        if self.loops:
            self.loops.close()
        self.engine.close()
        if self.checkpoints:
            self.checkpoints.close()
