"""Reads a folder of results, to export it in other formats."""

import json
from pathlib import Path

import numpy as np

from app.export.map_file import MapFile
from app.export.results import Results
from app.georeference import reference
from app.slam.errors import HemislamError
from app.slam.frames import READOUTS, Frame
from app.slam.loops.files import LoopResults
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import read_tum


def read_results(folder: Path) -> Results:
    """Read the results for exports. The trajectory is that of the map, with loops.

    A georeference that cannot be used is left out, and `Results.problem` says why.

    Raises:
        HemislamError: the folder does not hold the map and the trajectory of a run, or they cannot be read.
    """
    for name in ("map.ply", "trajectory.tum"):
        if not (folder / name).is_file():
            raise HemislamError(f"{folder} has no {name}; name a folder that hemislam run has written, or a session.")
    trajectory, graph = read_tum(folder / "trajectory.tum"), folder / "graph.g2o"
    nothing = np.full(len(READOUTS), np.nan)
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.positions, trajectory.quaternions, strict=True)
    log = RunLog([Frame(stamp_ns, False, position, quaternion, nothing) for stamp_ns, position, quaternion in rows])
    try:
        g2o = graph.read_text(encoding="utf-8") if graph.exists() else None
    except (OSError, ValueError):
        g2o = None
    loops = LoopResults(MapFrame(), np.empty(0, np.int64), (), g2o) if g2o is not None else None
    info = RunInfo(recording_of(folder) or folder, Params())
    where, problem = reference.read(folder)
    return Results(log, MapFile(folder / "map.ply"), info, loops, where=where, problem=problem)


def recording_of(folder: Path) -> Path | None:
    """The recording from which the results in a folder were made; None if no report.json names it."""
    try:
        return Path(json.loads((folder / "report.json").read_bytes())["recording"]["path"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
