"""Submaps: the surroundings of a keyframe, from its own cloud and its neighbours'.

The sensor sees only the hemisphere ahead; what lies behind was seen from the keyframes before.
A submap lives in its keyframe's LEVEL frame: origin at the IMU, axes those of `odom`, so z is up
and neighbours only have to be shifted. Poses within a submap are those of odometry, which no
loop changes, so a submap never has to be rebuilt.
"""

import os
import tempfile
from array import array
from dataclasses import dataclass

import numpy as np

from app.slam.errors import writing_to
from app.slam.types import F32, F64, Keyframe
from app.slam.voxel import VoxelGrid

_POINT_BYTES = 12


@dataclass(frozen=True, slots=True)
class Submap:
    """Attributes:
    keyframe: index. points: (n, 3) float32 m, level frame. eyes: (n, 3) m, from where each was seen.
    reach: m around the keyframe.
    """

    keyframe: int
    points: F32
    eyes: F32
    reach: float


class Submaps:
    """Makes submaps from thinned clouds, which it keeps in an unnamed temporary file.

    Args:
        voxel_size: m, of the thinning. near, far: m around the keyframe that a submap may reach.
    """

    def __init__(self, voxel_size: float, near: float, far: float) -> None:
        self._voxel_size, self._near, self._far = voxel_size, near, far
        self._grid = VoxelGrid()
        self._file = tempfile.TemporaryFile(prefix="hemislam-loops-")  # noqa: SIM115 - closed by close()
        self._ends = array("q", [0])  # points up to the end of each cloud: what is near, then the rest

    def append(self, keyframe: Keyframe) -> None:
        """Take the cloud of the next keyframe."""
        with writing_to(None):
            self._file.seek(self._ends[-1] * _POINT_BYTES)
            for points in self._level(keyframe):
                self._file.write(points.tobytes())
                self._ends.append(self._ends[-1] + len(points))
            self._file.flush()

    def truncate(self, count: int) -> None:
        """Forget all clouds but the first `count`."""
        del self._ends[2 * count + 1 :]

    def close(self) -> None:
        self._file.close()

    def around(self, index: int, poses: F64, first: int, last: int, *, far: bool = False) -> Submap:
        """The submap about a keyframe, from the clouds of keyframes `first` to `last`, both included.

        Args:
            poses: (k, 4, 4) T_odom_imu of all keyframes. far: whether it reaches far.
        """
        ends = np.array(self._ends[2 * first : 2 * last + 3])
        begins = ends - ends[0]
        raw = os.pread(self._file.fileno(), int(begins[-1]) * _POINT_BYTES, int(ends[0]) * _POINT_BYTES)
        points = np.frombuffer(bytearray(raw), np.float32).reshape(-1, 3)
        eyes = (poses[first : last + 1, :3, 3] - poses[index, :3, 3]).astype(np.float32)
        for eye, begin, end in zip(eyes, begins[:-1:2], begins[2::2], strict=True):
            points[begin:end] += eye
        reach = self._far if far else self._near
        within = np.einsum("ni,ni->n", points, points) < reach**2
        if not far:
            for begin, end in zip(begins[1::2], begins[2::2], strict=True):
                within[begin:end] = False
        which = np.flatnonzero(within)
        thin = self._grid.downsample(points[which], self._voxel_size)
        seen = np.searchsorted(begins, which[thin.source], side="right") - 1
        return Submap(index, thin.points, eyes[seen // 2], reach)

    def _level(self, keyframe: Keyframe) -> tuple[F32, F32]:
        """One keyframe's own points (n, 3) in its level frame, thinned: the near ones, and the rest."""
        T = keyframe.T_imu_lidar.copy()
        T[:3] = keyframe.T_odom_imu[:3, :3] @ T[:3]
        points = keyframe.cloud.points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        squared = np.einsum("ni,ni->n", points, points)
        near = squared < self._near**2
        both = points[near], points[~near & (squared < self._far**2)]
        inner, outer = (self._grid.downsample(np.ascontiguousarray(part), self._voxel_size).points for part in both)
        return inner, outer
