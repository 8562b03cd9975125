"""The map as binary PCD 0.7, for the Point Cloud Library."""

from pathlib import Path

import numpy as np

from app.export.results import Results
from app.slam.ply import pcd_header
from app.slam.types import MOVING, is_ground

POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ring", "<u2"),
        ("ground", "u1"),
        ("moving", "u1"),
        ("time", "<f8"),
    ]
)
_COMMENT = "hemislam map, metres, z up"


def write(path: Path, results: Results) -> None:
    """The number of points enters the header at the end."""
    count = 0
    with path.open("wb") as file:
        file.write(pcd_header(POINT, 0, _COMMENT))
        for block in results.blocks():
            points = np.empty(len(block), POINT)
            points["x"], points["y"], points["z"] = block.points.T
            points["intensity"], points["ring"] = block.intensity, block.ring
            points["ground"], points["moving"] = is_ground(block.labels), block.labels == MOVING
            points["time"] = block.stamps_ns * 1e-9
            file.write(points.tobytes())
            count += len(points)
        file.seek(0)
        file.write(pcd_header(POINT, count, _COMMENT))
