"""The effect of slow drift on values estimated from fixes: consecutive fixes share the same drift.

Drift of the map, and of the receiver, is modelled as a random walk. Its rate follows from the differences between the
mean residuals of successive stretches, beyond their noise.
"""

from typing import Final

import numpy as np
from scipy.linalg import solveh_banded

from app.slam.arrays import F64

_STRETCH_S: Final = 8.0
_FEWEST: Final = 3
"""Least number of fixes of a stretch."""
_LEAST_RATE: Final = 1e-3**2
"""m²/s: least rate assumed when constants are estimated. Drift by millimetres hardly shows in fixes of centimetres, but
one millimetre along the walk looks like a clock offset of one millisecond. Maps by a clean sensor outdoors drift by a
quarter of this, others by up to 3 mm/√s, which does show."""


def constants_despite_drift(
    residuals: F64, J: F64, seconds: F64, sigmas: F64, values: F64, expected: F64
) -> tuple[F64, F64]:
    """Least squares with drift among the unknowns, free in each fix, so that only what repeats is a constant.

    Args:
        residuals: (n, 3) m, at these seconds (n,), ascending. J: (n, 3, k) their change with the constants.
        sigmas: (n, 3) m, noise of the fixes; if consecutive fixes differ by more, that is taken as the noise.
        values: (k,) of the constants so far. expected: (k,) how far from zero they may be; inf if unlimited.

    Returns:
        (k,) change of the constants, and its covariance (k, k).
    """
    noise = max(1.0, float(np.sqrt((np.diff(residuals / sigmas, axis=0) ** 2).mean() / 2)))
    stiff = 1.0 / (max(_rate(residuals, seconds), _LEAST_RATE) * np.maximum(np.diff(seconds), 1e-3))
    between = np.r_[0.0, stiff] + np.r_[stiff, 0.0]  # the precision of a random walk has three diagonals
    information, pull = np.diag(expected**-2.0), expected**-2.0 * values
    for axis in range(3):
        weights = (noise * sigmas[:, axis]) ** -2
        known = np.column_stack([J[:, axis], residuals[:, axis]]) * weights[:, None]
        drift = solveh_banded(np.array([np.r_[0.0, -stiff], between + weights]), known)
        rest = known - weights[:, None] * drift
        information += J[:, axis].T @ rest[:, :-1]
        pull += J[:, axis].T @ rest[:, -1]
    covariance: F64 = np.asarray(np.linalg.inv(information), np.float64)
    return -covariance @ pull, covariance


def drift_deviations(residuals: F64, influence: F64, seconds: F64) -> F64:
    """(k,) standard deviations of unknowns due to the drift that residuals show.

    Args:
        residuals: (n, 3) m, at these seconds (n,), ascending. influence: (n, 3, k) change of the unknowns per metre.
    """
    later = influence[::-1].cumsum(axis=0)[::-1][1:]  # a step of the random walk moves all later fixes
    per_rate = np.einsum("nak,n->k", later**2, np.diff(seconds))
    return np.asarray(np.sqrt(_rate(residuals, seconds) * per_rate))


def _rate(residuals: F64, seconds: F64) -> float:
    """Variance that a random walk gains in each direction, m²/s; 0 if the residuals (n, 3) m show none."""
    stretch = ((seconds - seconds[0]) // _STRETCH_S).astype(np.int64)
    count = np.bincount(stretch)
    enough = count >= _FEWEST
    sums = np.stack([np.bincount(stretch, axis) for axis in residuals.T], axis=1)
    means = sums / np.maximum(count, 1)[:, None]
    squares = np.bincount(stretch, ((residuals - means[stretch]) ** 2).sum(axis=1))
    noise = squares / np.maximum(count * (count - 1), 1)
    pairs = enough[1:] & enough[:-1]
    if not pairs.any():
        return 0.0
    beyond = (np.diff(means, axis=0) ** 2).sum(axis=1) - noise[1:] - noise[:-1]
    return max(0.0, float(beyond[pairs].mean()) / (3 * 2 / 3 * _STRETCH_S))
