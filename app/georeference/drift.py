"""What slow drift adds to the uncertainty of what fixes determine: it is the same in fixes that follow one another.

Drift of the map, and of the receiver, is taken for a random walk. Its rate is what the means of the residuals over
stretches differ from one to the next beyond their noise.
"""

from typing import Final

import numpy as np

from app.slam.arrays import F64

_STRETCH_S: Final = 8.0
_FEWEST: Final = 3
"""Fixes of a stretch."""


def drift_deviations(residuals: F64, influence: F64, seconds: F64) -> F64:
    """(k,) standard deviations of unknowns by the drift that residuals show.

    Args:
        residuals: (n, 3) m, at these seconds (n,), ascending. influence: (n, 3, k) change of the unknowns per metre.
    """
    later = influence[::-1].cumsum(axis=0)[::-1][1:]  # a step of the walk moves all that comes later
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
