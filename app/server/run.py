"""One pass through a recording: the open file, the engine at work on it, and what came of it so far."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from app.sensors.recording import Recording, open_recording
from app.server.protocol import OpenedRecording
from app.server.readouts import Readouts
from app.slam.engine import Engine
from app.slam.keyframes import KeyframeStore
from app.slam.params import Params
from app.slam.results import RunInfo, RunLog, prepare_folder, save_results
from app.slam.trajectory import read_tum, truth_beside, write_tum
from app.slam.types import DroppedScan, Keyframe, Measurement, StepResult


class Run:
    """A recording being processed.

    Reading a measurement and processing it are two steps, so that a frame can be waited for.

    Attributes:
        opened: what the page is told of the recording. finished: whether all of it was processed.
        frame: index of the newest frame, -1 before the first. readouts, log: filled frame by frame.
    """

    def __init__(
        self,
        recording: Recording,
        engine: Engine,
        *,
        truth_path: Path | None = None,
        start_s: float = 0.0,
        duration_s: float | None = None,
    ) -> None:
        truth = read_tum(truth_path) if truth_path else None
        rest = max(0.0, recording.duration_s - start_s)
        part = (rest if duration_s is None else min(rest, duration_s)) / max(recording.duration_s, 1e-9)
        self.opened = OpenedRecording(
            path=recording.path,
            start_ns=recording.start_ns,
            duration_s=recording.duration_s,
            frames=round(recording.scan_count * part),
            findings=recording.findings,
            truth_stamps_ns=truth.stamps_ns if truth else None,
            truth_positions=truth.positions if truth else None,
            truth=truth_path,
        )
        self.engine = engine
        self.frame = -1
        self.readouts = Readouts(recording.start_ns, truth)
        self.log = RunLog()
        self._recording = recording
        self._truth = truth
        self._part = (start_s, duration_s)
        self._incoming = recording.measurements(start_s, duration_s)
        self._waiting: Measurement | None = None
        self.finished = False

    def peek(self) -> Measurement | DroppedScan | None:
        """What `step` will process; None at the end. A dropped scan is returned once and skipped.

        Raises:
            HemislamError: the recording is damaged here; it can not be read on.
        """
        if self._waiting is None:
            self.finished = True  # also if reading fails: it can not be taken up again
            entry = next(self._incoming, None)
            self.finished = entry is None
            if not isinstance(entry, Measurement):
                if entry is not None:
                    self.log.drop(entry)
                return entry
            self._waiting = entry
        return self._waiting

    def step(self) -> StepResult:
        """Process the measurement last peeked at. It is used up even if the engine fails on it."""
        measurement, self._waiting = self._waiting, None
        assert measurement is not None
        result = self.engine.step(measurement.scan, measurement.imu)
        if measurement.notices:
            result = replace(result, notices=(*measurement.notices, *result.notices))
        self.frame += 1
        self.log.add(result)
        return result

    def saver(self, folder: Path, *, trajectory_only: bool) -> Callable[[], None]:
        """A function that writes the results of the frames so far; may be called in another thread.

        It raises HemislamError if the folder can not be written to.
        """
        log = copy.deepcopy(self.log)
        if trajectory_only:
            return lambda: _save_trajectory(folder, log)
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

        def save() -> None:
            save_results(folder, log, keyframes, info, replace=True)

        return save

    def close(self) -> None:
        self._recording.close()
        self.engine.close()


class _Present:
    """The keyframes that there are now; later ones are not seen."""

    def __init__(self, keyframes: KeyframeStore) -> None:
        self._keyframes, self._count = keyframes, len(keyframes)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> Keyframe:
        return self._keyframes[index]


def _save_trajectory(folder: Path, log: RunLog) -> None:
    prepare_folder(folder, replace=True)
    write_tum(folder / "trajectory.tum", log.trajectory)


def open_run(
    path: Path, truth: Path | None, params: Params, start_s: float = 0.0, duration_s: float | None = None
) -> Run:
    """Open a recording and give it a new engine. Truth beside the recording is used if none is named.

    Raises:
        HemislamError: the recording or the truth can not be used.
    """
    recording = open_recording(path, params)
    try:
        truth_path = truth or truth_beside(path)
        return Run(recording, Engine(params), truth_path=truth_path, start_s=start_s, duration_s=duration_s)
    except BaseException:
        recording.close()
        raise
