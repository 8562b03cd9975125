"""A baseline's mounting, its first pose, and its keyframes, so that its map can be compared with ours."""

import numpy as np

from app.baselines.features import undistorted
from app.slam import lie
from app.slam.keyframes import KeyframeStore, is_due
from app.slam.params import Params
from app.slam.types import F64, NON_GROUND, Cloud, ImuSamples, Keyframe, Scan

Stamped = tuple[int, F64]
"""A time in ns and T_odom_imu (4, 4) at it."""


def mounting(params: Params) -> F64:
    """T_imu_lidar (4, 4), according to the parameters."""
    R = lie.from_rpy_degrees(params.sensor.rotation)
    return lie.transform(R, np.array(params.sensor.translation, np.float64))


def levelled(samples: ImuSamples) -> F64:
    """T_odom_imu (4, 4) of the first pose: at the origin, with z opposite to the gravity in the samples."""
    up = samples.accel.mean(axis=0) if len(samples) else np.array([0.0, 0.0, 1.0])
    return lie.transform(lie.between(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))


def keep_keyframe(store: KeyframeStore, scan: Scan, now: Stamped, last: Stamped | None, params: Params) -> None:
    """Store the scan, undistorted with these poses, if its pose is far enough from the last keyframe's."""
    stamp_ns, T_odom_imu = now
    T_last = store[len(store) - 1].T_odom_imu if len(store) else None
    if not is_due(T_last, T_odom_imu, params.keyframe):
        return
    T_imu_lidar = mounting(params)
    points = scan.points.astype(np.float64)
    if last is not None:  # at the velocity since the pose before
        motion = lie.inverse(T_imu_lidar) @ lie.inverse(last[1]) @ T_odom_imu @ T_imu_lidar
        shares = (scan.offsets_ns + float(scan.stamp_ns - last[0])) / (stamp_ns - last[0])
        points = undistorted(points, shares, motion)
    n = len(points)
    labels = np.full(n, NON_GROUND, np.uint8)
    offsets_ns = scan.offsets_ns - np.int32(stamp_ns - scan.stamp_ns)
    cloud = Cloud(points.astype(np.float32), labels, scan.intensity, scan.ring, offsets_ns)
    store.append(Keyframe(len(store), -1, stamp_ns, T_odom_imu, T_imu_lidar, np.zeros((6, 6)), cloud))
