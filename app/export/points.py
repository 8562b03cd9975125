"""The points of a map as a stream, one keyframe at a time, so that memory does not grow with the map.

Only thinning stores data of the whole map: the occupied voxels.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.export.box import Box
from app.slam.errors import HemislamError
from app.slam.kernels.clouds import first_in_voxels, transform
from app.slam.map_frame import MapFrame
from app.slam.ply import Keyframes
from app.slam.types import F32, F64, I64, MOVING, U8, U16, Keyframe


@dataclass(frozen=True, slots=True)
class Choice:
    """Which points of a map are exported.

    Attributes:
        thin: m, edge of voxels; only the first point in each is exported. 0: all points.
        box: only points inside; None: everywhere.
        slab: m, width of a profile's slab along the walked path.
        moving: include points on moving objects.
    """

    thin: float = 0.0
    box: Box | None = None
    slab: float = 1.0
    moving: bool = True

    def __post_init__(self) -> None:
        if not (self.thin == 0 or 0.001 <= self.thin <= 100):
            raise HemislamError(
                f"Voxels of {self.thin:g} m do not thin a map; choose 0.001 to 100 m, or 0 for all points."
            )
        if not 0.01 <= self.slab <= 100:
            raise HemislamError(f"A slab of {self.slab:g} m shows no profile; choose 0.01 to 100 m.")


EVERYTHING = Choice()


@dataclass(frozen=True, slots=True)
class Block:
    """Points of one keyframe in the map.

    Attributes:
        keyframe: index. stamp_ns: end of its scan. T_map_lidar: (4, 4).
        points: (n, 3) float64 m, map. stamps_ns: (n,) of each point.
        labels, intensity, ring: (n,) as in `Cloud`.
    """

    keyframe: int
    stamp_ns: int
    T_map_lidar: F64
    points: F64
    stamps_ns: I64
    labels: U8
    intensity: F32
    ring: U16

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: npt.NDArray[np.bool_]) -> "Block":
        """Only the points where `which` (n,) is true."""
        arrays = ("points", "stamps_ns", "labels", "intensity", "ring")
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})


def blocks(keyframes: Keyframes, frame: MapFrame, choice: Choice) -> Iterator[Block]:
    """The chosen points, placed in the map by `frame`."""
    voxels = Voxels(choice.thin) if choice.thin else None
    for index in range(len(keyframes)):
        block = _block(keyframes[index], frame.at(index))
        if not choice.moving:
            block = block.chosen(block.labels != MOVING)
        if choice.box is not None:
            block = block.chosen(choice.box.holds(block.points))
        yield block if voxels is None else block.chosen(voxels.new(block.points))


def _block(keyframe: Keyframe, T_map_odom: F64) -> Block:
    cloud = keyframe.cloud
    T = T_map_odom @ keyframe.T_odom_imu @ keyframe.T_imu_lidar
    points = np.empty((len(cloud), 3))
    transform(cloud.points, T, points)
    # offsets count from the scan's end; in older stores from its start, where the last point counts as the end
    begin_ns = keyframe.stamp_ns - int(cloud.offsets_ns.max(initial=0))
    stamps_ns = begin_ns + cloud.offsets_ns.astype(np.int64)
    return Block(keyframe.index, keyframe.stamp_ns, T, points, stamps_ns, cloud.labels, cloud.intensity, cloud.ring)


class Voxels:
    """Set of occupied voxels: 8 bytes per slot, at least two slots per voxel."""

    def __init__(self, edge: float) -> None:
        self._edge, self._used = edge, 0
        self._table = np.full(1 << 16, -1, np.int64)

    def new(self, points: F64) -> npt.NDArray[np.bool_]:
        """(n,) mask of the points that are the first in their voxels, which are occupied from now on."""
        cells = np.floor(points / self._edge).astype(np.int64) & 0x1FFFFF
        keys = cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2]
        if 2 * (self._used + len(keys)) > len(self._table):
            held = self._table[self._table >= 0]
            self._table = np.full(1 << math.ceil(math.log2(4 * (self._used + len(keys)))), -1, np.int64)
            first_in_voxels(held, self._table, np.empty(len(held), np.bool_))
        first = np.empty(len(keys), np.bool_)
        self._used += first_in_voxels(keys, self._table, first)
        return first
