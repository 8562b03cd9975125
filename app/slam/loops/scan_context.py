"""Scan Context (Kim and Kim, IROS 2018): a place as rings times sectors around it.

Differences from the paper, for a scanner that sees a hemisphere, also indoors:
- A cell holds how many height bins are occupied, not the greatest height: under a ceiling the
  greatest height is the same everywhere, while walls and furniture still stand out.
- Cells that were never seen are masked: they count for neither side of the distance.
- Columns are counted from odom's x axis, not from the heading. So going back the other way gives the same columns, and
  the best shift is the drift of the heading. All shifts are compared at once, by circular correlation.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, F64, Mask

RINGS, SECTORS = 20, 60
RADIUS = 20.0
"""Radius of the outermost ring, m."""
HEIGHTS = (-2.0, 6.0, 0.4)
"""Height bins relative to the IMU: from, to, step, m."""
_BINS = round((HEIGHTS[1] - HEIGHTS[0]) / HEIGHTS[2])
SECTOR = 2 * np.pi / SECTORS
YAWS: F64 = (np.arange(SECTORS, dtype=np.float64) * SECTOR + np.pi) % (2 * np.pi) - np.pi
"""(SECTORS,) rad: the rotation R_a_b about z that corresponds to each shift of b's columns."""
LEAST_COMMON = 0.4
"""At a shift, at least this share of the smaller context's seen cells must be seen in both."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanContext:
    """Attributes:
    cells: (RINGS, SECTORS), square root of the share of occupied height bins; 0 where unseen.
    seen: (RINGS, SECTORS), whether anything is known.
    ring_key: (RINGS,), mean over each ring's seen cells; it does not depend on heading.
    """

    cells: F32
    seen: Mask
    ring_key: F32 = field(init=False)

    def __post_init__(self) -> None:
        key = self.cells.sum(axis=1) / np.maximum(self.seen.sum(axis=1), 1)
        object.__setattr__(self, "ring_key", key.astype(np.float32))


def describe(points: F32) -> ScanContext:
    """The context of a submap's points (n, 3), level frame."""
    radius = np.hypot(points[:, 0], points[:, 1])
    height = np.floor((points[:, 2] - HEIGHTS[0]) / HEIGHTS[2]).astype(np.int64)
    inside = (radius < RADIUS) & (height >= 0) & (height < _BINS)
    x, y = points[inside, 0], points[inside, 1]
    ring = np.minimum((radius[inside] * (RINGS / RADIUS)).astype(np.int64), RINGS - 1)
    sector = np.floor(np.arctan2(y, x) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    occupied = np.zeros((RINGS, SECTORS, _BINS), dtype=np.bool_)
    occupied[ring, sector, height[inside]] = True
    filled = occupied.sum(axis=2)
    # a sector has been seen as far as its farthest return; nothing is known behind it
    seen = np.cumsum(filled[::-1], axis=0)[::-1] > 0
    return ScanContext(np.sqrt(filled / _BINS).astype(np.float32), seen)


def shift_distances(a: ScanContext, b: ScanContext) -> F64:
    """(SECTORS,) distance of b, its columns shifted by s, to a: 1 - cosine over the cells seen in both."""
    cells_a, cells_b, seen_a, seen_b = a.cells, b.cells, a.seen, b.seen
    fa, fb = np.fft.rfft(cells_a, axis=1), np.fft.rfft(cells_b, axis=1)
    fa2, fb2 = np.fft.rfft(cells_a**2, axis=1), np.fft.rfft(cells_b**2, axis=1)
    ma, mb = np.fft.rfft(seen_a, axis=1), np.fft.rfft(seen_b, axis=1)

    def correlate(left: npt.NDArray[np.complex128], right: npt.NDArray[np.complex128]) -> F64:
        return np.asarray(np.fft.irfft((left * right.conj()).sum(axis=0), SECTORS))

    norms = np.sqrt(np.maximum(correlate(fa2, mb), 0.0) * np.maximum(correlate(ma, fb2), 0.0))
    common = correlate(ma, mb) / max(min(int(seen_a.sum()), int(seen_b.sum())), 1)
    usable = (common >= LEAST_COMMON) & (norms > 1e-9)
    cosine = correlate(fa, fb) / np.where(usable, norms, 1.0)
    return np.where(usable, np.clip(1.0 - cosine, 0.0, 1.0), 1.0)
