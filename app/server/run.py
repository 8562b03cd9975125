"""One pass through a recording: the open file, the engine at work on it, and what came of it so far."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.mapping import truth as compared
from app.mapping.frames import Frame
from app.mapping.log import Log
from app.mapping.loops import RestartingLoops
from app.sensors.findings import Finding
from app.sensors.live.status import Status
from app.sensors.recording import Place, Recording, open_recording
from app.server.checkpoints import DEFAULT_BYTES, Checkpoints
from app.server.journal import SUFFIX, SavedSession, write_session
from app.server.protocol import OpenedRecording
from app.slam.engine import Checkpoint, Engine
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops.messages import LoadEdits
from app.slam.loops.types import Edits, LoopEdit
from app.slam.params import Params, leaves
from app.slam.results import LogState, RunInfo, RunLog, prepare_folder, save_results
from app.slam.trajectory import Trajectory, read_tum, time_apart, write_tum
from app.slam.types import F64, DroppedScan, Keyframe, Measurement, StepResult

EFFECT = {leaf.path: leaf.effect for leaf in leaves()}


@dataclass(frozen=True, slots=True)
class RunState:
    """A run after a frame, but for the rows that its parts keep."""

    frame: int
    engine: Checkpoint
    place: Place
    log: LogState


@dataclass(frozen=True, slots=True)
class Quiet:
    """There is no scan just now; of a live source. status: what it has to tell instead, if anything."""

    status: Status | None = None


class Run:
    """A recording being processed.

    Reading a measurement and processing it are two steps, so that a frame can be waited for. A run
    that went back knows how it went on before, up to frame `known`, until it goes on differently.

    Attributes:
        opened: what the page is told of the recording. finished: whether all of it was processed.
        frame: index of the newest frame, -1 before the first.
        frames: all that are known, also those after `frame` that the run went back over.
        params: for frames not yet processed; set them with `choose`.
        history: from which frame on which were in force, ascending.
        live: whether it goes on as it happens, and there is no going back.
        checkpoints: to go back to; filled by `remember`. log: filled frame by frame.
    """

    live = False

    def __init__(
        self,
        recording: Recording,
        engine: Engine,
        *,
        truth_path: Path | None = None,
        start_s: float = 0.0,
        duration_s: float | None = None,
        checkpoint_bytes: int = DEFAULT_BYTES,
    ) -> None:
        truth = read_tum(truth_path) if truth_path else None
        apart = truth and time_apart(str(truth_path), truth.stamps_ns, recording.start_ns, recording.duration_s)
        rest = max(0.0, recording.duration_s - start_s)
        part = (rest if duration_s is None else min(rest, duration_s)) / max(recording.duration_s, 1e-9)
        self.opened = OpenedRecording(
            path=recording.path,
            start_ns=recording.start_ns,
            duration_s=recording.duration_s,
            frames=round(recording.scan_count * part),
            findings=(*recording.findings, *([Finding("truth", "needs you", apart)] if apart else [])),
            truth_stamps_ns=truth.stamps_ns if truth else None,
            truth_positions=truth.positions if truth else None,
            truth=truth_path,
        )
        self.engine = engine
        self.frame = -1
        self.frames: Log[Frame] = Log()
        self.params = engine.params
        self.checkpoints = Checkpoints(checkpoint_bytes)
        self.history: tuple[tuple[int, Params], ...] = ()
        self.log = RunLog()
        self._recording = recording
        self._truth = truth
        self._part = (start_s, duration_s)
        self._incoming = recording.measurements(start_s, duration_s)
        self._waiting: Measurement | None = None
        self._dropped = 0  # scans since the newest frame
        self._followed: SavedSession | None = None  # see `resume`
        self.finished = False

    def peek(self) -> Measurement | DroppedScan | Quiet | None:
        """What `step` will process; None at the end. A dropped scan is returned once and skipped.

        Raises:
            HemislamError: the recording is damaged here; it can not be read on.
        """
        if self._waiting is None:
            was_finished, self.finished = self.finished, True  # also if reading fails: it can not be taken up again
            entry = next(self._incoming, None)
            self.finished = entry is None
            if self.engine.loops and self.finished and not was_finished:
                self.engine.loops.finish()
            if not isinstance(entry, Measurement):
                if entry is not None:
                    self._drop(entry)
                return entry
            self._waiting = entry
        return self._waiting

    @property
    def known(self) -> int:
        """Index of the last frame that is known; -1 if there is none."""
        return len(self.frames) - 1

    def _drop(self, scan: DroppedScan) -> None:
        self.log.drop(scan)
        self._dropped += 1

    def step(self, *, again: bool = False, sought: bool = False) -> StepResult:
        """Process the measurement last peeked at. It is used up even if the engine fails on it.

        Args:
            again: with the parameters of then, for a frame that is known; else with the present ones.
            sought: only on the way to another frame, so that a session that is repeated goes on as it went.
        """
        measurement, self._waiting = self._waiting, None
        assert measurement is not None
        frame = self.frame + 1
        if not (again or sought):
            self._followed = None
        params = self._params_for(frame, again=again)
        if self.params_of(frame) != params:
            self._forget_after(self.frame)
            self.history = (*self.history, (frame, params))
        self.engine.params = params
        try:
            result = self.engine.step(measurement.scan, measurement.imu)
        finally:
            self.engine.params = self.params
        result = replace(result, notices=(*measurement.notices, *result.notices), dropped=self._dropped)
        self.frame, self._dropped = frame, 0
        if frame == len(self.frames):
            self.frames.append(Frame.of(result))
        if frame >= self.followed_to:
            self._followed = None
        self.log.add(result)
        return result

    def _params_for(self, frame: int, *, again: bool) -> Params:
        if again:
            return self.params_of(frame) or self.params
        history = self._followed.state.history if self._followed is not None else ()
        return in_force(history, frame) or self.params

    @property
    def followed_to(self) -> int:
        """The frame up to which the way of a session is still to be repeated; -1: there is none."""
        return -1 if self._followed is None else self._followed.frame

    @property
    def part(self) -> tuple[float, float | None]:
        """Start and duration (s) of what is processed of the recording."""
        return self._part

    def edit_loops(self, commands: tuple[LoopEdit, ...], undone: tuple[LoopEdit, ...] = ()) -> None:
        """Put these commands over the loops that are found, now and later; the undone ones can be done again.

        Raises:
            HemislamError: loops are not looked for.
        """
        if self.engine.loops is None:
            raise HemislamError("Loops are not looked for, so there are none to edit; set loops.enabled.")
        self.engine.loops.command(LoadEdits(Edits(commands, undone)))

    def resume(self, saved: SavedSession) -> None:
        """Repeat a session of this recording: up to its frame as it went, from there on with what it chose last.

        Seeking does so; a frame that is played, or a change of parameters before, makes another walk of it.

        Raises:
            HemislamError: it edits loops, and none are looked for.
        """
        state = saved.state
        self.choose(self.usable(state.params))
        if state.edits or state.undone:
            self.edit_loops(state.edits, state.undone)
        self._followed = saved if saved.frame > self.frame else None

    def compare_with(self, path: Path | None) -> None:
        """Compare the session with another trajectory, or none, from now on.

        Raises:
            HemislamError: it can not be read, or shares no time with the recording; nothing has changed.
        """
        truth = read_tum(path) if path else None
        opened = self.opened
        if truth and (apart := time_apart(str(path), truth.stamps_ns, opened.start_ns, opened.duration_s)):
            raise HemislamError(apart)
        self._truth = truth
        self.opened = replace(
            opened,
            truth=path,
            truth_stamps_ns=truth.stamps_ns if truth else None,
            truth_positions=truth.positions if truth else None,
        )

    def errors(self) -> F64:
        """(frame + 1,) m, distances of the frames so far to the truth, which is aligned to them; nan without truth."""
        if self._truth is None:
            return np.full(self.frame + 1, np.nan)
        ours = self.engine.map_frame.trajectory(self.log.odometry)
        there = compared.interpolated(self._truth.stamps_ns, self._truth.positions, ours.stamps_ns)
        return compared.distances(compared.align(there, ours.positions), there, ours.positions)

    # --- going back ------------------------------------------------------------------------------
    def choose(self, params: Params) -> None:
        """Take these parameters for all frames not yet processed."""
        self.params = self.engine.params = params

    def usable(self, params: Params) -> Params:
        """These, but for those that the engine can not change on the way."""
        waiting = [path for path in self.params.changed(params) if EFFECT[path] == "restart"]
        return params.with_values({path: self.params.value(path) for path in waiting})

    def params_of(self, frame: int) -> Params | None:
        """Those in force at a frame that is known; of a later one, those of the last."""
        return in_force(self.history, frame)

    def forget_after(self, frame: int) -> None:
        """What comes after a frame will be another walk."""
        if frame < self.followed_to:
            self._followed = None
        self._forget_after(frame)

    def _forget_after(self, frame: int) -> None:
        self.frames.truncate(frame + 1)
        if self.engine.loops:
            self.engine.loops.forget_after(frame)
        self.checkpoints.forget_after(frame)
        self.history = tuple(entry for entry in self.history if entry[0] <= frame)

    def remember(self, *, near: bool = False) -> None:
        """Take a checkpoint, if one is wanted here. Call it between two steps, with nothing peeked at."""
        if self._waiting is None and self.checkpoints.wanted(self.frame, near=near):
            state = RunState(
                frame=self.frame,
                engine=self.engine.checkpoint(),
                place=self._incoming.place(),
                log=self.log.checkpoint(),
            )
            self.checkpoints.add(self.frame, state)

    def go_before(self, frame: int) -> None:
        """To the last checkpoint before a frame that is known.

        Raises:
            OSError: it can not be read; nothing has changed.
        """
        nearest = self.checkpoints.before(frame)
        assert nearest is not None, "remember() was not called at the start"
        state = self.checkpoints.get(nearest)
        assert isinstance(state, RunState)
        self.engine.restore(state.engine)
        self.engine.params = self.params
        self.log.restore(state.log)
        self.frame = state.frame
        self._incoming = self._recording.measurements(*self._part, after=state.place)
        self._waiting, self._dropped, self.finished = None, 0, False

    def saver(
        self, folder: Path, session: SavedSession | None = None, *, trajectory_only: bool = False
    ) -> Callable[[], None]:
        """A function that writes the results of the frames so far, and the session; may be called in another thread.

        It raises HemislamError if the folder can not be written to.
        """
        log = copy.deepcopy(self.log)
        if trajectory_only:
            # by all that is found so far, as beside the map: what is on its way counts
            frame = self.engine.loops.results().frame if self.engine.loops else self.engine.map_frame
            return lambda: _save_trajectory(folder, frame.trajectory(log.odometry))
        start_s, duration_s = self._part
        info = RunInfo(
            recording=self.opened.path,
            params=self.engine.params,
            start_s=start_s,
            duration_s=duration_s,
            truth=self._truth,
            truth_path=self.opened.truth,
        )
        keyframes = _Present(self.engine.keyframes)
        loops = self.engine.loops.results() if self.engine.loops else None

        def save() -> None:
            save_results(folder, log, keyframes, info, loops, replace=True)
            if session is not None:
                _save_session(folder / f"session{SUFFIX}", session)

        return save

    def close(self) -> None:
        self._recording.close()
        self.engine.close()
        self.checkpoints.close()


def in_force(history: Sequence[tuple[int, Params]], frame: int) -> Params | None:
    """The parameters of a frame by a history as in `Run.history`; None before its first."""
    return next((params for first, params in reversed(history) if first <= frame), None)


def _save_session(path: Path, session: SavedSession) -> None:
    try:
        write_session(path, session)
    except OSError as error:
        raise HemislamError(f"The session can not be written to {path}: {error.strerror}.") from error


class _Present:
    """The keyframes that there are now; later ones are not seen."""

    def __init__(self, keyframes: KeyframeStore) -> None:
        self._keyframes, self._count = keyframes, len(keyframes)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> Keyframe:
        return self._keyframes[index]


def _save_trajectory(folder: Path, trajectory: Trajectory) -> None:
    prepare_folder(folder, replace=True)
    write_tum(folder / "trajectory.tum", trajectory)


def open_run(
    path: Path,
    truth: Path | None,
    params: Params,
    start_s: float = 0.0,
    duration_s: float | None = None,
    checkpoint_bytes: int = DEFAULT_BYTES,
) -> Run:
    """Open a recording and give it a new engine.

    Args:
        checkpoint_bytes: memory for checkpoints, see `app.server.checkpoints`.

    Raises:
        HemislamError: the recording or the truth can not be used.
    """
    recording = open_recording(path, params)
    try:
        return Run(
            recording,
            Engine(params, RestartingLoops if params.loops.enabled else None),
            truth_path=truth,
            start_s=start_s,
            duration_s=duration_s,
            checkpoint_bytes=checkpoint_bytes,
        )
    except BaseException:
        recording.close()
        raise
