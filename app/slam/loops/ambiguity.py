"""Whether a place would fit as well elsewhere, as in corridors and rooms that repeat.

A registration shows that two submaps fit, not that they fit nowhere else. If odometry allows more than one place, the
newer submap is also tried at the others: at the shifts in plan where the walls of the two coincide best.
"""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from app.slam.loops.verification import Fit, Prepared, assess, register
from app.slam.types import F64

CELL_M, CELLS = 0.4, 128
"""Of the plan in which walls are compared; it wraps around, so it is twice as wide as the walls."""
WALL = 0.5
"""Most cosine between a wall's normal and the vertical."""
APART_M = 0.8
"""Alignments nearer to each other than this are the same one."""
LEAST_OVERLAP, MOST_RESIDUAL, RESIDUAL_M = 0.5, 1.6, 0.002
"""An alignment fits as well with at least this share of the overlap and of the points, and at most this many times the
residual plus so many metres. (In a place that does not repeat, wrong alignments leave twice the residual or more.)"""
PEAK_CELLS = 5
"""A shift is a candidate if walls coincide no better at any shift within half this many cells."""
TRIED = 6
"""Shifts from which the newer submap is registered again."""


def nearest_alternative(
    target: Prepared, source: Prepared, fit: Fit, reach_m: float, allowed: Callable[[F64], bool]
) -> float:
    """m to the nearest other alignment that fits as well and that odometry also allows; inf if there is none.

    Args:
        reach_m: how far to look. allowed: whether odometry allows a (4, 4) T_target_source of the level frames.
    """
    if reach_m < APART_M:
        return float("inf")
    at = fit.T_target_source
    moved = source.points @ at[:3, :3].T + at[:3, 3]
    there = _plan(target.points, target)
    here = _plan(moved, source)
    meeting = np.fft.irfft2(np.fft.rfft2(there) * np.fft.rfft2(here).conj(), there.shape)
    offsets = ((np.arange(CELLS) + CELLS // 2) % CELLS - CELLS // 2) * CELL_M
    dx, dy = np.meshgrid(offsets, offsets, indexing="ij")
    away = np.hypot(dx, dy)
    peaks = meeting >= ndimage.maximum_filter(meeting, size=PEAK_CELLS, mode="wrap")  # type: ignore[attr-defined]  # no types
    meeting = np.where(peaks & (away >= APART_M) & (away <= reach_m), meeting, -1.0)
    nearest = float("inf")
    for _ in range(TRIED):
        best = np.unravel_index(int(np.argmax(meeting)), meeting.shape)
        if meeting[best] <= 0:
            break
        meeting[best] = -1.0
        guess = at.copy()
        guess[:2, 3] += dx[best], dy[best]
        T = register(target, source, guess, rough=True)
        apart = float(np.linalg.norm(T[:3, 3] - at[:3, 3]))
        if APART_M / 2 < apart < nearest and allowed(T) and _as_good(assess(target, source, T), fit):
            nearest = apart
    return nearest


def _as_good(other: Fit, fit: Fit) -> bool:
    return (
        len(other.residuals) >= LEAST_OVERLAP * len(fit.residuals)
        and other.overlap >= LEAST_OVERLAP * fit.overlap
        and other.residual_rms <= MOST_RESIDUAL * fit.residual_rms + RESIDUAL_M
    )


def _plan(points: F64, prepared: Prepared) -> F64:
    """(CELLS, CELLS) 1 where there is a wall, in the target's level frame."""
    wall = prepared.flat & (np.abs(prepared.normals[:, 2]) < WALL)
    cells = np.floor(points[wall, :2] / CELL_M).astype(np.int64)
    cells = cells[(np.abs(cells) < CELLS // 2).all(axis=1)] % CELLS
    plan = np.zeros((CELLS, CELLS))
    plan[cells[:, 0], cells[:, 1]] = 1.0
    return plan
