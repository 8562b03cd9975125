"""The ground threshold against range, with the points under and over it."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from app.slam.study import point_numbers
from app.slam.types import F64, StepResult

MOST_POINTS: Final = 1200
HEADROOM: Final = 3.0
"""Points up to so many thresholds above the plane are shown; walls and ceilings would leave nothing of the rest."""
_LEAST_M: Final = 2.0


@dataclass(frozen=True, slots=True)
class Curve:
    """Attributes:
    range: (n,) m, ascending. under, over: (n,) cm, |distance to the plane|, nan in the one that a point is not of.
    threshold: (n,) cm. points_under, points_over: of all points, also those not shown.
    """

    range: F64
    under: F64
    over: F64
    threshold: F64
    points_under: int
    points_over: int


def curve(result: StepResult | None, sigma: float, most: int = MOST_POINTS) -> Curve:
    """Of one frame; without points where it has no plane."""
    numbers = point_numbers(result.cloud.points, result) if result is not None else None
    if numbers is None or not np.isfinite(numbers.distance).all() or not len(numbers.range):
        nothing = np.full(2, np.nan)
        ends = np.array([0.0, 10.0])
        return Curve(ends, nothing, nothing, 100 * sigma * ends, 0, 0)
    distance, threshold = np.abs(numbers.distance), sigma * numbers.range
    under = distance < threshold
    farthest = max(_LEAST_M, 1.15 * float(np.percentile(numbers.range[under], 98)) if under.any() else 10.0)
    shown = np.flatnonzero((numbers.range < farthest) & (distance < HEADROOM * sigma * farthest))
    shown = shown[np.argsort(numbers.range[shown], kind="stable")]
    shown = shown[np.unique(np.arange(min(len(shown), most)) * len(shown) // max(min(len(shown), most), 1))]
    cm = 100 * distance[shown]
    # the ends belong to the line alone
    return Curve(
        range=np.concatenate(([0.0], numbers.range[shown], [farthest])),
        under=np.concatenate(([np.nan], np.where(under[shown], cm, np.nan), [np.nan])),
        over=np.concatenate(([np.nan], np.where(under[shown], np.nan, cm), [np.nan])),
        threshold=100 * sigma * np.concatenate(([0.0], numbers.range[shown], [farthest])),
        points_under=int(np.count_nonzero(under)),
        points_over=int(np.count_nonzero(~under)),
    )
