"""The map as binary PCD 0.7, for the Point Cloud Library."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.slam.types import NON_GROUND

if TYPE_CHECKING:
    from app.export.results import Results

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("ground", "u1"), ("time", "<f8")]
)
_LETTERS = {"f": "F", "u": "U"}


def write(path: Path, results: "Results") -> None:
    """The number of points enters the header at the end."""
    count = 0
    with path.open("wb") as file:
        file.write(_header(0))
        for block in results.blocks():
            points = np.empty(len(block), POINT)
            points["x"], points["y"], points["z"] = block.points.T
            points["intensity"], points["ring"] = block.intensity, block.ring
            points["ground"], points["time"] = block.labels != NON_GROUND, block.stamps_ns * 1e-9
            file.write(points.tobytes())
            count += len(points)
        file.seek(0)
        file.write(_header(count))


def _header(count: int) -> bytes:
    kinds = [POINT[name] for name in POINT.names or ()]
    lines = [
        "# .PCD v0.7 - hemislam map, metres, z up",
        "VERSION 0.7",
        f"FIELDS {' '.join(POINT.names or ())}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(_LETTERS[kind.kind] for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count:012d}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count:012d}",
        "DATA binary",
    ]
    return "\n".join([*lines, ""]).encode("ascii")
