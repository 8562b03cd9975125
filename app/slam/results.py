"""What a session leaves behind: one folder of result files. `EXPORTS` declares them.

`save_results` writes them from the frames of a session, at any moment.
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from app.slam import report
from app.slam.errors import HemislamError
from app.slam.frames import READOUTS, Frame, as_table
from app.slam.loops.files import LoopResults, loops_csv
from app.slam.loops.types import Verdict
from app.slam.map_frame import MapFrame
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.ply import Keyframes, write_map
from app.slam.trajectory import Trajectory, stamp_text, write_tum
from app.slam.types import F64, I64, TIMINGS, FrameStatus

MOST_NOTICES = 200


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


@dataclass(frozen=True)
class RunLog:
    """What the results tell of the frames of a session up to some moment. Arrays are read-only.

    Attributes:
        frames: in order. dropped_since: why scans after the last of them were dropped.
    """

    frames: Sequence[Frame]
    dropped_since: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def _table(self) -> np.ndarray:
        table = as_table(self.frames)
        table.setflags(write=False)
        return table

    @property
    def stamps_ns(self) -> I64:
        """(n,) scan ends."""
        stamps_ns: I64 = self._table["stamp_ns"]
        return stamps_ns

    @property
    def timings_ms(self) -> F64:
        """(n, len(TIMINGS)) milliseconds; 0 for a stage that a frame did not have."""
        columns = [READOUTS.index(f"{stage}_ms") for stage in TIMINGS]
        return np.asarray(np.nan_to_num(self._table["readouts"][:, columns]))

    @property
    def odometry(self) -> Trajectory:
        """T_odom_imu at every scan's end; the origin while the filter waits at rest to start."""
        return Trajectory(self.stamps_ns, self._table["position"], self._table["quaternion"])

    @cached_property
    def statuses(self) -> Counter[FrameStatus]:
        return Counter(frame.status for frame in self.frames)

    @cached_property
    def dropped(self) -> Counter[str]:
        """Scans that were not processed, by reason."""
        return Counter([*(reason for frame in self.frames for reason in frame.dropped), *self.dropped_since])

    @cached_property
    def notices(self) -> Counter[str]:
        """How often each notice was given, of the first `MOST_NOTICES` different ones."""
        notices = Counter[str]()
        for notice in (notice for frame in self.frames for notice in frame.notices):
            if notice in notices or len(notices) < MOST_NOTICES:
                notices[notice] += 1
        return notices

    @property
    def ground_share(self) -> float | None:
        """Share of all points that are ground, 0-1; None without a point."""
        points = sum(frame.points for frame in self.frames)
        return sum(frame.ground_points for frame in self.frames) / points if points else None

    @property
    def ground_score(self) -> GroundScore | None:
        """Of all frames whose true labels are known."""
        scores = [frame.ground_score for frame in self.frames if frame.ground_score is not None]
        return sum(scores[1:], scores[0]) if scores else None


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
    write: Callable[[Path, Results], object]
    of_loops: bool = False


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
        "trajectory.tum",
        "pose of the IMU in the map at each scan's end: stamp x y z qx qy qz qw",
        lambda path, results: write_tum(path, results.trajectory),
    ),
    Export(
        "trajectory_odometry.tum",
        "the same by odometry alone, without loops",
        lambda path, results: write_tum(path, results.log.odometry),
        of_loops=True,
    ),
    Export("loops.csv", "every loop candidate: verdict, measurements and reason", _write_loops, of_loops=True),
    Export("graph.g2o", "the pose graph of the keyframes", _write_graph, of_loops=True),
    Export(
        "timings.csv",
        "milliseconds of each stage in each frame, without reading the file",
        lambda path, results: path.write_text(timings_csv(results.log), encoding="utf-8"),
    ),
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
    folder: Path, results: Results, exports: Sequence[Export] = EXPORTS, *, replace: bool = False
) -> dict[str, Any]:
    """Write these result files and return what report.json holds.

    Older results in the folder stay until all new files are complete.

    Raises:
        HemislamError: as `prepare_folder`, or the disk is full or fails.
    """
    prepare_folder(folder, replace=replace)
    written = [export for export in exports if results.loops or not export.of_loops]
    parts = {export.name: folder / f".{export.name}.part" for export in written}
    try:
        for export in written:
            export.write(parts[export.name], results)
        for export in exports:
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
