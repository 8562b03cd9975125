"""The map as binary PCD 0.7, for the Point Cloud Library."""

from pathlib import Path

import numpy as np

from app.export.map_file import COMMENT, VERTEX, vertices_of
from app.export.results import Results
from app.slam.ply import pcd_header

POINT = np.dtype([(name, VERTEX[name]) for name in ("x", "y", "z", "intensity", "ring", "ground", "moving", "time")])


def write(path: Path, results: Results) -> None:
    """The number of points enters the header at the end."""
    count = 0
    with path.open("wb") as file:
        file.write(pcd_header(POINT, 0, COMMENT))
        for block in results.blocks():
            file.write(vertices_of(block, POINT).data)
            count += len(block)
        file.seek(0)
        file.write(pcd_header(POINT, count, COMMENT))
