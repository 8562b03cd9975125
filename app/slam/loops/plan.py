"""Align submaps without a good guess: compare their plans at every shift and turn.

A plan is a raster of upright structure, weighted by its height. Ground fits anywhere; it only shows that nothing stands
there. For each turn, one circular correlation compares two plans at all shifts; heights follow from the ground.
Registration begins at the best few.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from app.slam import lie
from app.slam.kernels import submaps
from app.slam.loops.verification import Prepared
from app.slam.types import F32, F64, I64

CELL_M = 0.4
EDGE = 2.56
"""Edge of a plan, in multiples of its submap's reach. Plans wrap around, so shifts up to `FARTHEST_M` are distinct."""
FARTHEST_M = 11.0
TURN = np.radians(3.0)
"""Step of the turns that are tried; at the rim of a submap it moves a point by a metre."""
TALLEST = 8
"""Further occupied cells in a column do not increase its weight."""
BARE = -0.4
"""Weight of a column with nothing but ground; a column with two occupied cells has weight 1."""
PEAKS = 6
LEAST = 0.4
"""A peak counts if it has at least this share of the highest."""
SAME = 7
"""Size of a neighbourhood, in turns and in cells along both axes, in which only the highest peak counts."""


@dataclass(frozen=True, slots=True)
class Window:
    """Where to look: m in plan, and rad about the vertical, on either side of a guess."""

    reach_m: float
    turn: float


EVERYWHERE = Window(FARTHEST_M, np.pi)


def placements(target: Prepared, source: Prepared, T_guess: F64, window: Window) -> list[F64]:
    """Alignments (4, 4) T_target_source of the level frames from which to register, the likeliest first."""
    steps = min(int(np.ceil(window.turn / TURN)), round(np.pi / TURN))
    position = T_guess[:3, 3].copy()
    yaws = np.arctan2(T_guess[1, 0], T_guess[0, 0]) + np.arange(-steps, steps + 1) * TURN
    reach = int(np.ceil(min(window.reach_m, FARTHEST_M) / CELL_M))
    shifts = np.arange(-reach, reach + 1)
    cells = round(EDGE * max(target.submap.reach, source.submap.reach) / CELL_M)
    spectrum = fft.rfft2(_plan(target, 0.0, np.zeros(3), cells))
    alike = np.empty((len(yaws), len(shifts), len(shifts)), np.float32)
    for index, yaw in enumerate(yaws):
        turned = fft.rfft2(_plan(source, yaw, position, cells))
        rows = fft.ifft(spectrum * turned.conj(), axis=0, overwrite_x=True)[shifts]
        alike[index] = fft.irfft(rows, cells)[:, shifts]
    alike[:, np.hypot(shifts[:, None], shifts) > reach] = 0.0
    found = np.argwhere(alike > LEAST * alike.max())
    found = found[submaps.highest(alike, found, SAME // 2)]
    best = found[np.argsort(-alike[tuple(found.T)], kind="stable")[:PEAKS]]
    moves = CELL_M * np.column_stack([best[:, 1:] - reach, np.zeros(len(best))])
    return [
        _on_ground(target, source, _upright(yaws[k], position + shift), cells)
        for k, shift in zip(best[:, 0], moves, strict=True)
    ]


def _plan(prepared: Prepared, yaw: float, position: F64, cells: int) -> F32:
    """(cells, cells) of a submap turned about the vertical and moved; the origin is in the first cell."""
    plan = np.empty((cells, cells), np.float32)
    submaps.columns(prepared.points, prepared.level, prepared.upright, yaw, position, CELL_M, BARE, TALLEST, plan)
    return plan


def _on_ground(target: Prepared, source: Prepared, T: F64, cells: int) -> F64:
    """The same, raised or lowered until the source's ground lies on the target's."""
    below, above = target.points[target.level], lie.moved(T, source.points[source.level])
    there, here = _cells(below, cells), _cells(above, cells)
    count = np.bincount(there, minlength=cells * cells)
    height = np.bincount(there, below[:, 2], cells * cells)
    both = count[here] > 0
    if both.any():
        T[2, 3] -= np.median(above[both, 2] - height[here[both]] / count[here[both]])
    return T


def _cells(points: F64, cells: int) -> I64:
    index = np.floor(points[:, :2] / CELL_M).astype(np.int64) % cells
    return np.asarray(index[:, 0] * cells + index[:, 1])


def _upright(yaw: float, position: F64) -> F64:
    return lie.transform(lie.exp(np.array([0.0, 0.0, yaw])), position)
