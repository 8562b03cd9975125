"""The transform from odometry to the map: the corrections that loops make, keyframe by keyframe."""

from dataclasses import dataclass, field

import numpy as np

from app.slam import lie
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

NO_PAUSES = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Corrections of keyframes. Without any, the map frame is the odometry frame.

    Attributes:
        stamps_ns: (n,) of all keyframes.
        T_map_odom: (k, 4, 4) at the first k <= n of them. The last one holds at all later keyframes.
        pauses_ns: (m,) when each pause of the recording ended; nothing is interpolated across one.
    """

    stamps_ns: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    T_map_odom: F64 = field(default_factory=lambda: np.empty((0, 4, 4)))
    pauses_ns: I64 = field(default_factory=lambda: NO_PAUSES)

    @classmethod
    def levelling(cls, g_map: F64) -> "MapFrame":
        """The rotation about the origin, not in heading, that makes gravity, (3,) in the map so far, point along -z."""
        down = np.array([0.0, 0.0, -1.0])
        turn = lie.transform(lie.between(g_map, down), np.zeros(3))
        return cls(np.zeros(1, np.int64), turn[None]) if np.cross(g_map, down).any() else cls()

    def at(self, keyframe: int) -> F64:
        """(4, 4) T_map_odom at a keyframe."""
        count = len(self.T_map_odom)
        return self.T_map_odom[min(keyframe, count - 1)].copy() if count else np.eye(4)

    @property
    def newest(self) -> F64:
        """(4, 4) T_map_odom at the last keyframe."""
        return self.at(len(self.T_map_odom))

    def over(self, frame: "MapFrame") -> "MapFrame":
        """These corrections applied after those of another frame, which lead from odometry to this one."""
        if not len(self.T_map_odom):
            return frame
        count = max(len(self.T_map_odom), len(frame.T_map_odom))
        stamps_ns, pauses_ns = (
            max(pair, key=len) for pair in ((self.stamps_ns, frame.stamps_ns), (self.pauses_ns, frame.pauses_ns))
        )
        return MapFrame(stamps_ns, np.array([self.at(k) @ frame.at(k) for k in range(count)]), pauses_ns)

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
        poses = corrected(odometry.stamps_ns, odometry.poses, stamps_ns, self.T_map_odom, self.pauses_ns)
        return Trajectory.from_poses(odometry.stamps_ns, poses)


def corrected(
    stamps_ns: I64, T_odom_imu: F64, keyframe_stamps_ns: I64, corrections: F64, pauses_ns: I64 = NO_PAUSES
) -> F64:
    """(n, 4, 4) T_map_imu of frames, by the keyframes' corrections interpolated in time.

    Before the first keyframe its correction applies, after the last keyframe that of the last; without keyframes,
    odometry stays. Across a pause nothing is interpolated: each side takes the correction of its nearest keyframe.

    Args:
        stamps_ns: (n,) of the frames. T_odom_imu: (n, 4, 4).
        keyframe_stamps_ns: (k,) ascending. corrections: (k, 4, 4) T_map_odom at each keyframe.
        pauses_ns: (m,) ascending, as in `MapFrame`.
    """
    if not len(keyframe_stamps_ns):
        return T_odom_imu.copy()
    after = np.clip(np.searchsorted(keyframe_stamps_ns, stamps_ns), 0, len(keyframe_stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    between = (keyframe_stamps_ns[after] - keyframe_stamps_ns[before]).astype(np.float64)
    passed = (stamps_ns - keyframe_stamps_ns[before]).astype(np.float64)
    share = np.clip(passed / np.where(between > 0, between, 1.0), 0.0, 1.0)
    begun, ended = (np.searchsorted(pauses_ns, keyframe_stamps_ns[side]) for side in (before, after))
    share = np.where(begun < ended, np.searchsorted(pauses_ns, stamps_ns, side="right") == ended, share)
    # Corrections are expressed AT the frame's position before they are interpolated. About the origin, a correction of
    # a distant pose is a turn and a large shift that nearly cancel, and their interpolation would swing in between.
    here = T_odom_imu.copy()
    here[:, :3, :3] = np.eye(3)
    first = lie.inverse(here) @ corrections[before] @ here
    change = lie.inverse(first) @ lie.inverse(here) @ corrections[after] @ here
    return np.asarray(here @ first @ lie.exp_se3(share[:, None] * lie.log_se3(change)) @ lie.inverse(here) @ T_odom_imu)
