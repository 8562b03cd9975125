"""The result files of a session, in one folder. `EXPORTS` declares them.

`save_results` writes them from the frames of a session, at any moment.
"""

import contextlib
import importlib.util
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from app.export import map_file
from app.export.results import Results
from app.georeference import ledger, reference
from app.slam import report
from app.slam.errors import HemislamError
from app.slam.loops.files import loops_csv, moved_g2o
from app.slam.loops.types import Verdict
from app.slam.map_frame import NO_PAUSES
from app.slam.provenance import hash_input
from app.slam.text_files import make_folder, write_texts
from app.slam.trajectory import stamp_text, write_tum
from app.slam.types import F64, I64, TIMINGS

EXTRAS = {"e57": ("pye57",), "plan": ("ezdxf", "rasterio")}
"""Modules that the extras of the package install."""


@dataclass(frozen=True, slots=True)
class Export:
    """One result file.

    Attributes:
        name: of the file. meaning: its content, for help texts and the documentation.
        write: writes it to a path.
        format: its name in `hemislam export --format`; "" if it only belongs to a run.
        by_run: whether every run writes it. of_loops: whether it exists only if loops were searched.
        extra: the extra of the package that it needs. on_earth: whether it needs a georeference.
    """

    name: str
    meaning: str
    write: Callable[[Path, Results], object]
    format: str = ""
    by_run: bool = True
    of_loops: bool = False
    extra: str = ""
    on_earth: bool = False


def _later(module: str, function: str) -> Callable[[Path, Results], object]:
    """A writer from a module that is imported only when needed."""
    return lambda path, results: getattr(importlib.import_module(f"app.export.{module}"), function)(path, results)


def _wanted(format: str, name: str, meaning: str, writer: str, extra: str = "", *, on_earth: bool = False) -> Export:
    """A file that is written only on request, by `module.function`."""
    return Export(name, meaning, _later(*writer.split(".")), format, by_run=False, extra=extra, on_earth=on_earth)


def _drawn(kind: str, suffix: str) -> Export:
    """A section of the box, or a profile of the walk, in one drawing format."""
    meaning = "the box, seen from its front" if kind == "section" else "along the walk: chainage and height"

    def write(path: Path, results: Results) -> None:
        files = importlib.import_module("app.export.section_files")
        getattr(files, f"write_{suffix}")(path, results, getattr(results, kind))

    return Export(f"{kind}.{suffix}", meaning, write, kind, by_run=False, extra="plan" if suffix == "dxf" else "")


def _write_map(path: Path, results: Results) -> None:
    points, moving = map_file.write(path, results.blocks())
    results.report["map"] = {"keyframes": len(results.keyframes), "points": points, "moving": moving}


def _write_loops(path: Path, results: Results) -> None:
    assert results.loops is not None
    path.write_text(loops_csv(results.loops.edges, results.loops.stamps_ns), encoding="utf-8")


def _write_graph(path: Path, results: Results) -> None:
    assert results.loops is not None
    path.write_text(moved_g2o(results.loops.g2o, results.adjustment), encoding="utf-8")


def _write_report(path: Path, results: Results) -> None:
    loops, info = results.loops, results.info
    tied_ns = loops.tied_ns if loops else NO_PAUSES
    made = report.make_report(results.log, results.trajectory, info, results.sha256.result(), tied_ns)
    made |= {"map": results.report.get("map"), "levelled_deg": round(results.levelled_deg, 4)}
    if results.found is not None or results.problem:
        made["georeference"] = ledger.report(results.found) if results.found else {"problem": results.problem}
    made["loops"] = {verdict.value: loops.count(verdict) for verdict in Verdict} if loops else None
    if loops and info.truth is not None:
        made["accuracy_odometry"] = report.accuracy(results.log.odometry, info)
    results.report = report.finite(made)
    text = json.dumps(results.report, indent=2, ensure_ascii=False) + "\n"
    path.write_text(text, encoding="utf-8", errors="backslashreplace")  # the path may not be UTF-8


EXPORTS = (
    Export(
        "trajectory.tum",
        "pose of the IMU in the map at the end of each scan: stamp x y z qx qy qz qw",
        lambda path, results: write_tum(path, results.trajectory),
        format="tum",
    ),
    Export(
        "trajectory_odometry.tum",
        "the same by odometry alone, without loops",
        lambda path, results: write_tum(path, results.log.odometry),
        of_loops=True,
    ),
    Export("loops.csv", "every loop candidate: verdict, measurements and reason", _write_loops, of_loops=True),
    Export("graph.g2o", "the pose graph of the keyframes", _write_graph, format="g2o", of_loops=True),
    Export(
        "timings.csv",
        "milliseconds of each stage in each frame, except reading the recording",
        lambda path, results: path.write_text(
            timings_csv(results.log.stamps_ns, results.log.timings_ms), encoding="utf-8"
        ),
    ),
    Export("map.ply", "the map: x y z intensity ground moving ring time; keyframes", _write_map, format="ply"),
    Export("report.json", "parameters, frame counts, ground share, errors against the truth", _write_report),
    _wanted("las", "map.las", "the map as LAS 1.4: time, intensity, ring, ground, moving", "las.write_las"),
    _wanted("laz", "map.laz", "the map as LAZ: compressed LAS", "las.write_laz"),
    _wanted("e57", "map.e57", "the map as E57: one scan with its pose per keyframe", "e57.write", "e57"),
    _wanted("pcd", "map.pcd", "the map as PCD: intensity ring ground moving time", "map_file.write_pcd"),
    _wanted("kitti", "trajectory.kitti", "poses as rows of 12 numbers, without stamps", "paths.write_kitti"),
    _wanted("csv", "trajectory.csv", "poses with easting, northing, height if known", "paths.write_csv"),
    _wanted("gpx", "trajectory.gpx", "the walk as a GPX track", "paths.write_gpx", on_earth=True),
    _wanted("occupancy", "occupancy.pgm", "occupancy grid for nav2: free, wall, unknown", "plan.write_pgm", "plan"),
    _wanted("occupancy", "occupancy.yaml", "position of the grid in the map", "plan.write_yaml", "plan"),
    _wanted("floor", "floor.png", "floor plan: a slice 1 to 1.5 m above the ground", "plan.write_floor_png", "plan"),
    _wanted("floor", "floor.pgw", "position of the floor plan, as a world file", "plan.write_world_file", "plan"),
    _wanted("dxf", "floor.dxf", "the floor plan as outlines", "plan.write_dxf", "plan"),
    _wanted("terrain", "terrain.tif", "height of the ground as GeoTIFF", "plan.write_terrain", "plan"),
    _wanted("density", "density.tif", "points per square metre as GeoTIFF", "plan.write_density", "plan"),
    *(_drawn(kind, suffix) for kind in ("section", "profile") for suffix in ("png", "svg", "dxf")),
    _wanted("kmz", "map.kmz", "walk, picture and keyframes for Google Earth", "google_earth.write", on_earth=True),
    _wanted("html", "share.html", "the map in one page that needs no server", "share.write"),
)
"""All result files, in writing order. report.json is the last file of a run, because it counts the points."""
BY_RUN = tuple(export for export in EXPORTS if export.by_run)
FORMATS = tuple(dict.fromkeys(export.format for export in EXPORTS if export.format))


def of_formats(formats: Sequence[str]) -> tuple[Export, ...]:
    """The exports of these formats, in their order.

    Raises:
        HemislamError: there is no such format, or a package that it needs is not installed.
    """
    if unknown := sorted(set(formats) - set(FORMATS)):
        raise HemislamError(f"There is no format {unknown[0]}; choose from {', '.join(FORMATS)}.")
    chosen = tuple(export for export in EXPORTS if export.format in formats and export.format)
    for export in chosen:
        if any(importlib.util.find_spec(module) is None for module in EXTRAS.get(export.extra, ())):
            raise HemislamError(f"{export.name} needs more: run `pip install 'hemislam[{export.extra}]'`.")
    return chosen


@contextlib.contextmanager
def results_folder(folder: Path, *, replace: bool = False) -> Iterator[None]:
    """Create a folder for the results made in this context; if it is empty at the end, remove it.

    Raises:
        HemislamError: the folder holds results and `replace` is not set, or it is not writable.
    """
    new = make_folder(folder)
    held = [export.name for export in BY_RUN if (folder / export.name).exists()]
    if held and not replace:
        raise HemislamError(
            f"{folder} already holds results ({', '.join(held)}); choose another folder, or add --force on the command"
            " line to replace them."
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HemislamError(f"The folder {folder} is not writable; choose another one.")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # a folder is not empty
            for made in new:
                made.rmdir()


def save_results(
    folder: Path, results: Results, exports: Sequence[Export] = BY_RUN, *, replace: bool = False
) -> dict[str, Any]:
    """Write these result files and return what report.json holds.

    Older results in the folder stay until all new files are complete.

    Raises:
        HemislamError: as `results_folder`, or the disk is full or fails, or a file needs a georeference.
    """
    with results_folder(folder, replace=replace):
        return _write_results(folder, results, exports)


def _write_results(folder: Path, results: Results, exports: Sequence[Export]) -> dict[str, Any]:
    """As `save_results`, into an existing folder."""
    written = [export for export in exports if results.loops or not export.of_loops]
    if not written:
        raise HemislamError(f"There is no {exports[0].name}, because the loop search is off; set loops.enabled.")
    if results.where is None and (lost := [export.name for export in written if export.on_earth]):
        unknown = f"{lost[0]} needs a georeferenced map; use Georeference in the page, or `hemislam georeference`."
        raise HemislamError(results.problem or unknown)
    parts, show = {export.name: folder / f".{export.name}.part" for export in written}, results.progress
    beside = ThreadPoolExecutor(1, "hash")
    try:
        if "report.json" in parts:
            results.sha256 = beside.submit(hash_input, results.info.recording)
        for number, export in enumerate(written):
            results.progress = _progress_of(number, len(written), show)
            export.write(parts[export.name], results)
        if {"map.ply", "trajectory.tum"} & parts.keys() and (results.where is None or results.found is not None):
            for name in (reference.FILE, reference.RESIDUALS, reference.PLOT):
                (folder / name).unlink(missing_ok=True)  # of an older map
            if results.found is not None:
                write_texts(folder, ledger.files(results.found))
        for export in exports:
            if export in written:
                parts[export.name].replace(folder / export.name)
            else:
                (folder / export.name).unlink(missing_ok=True)  # of an older run
    except OSError as error:
        raise HemislamError(f"Results cannot be written to {folder}: {error.strerror or error}.") from error
    finally:
        beside.shutdown()
        results.progress = show
        for part in parts.values():
            part.unlink(missing_ok=True)
    return results.report


def _progress_of(file: int, files: int, show: Callable[[float], None]) -> Callable[[float], None]:
    """Progress over all files. It never decreases, although some files read the points several times."""
    most = 0.0

    def tell(share: float) -> None:
        nonlocal most
        most = max(most, share)
        show((file + most) / files)

    return tell


def timings_csv(stamps_ns: I64, timings_ms: F64, more: dict[str, npt.ArrayLike] | None = None) -> str:
    """One line per frame: milliseconds (n, len(TIMINGS)) of each stage; `more` adds columns by name."""
    columns = [timings_ms, *(np.asarray(values)[:, None] for values in (more or {}).values())]
    lines = [",".join(["frame", "stamp_s", *(f"{stage}_ms" for stage in TIMINGS), *(more or {})])]
    for frame, (stamp, row) in enumerate(zip(stamps_ns, np.hstack(columns), strict=True)):
        lines.append(f"{frame},{stamp_text(int(stamp))}," + ",".join(f"{value:.4f}" for value in row))
    return "\n".join(lines) + "\n"
