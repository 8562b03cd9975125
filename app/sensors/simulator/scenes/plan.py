"""Shapes in plan: outlines, paths, and what floors look like to a laser."""

from collections.abc import Callable, Sequence

import numpy as np

from app.slam.types import F64

Corners = Sequence[tuple[float, float]] | F64
"""A closed polygon in plan, m."""


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    """Corners, counter-clockwise."""
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def stroll(corners: Corners) -> F64:
    """(n, 2) waypoints a metre apart round a closed polygon, its corners cut."""
    points: list[F64] = []
    outline = np.array(corners, np.float64)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        points.extend(a + (b - a) / length * s for s in np.arange(0.7, length - 0.5, 1.0))
    return np.array(points)


def level(xy: F64) -> F64:
    """A flat floor."""
    return np.zeros(len(xy))


def tiled(reflectivity: float, size: float = 0.6) -> Callable[[F64], F64]:
    """Floor tiles, each other one a little brighter."""

    def shade(xy: F64) -> F64:
        odd = np.floor(xy / size).sum(axis=1) % 2
        return np.asarray(reflectivity * (1.0 + 0.2 * odd))

    return shade


def distance_to_path(xy: F64, path: F64) -> F64:
    """(n,) m from (n, 2) points to a closed polyline of (m, 2) waypoints."""
    nearest = np.full(len(xy), np.inf)
    for a, b in zip(path, np.roll(path, -1, axis=0), strict=True):
        share = np.clip((xy - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(xy - a - share[:, None] * (b - a), axis=1))
    return nearest
