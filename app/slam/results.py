"""What a session leaves behind: one folder of result files. `EXPORTS` declares them.

`save_results` writes them from the frames of a session, at any moment.
"""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from app.slam import report
from app.slam.errors import HemislamError
from app.slam.loops.files import LoopResults, loops_csv
from app.slam.loops.types import Verdict
from app.slam.map_frame import MapFrame
from app.slam.ply import Keyframes, write_map
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import Trajectory, stamp_text, write_tum
from app.slam.types import F64, I64, TIMINGS


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
    text = json.dumps(results.report, indent=2, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8", errors="backslashreplace")  # of a path that is no UTF-8


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
        lambda path, results: path.write_text(
            timings_csv(results.log.stamps_ns, results.log.timings_ms), encoding="utf-8"
        ),
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


def timings_csv(stamps_ns: I64, timings_ms: F64, more: dict[str, npt.ArrayLike] | None = None) -> str:
    """One line per frame: milliseconds (n, len(TIMINGS)) of each stage; `more` adds columns by name."""
    columns = [timings_ms, *(np.asarray(values)[:, None] for values in (more or {}).values())]
    lines = [",".join(["frame", "stamp_s", *(f"{stage}_ms" for stage in TIMINGS), *(more or {})])]
    for frame, (stamp, row) in enumerate(zip(stamps_ns, np.hstack(columns), strict=True)):
        lines.append(f"{frame},{stamp_text(int(stamp))}," + ",".join(f"{value:.4f}" for value in row))
    return "\n".join(lines) + "\n"
