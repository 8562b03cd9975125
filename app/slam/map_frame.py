"""Where odometry lies in the map: the corrections that loops make, keyframe by keyframe."""

from dataclasses import dataclass, field

import numpy as np

from app.slam.loops.corrections import corrected
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Corrections of keyframes. Without any, the map frame is the odometry frame.

    Attributes:
        stamps_ns: (n,) of all keyframes.
        T_map_odom: (k, 4, 4) at the first k <= n of them. The last one holds at all later keyframes.
    """

    stamps_ns: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    T_map_odom: F64 = field(default_factory=lambda: np.empty((0, 4, 4)))

    def at(self, keyframe: int) -> F64:
        """(4, 4) T_map_odom at a keyframe."""
        count = len(self.T_map_odom)
        return self.T_map_odom[min(keyframe, count - 1)].copy() if count else np.eye(4)

    @property
    def newest(self) -> F64:
        """(4, 4) T_map_odom at the last keyframe."""
        return self.at(len(self.T_map_odom))

    def first_change(self, before: "MapFrame") -> int:
        """The first keyframe whose correction may differ from the one that it had `before` in the same session."""
        count = min(len(self.T_map_odom), len(before.T_map_odom))
        differ = (self.T_map_odom[:count] != before.T_map_odom[:count]).any(axis=(1, 2))
        return int(np.argmax(differ)) if differ.any() else count

    def poses(self, T_odom_imu: F64) -> F64:
        """(k, 4, 4) T_map_imu of the first k keyframes from their (k, 4, 4) T_odom_imu."""
        count = min(len(T_odom_imu), len(self.T_map_odom))
        out = np.empty_like(T_odom_imu)
        out[:count] = self.T_map_odom[:count] @ T_odom_imu[:count]
        out[count:] = self.at(count) @ T_odom_imu[count:]
        return out

    def trajectory(self, odometry: Trajectory) -> Trajectory:
        """The trajectory in the map. Between two keyframes the correction is interpolated."""
        if not len(self.T_map_odom) or not len(odometry):
            return odometry
        stamps_ns = self.stamps_ns[: len(self.T_map_odom)]
        poses = corrected(odometry.stamps_ns, odometry.poses, stamps_ns, self.T_map_odom)
        return Trajectory.from_poses(odometry.stamps_ns, poses)
