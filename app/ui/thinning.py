"""Keeping the page fluid: which points of the map are drawn when there are too many.

Every keyframe is drawn at a level: 0 draws all points it was sent with, each further level one point
per voxel, with edges that double. Levels rise where they are missed least, and depend on nothing but
the points and where the sensor stands, so that two pages of one session show the same.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from app.slam.types import F32, F64, I64

FINEST_VOXEL_M: Final = 0.08
COARSEST_LEVEL: Final = 8
"""At 0.08 m · 2^7 = 10 m a keyframe is down to a handful of points; there is nothing left to thin."""


def voxel_of_level(level: int) -> float:
    """Voxel edge in metres of a level >= 1."""
    return float(FINEST_VOXEL_M * 2 ** (level - 1))


def thinned(points: F32, voxel: float) -> I64:
    """Indices (ascending) of the first point in each voxel of edge `voxel` metres; points (n, 3)."""
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    cells = np.floor(points / np.float32(voxel)).astype(np.int64)
    # 21 bits per axis hold +-1,000,000 voxels: 80 km at the finest edge.
    cells = (cells + (1 << 20)) & 0x1FFFFF
    keys = cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]
    first: I64 = np.unique(keys, return_index=True)[1]
    return np.sort(first)


def strided(count: int, most: int) -> slice:
    """Every k-th of `count` points with the smallest k that leaves at most `most`."""
    return slice(0, count, max(1, -(-count // most)))


def next_to_thin(levels: Sequence[int], positions: F64, sensor: F64) -> int | None:
    """The keyframe that is thinned next, or None when all are at the coarsest level.

    Of those drawn finest it is the one farthest from the sensor, and of equally far ones the oldest.

    Args:
        levels: of each keyframe. positions: (k, 3) m. sensor: (3,) m, in the same frame.
    """
    finest = min(levels, default=COARSEST_LEVEL)
    if finest >= COARSEST_LEVEL:
        return None
    candidates = np.flatnonzero(np.asarray(levels) == finest)
    distances = np.linalg.norm(positions[candidates] - sensor, axis=1)
    return int(candidates[np.argmax(distances)])
