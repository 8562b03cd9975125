"""Snap a click to the corner, edge or surface near it: the place where the planes around it meet."""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from app.mapping.kept import Spot
from app.server.protocol import Chunk
from app.slam import lie
from app.slam.types import F64
from app.ui.measure_maths import around

_AROUND_M: Final = 0.6
"""Radius around a spot within which planes are searched for."""
_MOVED_M: Final = 0.4
"""Largest distance that a spot is moved."""
_THICK_M: Final = 0.02
"""Points within this distance of a plane belong to it."""
_FEWEST, _LEAST_SHARE = 15, 0.05
"""A plane needs at least this many points, and this share of all points around the spot."""
_TRIALS, _MOST_POINTS, _MOST = 300, 3000, 5
_APART: Final = float(np.sin(np.radians(25.0)))
"""Sine of the smallest angle between planes; at a smaller angle, their intersection is poorly determined."""


def snapped(chunks: tuple[Chunk, ...], poses: F64, spot: Spot) -> Spot:
    """The spot moved to the nearest corner, else to an edge, else onto a surface; unchanged if none is near.

    Args:
        poses: (k, 4, 4) T_map_imu of the chunks' keyframes.
    """
    T = poses[spot.keyframe]
    at = lie.moved(T, spot.at)
    x, y, z = (T[:3, :3].T @ (at + meeting(around(chunks, poses, at, _AROUND_M) - at) - T[:3, 3])).tolist()
    return replace(spot, at=(x, y, z))


def meeting(points: F64) -> F64:
    """(3,) m, the place nearest to the origin where planes through (n, 3) points meet; 0 if there is none nearby."""
    normals, heights = planes(points)
    for count in (3, 2, 1):
        chosen = _apart(normals, count)
        if len(chosen) == count:
            place = np.linalg.lstsq(normals[chosen], heights[chosen], rcond=None)[0]  # the shortest solution
            if np.linalg.norm(place) <= _MOVED_M:
                return np.asarray(place)
    return np.zeros(3)


def _apart(normals: F64, count: int) -> list[int]:
    """The first planes, at most `count`, whose normals are well away from the span of the normals chosen before."""
    chosen: list[int] = []
    for k in range(len(normals)):
        if len(chosen) < count:
            rest = (
                normals[k] - np.linalg.lstsq(normals[chosen].T, normals[k], rcond=None)[0] @ normals[chosen]
                if chosen
                else normals[k]
            )
            if np.linalg.norm(rest) > _APART:
                chosen.append(k)
    return chosen


def planes(points: F64) -> tuple[F64, F64]:
    """The planes with the most of (n, 3) points, found one after the other: normals (k, 3) and heights (k,) m.

    Found by RANSAC (Fischler and Bolles 1981), then fitted by least squares to the points that lie on one plane only.
    """
    rng = np.random.default_rng(0)
    if len(points) > _MOST_POINTS:
        points = points[rng.choice(len(points), _MOST_POINTS, replace=False)]
    fewest, left = max(_FEWEST, _LEAST_SHARE * len(points)), points
    found = list[tuple[F64, float]]()
    while len(left) >= fewest and len(found) < _MOST:
        a, b, c = left[rng.integers(0, len(left), (3, _TRIALS))]
        across = np.cross(b - a, c - a)
        length = np.linalg.norm(across, axis=1)
        across /= np.maximum(length, 1e-12)[:, None]
        near = (np.abs(left @ across.T - (a * across).sum(axis=1)) < _THICK_M) & (length > 1e-6)
        own = near[:, np.argmax(near.sum(axis=0))]
        if own.sum() < fewest:
            break
        found.append(_fitted(left[own]))
        left = left[~_near(left, found)[:, -1]]
    for k in range(len(found)):
        near = _near(points, found)
        own = near[:, k] & (near.sum(axis=1) == 1)
        if own.sum() >= _FEWEST:
            found[k] = _fitted(points[own])
    return np.array([normal for normal, _ in found]).reshape(-1, 3), np.array([height for _, height in found])


def _fitted(points: F64) -> tuple[F64, float]:
    """Normal (3,) and height (m) of the plane through points."""
    middle = points.mean(axis=0)
    normal = np.asarray(np.linalg.svd(points - middle, full_matrices=False)[2][2])
    return normal, float(middle @ normal)


def _near(points: F64, found: list[tuple[F64, float]]) -> npt.NDArray[np.bool_]:
    """(n, k) mask: which of (n, 3) points belong to which plane."""
    return np.stack([np.abs(points @ normal - height) < _THICK_M for normal, height in found], axis=1)
