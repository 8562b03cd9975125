"""What a run leaves behind: trajectories, timings, map, loops and report.json in one folder.

`RunLog` collects one small row a frame while the run goes on; `save_results` writes the files from
it, at the end or at any moment in between.
"""

import copy
import json
import math
import os
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from app import __version__
from app.slam.errors import HemislamError
from app.slam.loops.files import LoopResults, loops_csv
from app.slam.loops.types import Verdict
from app.slam.map_frame import MapFrame
from app.slam.metrics import GroundScore, Trajectory, ate, rpe, write_tum
from app.slam.params import Params
from app.slam.ply import Keyframes, write_map
from app.slam.provenance import describe_machine, hash_input, peak_memory_mb
from app.slam.rows import Rows
from app.slam.trajectory import stamp_text
from app.slam.types import F64, I64, NON_GROUND, STAGES, DroppedScan, FrameStatus, StepResult

RESULT_FILES = ("trajectory.tum", "timings.csv", "map.ply", "report.json")
LOOP_FILES = ("trajectory_odometry.tum", "loops.csv", "graph.g2o")
"""Beside them, if loops were looked for."""
TIMINGS = (*STAGES, "total")
RPE_METRES = (1.0, 10.0, 50.0)
MOST_NOTICES = 200
_SUMS = ("statuses", "dropped", "notices", "points", "ground_points", "ground_score")
"""Attributes of `RunLog` that are no rows."""


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What a run was made from.

    Attributes:
        recording: the input. params: as used last. start_s, duration_s: the part asked for.
        truth: to compare with, and truth_path, its file.
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

    def odometry_of(self, frames: int) -> Trajectory:
        """The same of the first `frames`, be it that some were gone back over."""
        now = len(self)
        self._go_to(frames)
        odometry = self.odometry
        self._go_to(now)
        return odometry


def prepare_folder(folder: Path, *, replace: bool = False) -> None:
    """Make sure that results can be written to `folder`, creating it.

    Raises:
        HemislamError: it holds results and `replace` is not set, or it can not be written to.
    """
    held = [name for name in (*RESULT_FILES, *LOOP_FILES) if (folder / name).exists()]
    if held and not replace:
        raise HemislamError(
            f"{folder} already holds results ({', '.join(held)}); choose another folder or add --force."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HemislamError(f"The folder {folder} can not be made: {error.strerror}; choose another one.") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HemislamError(f"The folder {folder} can not be written to; choose another one.")


def save_results(
    folder: Path,
    log: RunLog,
    keyframes: Keyframes,
    info: RunInfo,
    loops: LoopResults | None = None,
    *,
    replace: bool = False,
) -> dict[str, Any]:
    """Write the result files and return what report.json holds.

    Older results in the folder stay until all new files are complete.

    Args:
        loops: what they made of it; None if none were looked for.

    Raises:
        HemislamError: as `prepare_folder`, or the disk is full or fails.
    """
    prepare_folder(folder, replace=replace)
    frame = loops.frame if loops else MapFrame()
    names = (*RESULT_FILES, *(LOOP_FILES if loops else ()))
    parts = {name: folder / f".{name}.part" for name in names}
    try:
        trajectory = frame.trajectory(log.odometry)
        write_tum(parts["trajectory.tum"], trajectory)
        parts["timings.csv"].write_text(_timings_csv(log), encoding="utf-8")
        map_points = write_map(parts["map.ply"], keyframes, frame)
        report = make_report(log, trajectory, info)
        report["map"] = {"keyframes": len(keyframes), "points": map_points}
        report["loops"] = None
        if loops:
            write_tum(parts["trajectory_odometry.tum"], log.odometry)
            parts["loops.csv"].write_text(loops_csv(loops.edges, loops.stamps_ns), encoding="utf-8")
            parts["graph.g2o"].write_text(loops.g2o, encoding="utf-8")
            report["loops"] = {verdict.value: loops.count(verdict) for verdict in Verdict}
            if info.truth is not None:
                report["accuracy_odometry"] = finite(_accuracy(log.odometry, info))
        parts["report.json"].write_text(json.dumps(report, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        for name, part in parts.items():
            part.replace(folder / name)
        for name in {*LOOP_FILES} - {*names}:
            (folder / name).unlink(missing_ok=True)  # of an older run
    except OSError as error:
        raise HemislamError(f"Results can not be written to {folder}: {error.strerror}.") from error
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
    return report


def summarise(report: dict[str, Any], folder: Path) -> str:
    """The report in a few lines."""
    frames, ground, accuracy = report["frames"], report["ground"], report["accuracy"]
    total = report["timings_ms"]["total"]
    lines = [
        f"frames     {frames['processed']} processed, {frames['dropped']} dropped, {frames['lost']} lost;"
        f" {report['distance_m']:.1f} m walked",
        f"time       {total['median']:.1f} ms a frame (median), {total['p95']:.1f} ms (95 %),"
        f" {total['max']:.1f} ms (max)",
        f"map        {report['map']['points']:,} points in {report['map']['keyframes']} keyframes;"
        f" {100 * (ground['share'] or 0):.0f} % ground",
    ]
    if report["loops"]:
        found = report["loops"]
        lines.append(
            f"loops      {found['accepted']} accepted, {found['candidate']} undecided, {found['rejected']} rejected"
        )
    lines += [f"dropped    {count} x {reason}" for reason, count in frames["dropped_reasons"].items()]
    if ground["f1"] is not None:
        lines.append(
            f"ground     precision {ground['precision'] or 0:.3f}, recall {ground['recall'] or 0:.3f},"
            f" F1 {ground['f1']:.3f} against the recording's labels"
        )
    if accuracy and "error" in accuracy:
        lines.append(f"error      not measured: {accuracy['error']}")
    elif accuracy:
        turned = f", {accuracy['ate_deg']['rmse']:.3f}°" if accuracy["ate_deg"] else ""
        lines.append(
            f"error      ATE {accuracy['ate_m']['rmse']:.4f} m (max {accuracy['ate_m']['max']:.4f}){turned}"
            f" over {accuracy['poses']} poses"
        )
        if accuracy["ate_deg_withheld"]:
            lines.append(f"           no rotation error: {accuracy['ate_deg_withheld']}")
        if (before := report.get("accuracy_odometry")) and "ate_m" in before:
            lines.append(f"           without loops ATE {before['ate_m']['rmse']:.4f} m")
    lines += [f"memory     {report['peak_memory_mb']:.0f} MB at most", f"saved in   {folder}"]
    return "\n".join(lines)


def _timings_csv(log: RunLog) -> str:
    lines = ["frame,stamp_s," + ",".join(f"{stage}_ms" for stage in TIMINGS)]
    for frame, (stamp, row) in enumerate(zip(log.stamps_ns, log.timings_ms, strict=True)):
        lines.append(f"{frame},{stamp_text(int(stamp))}," + ",".join(f"{value:.4f}" for value in row))
    return "\n".join(lines) + "\n"


def make_report(log: RunLog, trajectory: Trajectory, info: RunInfo) -> dict[str, Any]:
    """What report.json holds; numbers that do not exist are null."""
    score = log.ground_score
    report = {
        "hemislam": __version__,
        "stopped_early": info.stopped or None,
        "recording": {
            "path": str(info.recording),
            "sha256": hash_input(info.recording),
            "start_s": info.start_s,
            "duration_s": info.duration_s,
        },
        "frames": {
            "processed": len(log),
            **{status.value: log.statuses[status] for status in FrameStatus},
            "dropped": log.dropped.total(),
            "dropped_reasons": dict(log.dropped.most_common()),
        },
        "distance_m": trajectory.distance,
        "ground": {
            "share": log.ground_points / log.points if log.points else None,
            "precision": score.precision if score else None,
            "recall": score.recall if score else None,
            "f1": score.f1 if score else None,
        },
        "accuracy": _accuracy(trajectory, info),
        "timings_ms": _timing_summary(log),
        "peak_memory_mb": peak_memory_mb(),
        "notices": dict(log.notices.most_common()),
        "machine": describe_machine(),
        "parameters": info.params.model_dump(mode="json"),
    }
    valid: dict[str, Any] = finite(report)
    return valid


def _accuracy(trajectory: Trajectory, info: RunInfo) -> dict[str, Any] | None:
    if info.truth is None:
        return None
    truth = {"truth": str(info.truth_path) if info.truth_path else None}
    try:
        absolute = ate(trajectory, info.truth)
        relative = {"1 frame": rpe(trajectory, info.truth)}
        relative |= {f"{metres:g} m": rpe(trajectory, info.truth, metres=metres) for metres in RPE_METRES}
    except HemislamError as error:
        return truth | {"error": str(error)}
    return truth | {
        "poses": absolute.poses,
        "distance_m": absolute.distance,
        "ate_m": asdict(absolute.position),
        "ate_deg": asdict(absolute.rotation) if absolute.rotation else None,
        "ate_deg_withheld": absolute.doubt or None,
        "rpe": {
            over: {"pairs": error.pairs, "m": asdict(error.position), "deg": asdict(error.rotation)} if error else None
            for over, error in relative.items()
        },
    }


def _timing_summary(log: RunLog) -> dict[str, dict[str, float]]:
    if not len(log):
        return {}
    timings = log.timings_ms
    return {
        stage: {
            "median": float(np.median(timings[:, column])),
            "p95": float(np.percentile(timings[:, column], 95)),
            "max": float(timings[:, column].max()),
        }
        for column, stage in enumerate(TIMINGS)
    }


def finite(value: Any) -> Any:
    """The same tree with NaN and infinity as None, which JSON can hold."""
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
