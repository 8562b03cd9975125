"""What loops make of the poses between keyframes."""

import numpy as np

from app.slam import lie
from app.slam.loops import se3
from app.slam.types import F64, I64


def corrected(stamps_ns: I64, T_odom_imu: F64, keyframe_stamps_ns: I64, corrections: F64) -> F64:
    """(n, 4, 4) T_map_imu of frames, their corrections interpolated by time between the keyframes' ones.

    Before the first keyframe its correction holds, after the last one that one's; with none, odometry stays.

    Args:
        stamps_ns: (n,) of the frames. T_odom_imu: (n, 4, 4).
        keyframe_stamps_ns: (k,) ascending. corrections: (k, 4, 4) T_map_odom at each keyframe.
    """
    if not len(keyframe_stamps_ns):
        return T_odom_imu.copy()
    after = np.clip(np.searchsorted(keyframe_stamps_ns, stamps_ns), 0, len(keyframe_stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    between = (keyframe_stamps_ns[after] - keyframe_stamps_ns[before]).astype(np.float64)
    passed = (stamps_ns - keyframe_stamps_ns[before]).astype(np.float64)
    share = np.clip(passed / np.where(between > 0, between, 1.0), 0.0, 1.0)
    # interpolated between the corrected poses' differences from odometry AT the frame, so that a correction far from
    # the origin, a turn and a large shift that nearly cancel, does not swing in between
    here = T_odom_imu.copy()
    here[:, :3, :3] = np.eye(3)
    first = lie.inverse(here) @ corrections[before] @ here
    change = lie.inverse(first) @ lie.inverse(here) @ corrections[after] @ here
    return np.asarray(here @ first @ se3.exp(share[:, None] * se3.log(change)) @ lie.inverse(here) @ T_odom_imu)
