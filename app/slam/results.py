"""What a session leaves behind: one folder of result files. `EXPORTS` declares them.

`RunLog` collects one small row per frame; `save_results` writes the files from it at any moment.
"""

import copy
import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam import report
from app.slam.errors import HemislamError
from app.slam.loops.files import LoopResults, loops_csv
from app.slam.loops.types import Verdict
from app.slam.map_frame import MapFrame
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.ply import Keyframes, write_map
from app.slam.rows import Rows
from app.slam.trajectory import Trajectory, stamp_text, write_tum
from app.slam.types import F64, I64, NON_GROUND, TIMINGS, DroppedScan, FrameStatus, StepResult

MOST_NOTICES = 200
_SUMS = ("statuses", "dropped", "notices", "points", "ground_points", "ground_score")
"""Attributes of `RunLog` that are not rows."""


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What a run was made from.

    Attributes:
        recording: the input. params: as used last. start_s, duration_s: the part asked for.
        truth: to compare with. truth_path: its file.
        stopped: why the run ended before the recording did, in a sentence; "" if it did not.
    """

    recording: Path
    params: Params
    start_s: float = 0.0
    duration_s: float | None = None
    truth: Trajectory | None = None
    truth_path: Path | None = None
    stopped: str = ""


LogRows = tuple[I64, F64, F64]
"""Rows of a `RunLog`: (n,) stamps, (n, 7) poses, (n, len(TIMINGS)) timings."""


@dataclass(frozen=True, slots=True)
class LogState:
    """What `RunLog.restore` needs beside the rows, which the log keeps."""

    frames: int
    sums: dict[str, Any]


class RunLog:
    """One row a frame (about 150 bytes), and sums over all of them.

    After going back to a checkpoint the later rows stay until others are put in their place.
    """

    def __init__(self) -> None:
        self._stamps = Rows((), np.int64)
        self._poses = Rows((7,), np.float64)
        self._timings = Rows((len(TIMINGS),), np.float64)
        self.statuses: Counter[FrameStatus] = Counter()
        self.dropped: Counter[str] = Counter()
        self.notices: Counter[str] = Counter()
        self.points = 0
        self.ground_points = 0
        self.ground_score: GroundScore | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, result: StepResult) -> None:
        """Take in a processed frame."""
        T_odom_imu = result.state.T_odom_imu
        pose = (*T_odom_imu[:3, 3], *Rotation.from_matrix(T_odom_imu[:3, :3]).as_quat())
        self._stamps.append(result.stamp_ns)
        self._poses.append(pose)
        self._timings.append([result.timings_ms.get(stage, 0.0) for stage in TIMINGS])
        self.statuses[result.status] += 1
        self._count(result.notices)
        self.points += len(result.cloud)
        self.ground_points += int(np.count_nonzero(result.cloud.labels != NON_GROUND))
        if result.truth_ground is not None:
            score = GroundScore.of(result.cloud.labels, result.truth_ground)
            self.ground_score = score if self.ground_score is None else self.ground_score + score

    def drop(self, scan: DroppedScan) -> None:
        """Take in a scan that was not processed."""
        self.dropped[scan.reason] += 1

    def checkpoint(self) -> LogState:
        return LogState(len(self), {name: copy.copy(getattr(self, name)) for name in _SUMS})

    def restore(self, state: LogState) -> None:
        """Go back to a checkpoint of this log, or forth again to one whose rows were not replaced since."""
        self._go_to(state.frames)
        for name, value in state.sums.items():
            setattr(self, name, copy.copy(value))

    def rows(self, first: int) -> LogRows:
        """The rows of the frames from `first` on."""
        return self._stamps.view()[first:], self._poses.view()[first:], self._timings.view()[first:]

    def extend(self, rows: LogRows) -> None:
        """Put rows of another log behind those of this one; `restore` says what they amount to."""
        for table, more in zip(self._tables, rows, strict=True):
            table.extend(more)

    @property
    def _tables(self) -> tuple[Rows[Any], ...]:
        return self._stamps, self._poses, self._timings

    def _go_to(self, frames: int) -> None:
        for table in self._tables:
            table.go_to(frames)

    def _count(self, notices: tuple[str, ...]) -> None:
        for notice in notices:
            if notice in self.notices or len(self.notices) < MOST_NOTICES:
                self.notices[notice] += 1

    # Arrays are read-only, and as they are only until the log goes back and on from there.
    @property
    def stamps_ns(self) -> I64:
        """(n,) scan ends of all processed frames."""
        return self._stamps.view()

    @property
    def timings_ms(self) -> F64:
        """(n, len(TIMINGS)) milliseconds."""
        return self._timings.view()

    @property
    def odometry(self) -> Trajectory:
        """T_odom_imu at every scan's end; while the filter waits at rest to start, the origin."""
        poses = self._poses.view()
        return Trajectory(self.stamps_ns, poses[:, :3], poses[:, 3:])


@dataclass
class Results:
    """What the result files are written from.

    Attributes:
        loops: None if loops were not searched. report: what report.json holds; complete once it is written.
    """

    log: RunLog
    keyframes: Keyframes
    info: RunInfo
    loops: LoopResults | None = None
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def frame(self) -> MapFrame:
        return self.loops.frame if self.loops else MapFrame()

    @cached_property
    def trajectory(self) -> Trajectory:
        """T_map_imu at every scan's end."""
        return self.frame.trajectory(self.log.odometry)


@dataclass(frozen=True, slots=True)
class Export:
    """One result file.

    Attributes:
        name: of the file. meaning: what it holds, for help texts and the documentation.
        write: writes it to a path. of_loops: exists only if loops were searched.
    """

    name: str
    meaning: str
    write: Callable[[Path, Results], None]
    of_loops: bool = False


def _write_trajectory(path: Path, results: Results) -> None:
    write_tum(path, results.trajectory)


def _write_odometry(path: Path, results: Results) -> None:
    write_tum(path, results.log.odometry)


def _write_timings(path: Path, results: Results) -> None:
    path.write_text(timings_csv(results.log), encoding="utf-8")


def _write_map(path: Path, results: Results) -> None:
    points = write_map(path, results.keyframes, results.frame)
    results.report["map"] = {"keyframes": len(results.keyframes), "points": points}


def _write_loops(path: Path, results: Results) -> None:
    assert results.loops is not None
    path.write_text(loops_csv(results.loops.edges, results.loops.stamps_ns), encoding="utf-8")


def _write_graph(path: Path, results: Results) -> None:
    assert results.loops is not None
    path.write_text(results.loops.g2o, encoding="utf-8")


def _write_report(path: Path, results: Results) -> None:
    loops, info = results.loops, results.info
    made = report.make_report(results.log, results.trajectory, info) | {"map": results.report.get("map")}
    made["loops"] = {verdict.value: loops.count(verdict) for verdict in Verdict} if loops else None
    if loops and info.truth is not None:
        made["accuracy_odometry"] = report.accuracy(results.log.odometry, info)
    results.report = report.finite(made)
    path.write_text(json.dumps(results.report, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


EXPORTS = (
    Export(
        "trajectory.tum", "pose of the IMU in the map at each scan's end: stamp x y z qx qy qz qw", _write_trajectory
    ),
    Export("trajectory_odometry.tum", "the same by odometry alone, without loops", _write_odometry, of_loops=True),
    Export("loops.csv", "every loop candidate: verdict, measurements and reason", _write_loops, of_loops=True),
    Export("graph.g2o", "the pose graph of the keyframes", _write_graph, of_loops=True),
    Export("timings.csv", "milliseconds of each stage in each frame, without reading the file", _write_timings),
    Export("map.ply", "the map: x y z intensity ground", _write_map),
    Export("report.json", "parameters, counts of frames, ground share, errors against truth", _write_report),
)
"""All result files, in the order in which they are written. report.json comes last: it counts the map's points."""


def prepare_folder(folder: Path, *, replace: bool = False) -> None:
    """Make sure that results can be written to `folder`, creating it.

    Raises:
        HemislamError: the folder holds results and `replace` is not set, or it is not writable.
    """
    held = [export.name for export in EXPORTS if (folder / export.name).exists()]
    if held and not replace:
        raise HemislamError(
            f"{folder} already holds results ({', '.join(held)}); choose another folder or add --force."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HemislamError(f"The folder {folder} cannot be made: {error.strerror}; choose another one.") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HemislamError(f"The folder {folder} is not writable; choose another one.")


def save_results(
    folder: Path,
    log: RunLog,
    keyframes: Keyframes,
    info: RunInfo,
    loops: LoopResults | None = None,
    *,
    replace: bool = False,
) -> dict[str, Any]:
    """Write all result files and return what report.json holds.

    Older results in the folder stay until all new files are complete.

    Raises:
        HemislamError: as `prepare_folder`, or the disk is full or fails.
    """
    prepare_folder(folder, replace=replace)
    results = Results(log, keyframes, info, loops)
    written = [export for export in EXPORTS if loops or not export.of_loops]
    parts = {export.name: folder / f".{export.name}.part" for export in written}
    try:
        for export in written:
            export.write(parts[export.name], results)
        for export in EXPORTS:
            if export in written:
                parts[export.name].replace(folder / export.name)
            else:
                (folder / export.name).unlink(missing_ok=True)  # of an older run
    except OSError as error:
        raise HemislamError(f"Results cannot be written to {folder}: {error.strerror}.") from error
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
    return results.report


def timings_csv(log: RunLog, more: dict[str, Sequence[float]] | None = None) -> str:
    """One line per frame: milliseconds of each stage; `more` adds columns by name."""
    columns = [log.timings_ms, *(np.asarray(values)[:, None] for values in (more or {}).values())]
    lines = [",".join(["frame", "stamp_s", *(f"{stage}_ms" for stage in TIMINGS), *(more or {})])]
    for frame, (stamp, row) in enumerate(zip(log.stamps_ns, np.hstack(columns), strict=True)):
        lines.append(f"{frame},{stamp_text(int(stamp))}," + ",".join(f"{value:.4f}" for value in row))
    return "\n".join(lines) + "\n"
