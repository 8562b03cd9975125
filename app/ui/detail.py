"""How much of a large map is drawn: as many points as a page can show, most of them where someone looks from nearby.

The points of a keyframe are in random order, so its first half is the same surfaces with half the points.
"""

from typing import Final

import numpy as np

from app.slam.types import F64, I64

_NEAR_M: Final = 3.0
_COARSEST: Final = -12.0
"""The least share of a keyframe's points, as a power of two."""


def parts(counts: I64, positions: F64, eyes: F64, most: int) -> I64:
    """(k,) how many of each keyframe's points to draw, at most `most` in all; all of them, if these are no more.

    A keyframe twice as far away has a quarter of the points: in the picture they are as dense. Shares are powers of a
    half, so that few keyframes change as an eye moves.

    Args:
        counts: (k,) points of each keyframe. positions: (k, 3) m. eyes: (e, 3) m, where cameras are.
    """
    if counts.sum() <= most:
        return counts
    away = np.linalg.norm(positions[:, None] - eyes[None], axis=2).min(axis=1, initial=1e6)
    density = -2 * np.log2(np.maximum(away, _NEAR_M))

    def drawn(level: float) -> I64:
        shares = np.exp2(np.clip(np.floor(density + level), _COARSEST, 0.0))
        return np.asarray(counts * shares, np.int64)

    low, high = 0.0, 2 * np.log2(1e6) + 1
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if drawn(middle).sum() <= most else (low, middle)
    return drawn(low)
