"""Shading of a keyframe's points that makes a map easier to read: surfaces by their orientation, edges darker.

Computed once per keyframe, at the pose where it is first drawn, in cells that grow with distance like the gaps
between the points of a scan.
"""

from typing import Final

import numpy as np

from app.slam.types import F32, F64

_CELL: Final = 0.12
"""Least ratio of a cell's edge to its distance from the sensor; the ratio is at most twice this."""
_NEAR_M: Final = 2.5
_LEAST_POINTS: Final = 6
"""In cells with fewer points, no plane is fitted."""
_SUN: Final[F64] = np.array([0.37, -0.53, 0.76])
"""Unit vector towards the light in the map: floors are brightest, and perpendicular walls differ."""
_LEAST: Final = 0.62
_EDGE: Final = 0.3
"""How much darker points are that do not lie on a surface."""


def light(points: F32, T_map_lidar: F64) -> F32:
    """(n,) brightness up to 1 of (n, 3) points in the LiDAR frame, from the plane through the points of each cell."""
    if not len(points):
        return np.ones(0, np.float32)
    cell, counts = _cells(points)
    some = np.flatnonzero(counts >= _LEAST_POINTS)
    x = points.T.astype(np.float64)
    sums = np.stack([np.bincount(cell, axis) for axis in x])[:, some] / counts[some]
    spread = np.empty((len(some), 3, 3))
    for i, j in zip(*np.triu_indices(3), strict=True):
        spread[:, i, j] = spread[:, j, i] = np.bincount(cell, x[i] * x[j])[some] / counts[some] - sums[i] * sums[j]
    sizes, axes = np.linalg.eigh(spread)
    facing = np.abs(axes[:, :, 0] @ (T_map_lidar[:3, :3].T @ _SUN))
    roughness = 3 * np.maximum(sizes[:, 0], 0.0) / np.maximum(sizes.sum(axis=1), 1e-12)
    lit = np.full(len(counts), _LEAST + (1 - _LEAST) / 2)
    lit[some] = (_LEAST + (1 - _LEAST) * facing) * (1 - _EDGE * roughness)
    return np.asarray(lit[cell], np.float32)


def _cells(points: F32) -> tuple[np.ndarray, np.ndarray]:
    """(n,) cell of each point, and (m,) number of points per cell."""
    distance = np.maximum(np.linalg.norm(points, axis=1), _NEAR_M)
    level = np.floor(np.log2(distance / _NEAR_M))
    at = np.floor(points / (_CELL * _NEAR_M * np.exp2(level))[:, None]).astype(np.int64) + (1 << 13)
    keys = ((level.astype(np.int64) << 14 | at[:, 0]) << 14 | at[:, 1]) << 14 | at[:, 2]
    _, cell, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return cell, counts
