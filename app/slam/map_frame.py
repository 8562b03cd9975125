"""Where odometry lies in the map: the corrections that loops make, keyframe by keyframe."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam.loops.corrections import corrected
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

PIECE = 1024
"""Frames that are laid into the map at once: all of a long walk would take tens of megabytes for a moment."""


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Corrections of keyframes; without any, map and odometry are one.

    Attributes:
        stamps_ns: (n,) of all keyframes. T_map_odom: (k, 4, 4) at the first k <= n of them; at later
            ones it is that of the last.
    """

    stamps_ns: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    T_map_odom: F64 = field(default_factory=lambda: np.empty((0, 4, 4)))

    def at(self, keyframe: int) -> F64:
        """(4, 4) T_map_odom at a keyframe; a copy, as a result that is kept must not keep all others."""
        count = len(self.T_map_odom)
        return self.T_map_odom[min(keyframe, count - 1)].copy() if count else np.eye(4)

    @property
    def newest(self) -> F64:
        """(4, 4) T_map_odom at the last one."""
        return self.at(len(self.T_map_odom))

    def poses(self, T_odom_imu: F64) -> F64:
        """(k, 4, 4) T_map_imu of the first k keyframes from their (k, 4, 4) T_odom_imu."""
        count = min(len(T_odom_imu), len(self.T_map_odom))
        out = np.empty_like(T_odom_imu)
        out[:count] = self.T_map_odom[:count] @ T_odom_imu[:count]
        out[count:] = self.at(count) @ T_odom_imu[count:]
        return out

    def trajectory(self, odometry: Trajectory) -> Trajectory:
        """In the map. Between two keyframes the correction goes over from one's to the other's."""
        if not len(self.T_map_odom) or not len(odometry):
            return odometry
        pieces = [self._laid(odometry, slice(first, first + PIECE)) for first in range(0, len(odometry), PIECE)]
        positions, quaternions = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
        return Trajectory(odometry.stamps_ns, positions, quaternions)

    def _laid(self, odometry: Trajectory, piece: slice) -> tuple[F64, F64]:
        """Positions and quaternions in the map, of a piece of it."""
        T = np.tile(np.eye(4), (len(odometry.stamps_ns[piece]), 1, 1))
        T[:, :3, :3] = Rotation.from_quat(odometry.quaternions[piece]).as_matrix()
        T[:, :3, 3] = odometry.positions[piece]
        stamps = self.stamps_ns[: len(self.T_map_odom)]
        laid = Trajectory.from_poses(
            odometry.stamps_ns[piece], corrected(odometry.stamps_ns[piece], T, stamps, self.T_map_odom)
        )
        return laid.positions, laid.quaternions
