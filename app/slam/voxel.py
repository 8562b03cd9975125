"""Voxel-grid downsampling (paper 2.2, last paragraph)."""

from dataclasses import dataclass

import numpy as np

from app.slam.kernels import clouds
from app.slam.types import F32, I32, U8

_STEPS = np.sqrt([6.0, 11.0, 14.0]) % 1.0
"""Increments of the recurrence along x, y and z. Among the roots of the integers up to 23, these three spread points
most evenly along lines, over planes and in space at once, for shares of 5 to 50 %."""


@dataclass(frozen=True, slots=True)
class Downsampled:
    """Attributes:
    points: (m, 3) float32 m, centroids (or untouched points), in order of first appearance.
    source: (m,) int32, index of the first input point that each one stands for.
    """

    points: F32
    source: I32


class VoxelGrid:
    """Downsamples clouds by centroid. Owns its scratch memory, so that a frame allocates nothing large."""

    def __init__(self) -> None:
        self._reserve(1 << 16)

    def _reserve(self, n: int) -> None:
        size = 1 << int(np.ceil(np.log2(max(2 * n, 2))))
        self._table = np.zeros(size, dtype=np.int32)
        self._stamp = np.zeros(size, dtype=np.int32)
        self._cells = np.empty((n, 3), dtype=np.int32)
        self._sums = np.empty((n, 4))
        self._order = np.empty(n, dtype=np.int32)
        self._generation = 0

    def downsample(self, points: F32, voxel_size: float, chosen: U8 | None = None) -> Downsampled:
        """Replace the points of each voxel by their centroid.

        Args:
            points: (n, 3) float32, finite, within 1e6 voxels of the origin.
            voxel_size: edge in the unit of the points.
            chosen: (n,) uint8; a point with zero is kept as it is. None: all take part.
        """
        n = len(points)
        if n > len(self._order):
            self._reserve(1 << (n - 1).bit_length())
        self._generation += 1
        if chosen is None:
            chosen = np.ones(n, dtype=np.uint8)
        out = np.empty((n, 3), dtype=np.float32)
        m = clouds.centroids(
            points, chosen, voxel_size, self._table, self._stamp, self._generation, self._cells, self._sums,
            self._order, out,
        )  # fmt: skip
        return Downsampled(out[:m], self._order[:m].copy())


def spread(points: F32, most: int, voxel_size: float) -> F32:
    """At most `most` of the points, evenly spread over the space that they fill, in their given order.

    The rank of a point depends on its voxel only. So one point more or less does not change which others are
    taken; with every-k-th sampling it would change every later choice. The rank is an additive recurrence over
    the voxel's indices (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences"), which takes an
    equal share of every part of neighbouring voxels.

    Args:
        points: (n, 3) float32, one for each voxel. voxel_size: edge in the unit of the points.
    """
    if len(points) <= most:
        return points
    x, y, z = np.floor(points.T * np.float64(1.0 / voxel_size))
    place = np.mod(x * _STEPS[0] + y * _STEPS[1] + z * _STEPS[2], 1.0)
    chosen = np.argpartition(place, most - 1)[:most]
    chosen.sort()
    return points[chosen]
