"""Light on the points of a keyframe, so that a map reads at first sight: flat things by their slope, edges darker.

Computed once per keyframe, where it is drawn first.
"""

from typing import Final

import numpy as np
from scipy.spatial import KDTree

from app.slam.types import F32, F64, I64

_NEIGHBOURS: Final = 8
_MOST: Final = 2000
"""Points whose normals are computed; the others take their nearest one's light."""
_SUN: Final[F64] = np.array([0.37, -0.53, 0.76])
"""Unit vector towards the light in the map: floors are brightest, walls at right angles to each other differ."""
_LEAST: Final = 0.62
_EDGE: Final = 0.3
"""How much darker points are that lie on no surface."""


def light(points: F32, T_map_lidar: F64) -> F32:
    """(n,) brightness up to 1 of (n, 3) points in random order, in the LiDAR frame, by the normals around them."""
    some = points[:_MOST]
    if len(some) < 2 * _NEIGHBOURS:
        return np.ones(len(points), np.float32)
    tree = KDTree(some)  # type: ignore[no-untyped-call]  # no types
    near = tree.query(some, _NEIGHBOURS)[1]  # type: ignore[no-untyped-call]
    around = some[near].astype(np.float64)
    around -= around.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(around.transpose(0, 2, 1) @ around)
    facing = np.abs(axes[:, :, 0] @ (T_map_lidar[:3, :3].T @ _SUN))
    roughness = 3 * spread[:, 0] / np.maximum(spread.sum(axis=1), 1e-12)
    lit: F32 = ((_LEAST + (1 - _LEAST) * facing) * (1 - _EDGE * roughness)).astype(np.float32)
    if len(points) == len(some):
        return lit
    nearest: I64 = tree.query(points[_MOST:])[1]  # type: ignore[no-untyped-call]
    return np.concatenate((lit, lit[nearest]))
