"""Submaps: the surroundings of a keyframe, from its own cloud and its neighbours'.

The sensor sees only the hemisphere ahead; what lies behind was seen from the keyframes before.
A submap lives in its keyframe's LEVEL frame: origin at the IMU, axes those of `odom`, so z is up
and neighbours only have to be shifted. Poses within a submap are the odometry's, which no loop
changes, so a submap never has to be made again.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from app.slam.keyframes import KeyframeStore
from app.slam.types import F32, F64, Keyframe
from app.slam.voxel import VoxelGrid

KEPT_CLOUDS = 256
"""Thinned clouds, some 70 kB each, that stay in memory; others are read again."""

K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Submap:
    """Attributes:
    keyframe: index. points: (n, 3) float32 m, level frame. eyes: (n, 3) m, from where each was seen.
    """

    keyframe: int
    points: F32
    eyes: F32


class Recent(Generic[K, V]):
    """The `size` values that were used last; others are made again by `make`."""

    def __init__(self, size: int, make: Callable[[K], V]) -> None:
        self._size, self._make = size, make
        self._values: OrderedDict[K, V] = OrderedDict()

    def __getitem__(self, key: K) -> V:
        if key in self._values:
            self._values.move_to_end(key)
        else:
            self[key] = self._make(key)
        return self._values[key]

    def __setitem__(self, key: K, value: V) -> None:
        self._values[key] = value
        if len(self._values) > self._size:
            self._values.popitem(last=False)

    def clear(self) -> None:
        self._values.clear()


class Submaps:
    """Makes submaps from the keyframes on disk, reading few.

    Args:
        keyframes: where clouds come from. voxel_size: m, of the thinning. radius: m around the
            keyframe that a submap reaches.
    """

    def __init__(self, keyframes: KeyframeStore, voxel_size: float, radius: float) -> None:
        self._keyframes = keyframes
        self._voxel_size, self._radius = voxel_size, radius
        self._grid = VoxelGrid()
        self._clouds: Recent[int, F32] = Recent(KEPT_CLOUDS, lambda index: self._level(keyframes[index]))

    def offer(self, keyframe: Keyframe) -> None:
        """Take a cloud that is in memory already, so that it need not be read."""
        self._clouds[keyframe.index] = self._level(keyframe)

    def around(self, index: int, poses: Sequence[F64], first: int, last: int) -> Submap:
        """The submap about a keyframe, from the clouds of keyframes `first` to `last`, both included.

        Args:
            poses: (4, 4) T_odom_imu of all keyframes.
        """
        centre = poses[index][:3, 3]
        clouds, eyes = [], []
        for other in range(first, last + 1):
            eye = (poses[other][:3, 3] - centre).astype(np.float32)
            points = self._clouds[other] + eye
            clouds.append(points[np.einsum("ni,ni->n", points, points) < self._radius**2])
            eyes.append(np.broadcast_to(eye, clouds[-1].shape))
        thin = self._grid.downsample(np.concatenate(clouds), self._voxel_size)
        return Submap(index, thin.points, np.concatenate(eyes)[thin.source])

    def clear(self) -> None:
        """Forget all clouds: keyframes may be others from now on."""
        self._clouds.clear()

    def _level(self, keyframe: Keyframe) -> F32:
        """(n, 3) one keyframe's own points in its level frame, thinned."""
        T = keyframe.T_imu_lidar.copy()
        T[:3] = keyframe.T_odom_imu[:3, :3] @ T[:3]
        points = keyframe.cloud.points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        near = points[np.einsum("ni,ni->n", points, points) < self._radius**2]
        return self._grid.downsample(np.ascontiguousarray(near), self._voxel_size).points
