"""Keyframes of a baseline, so that its map can be compared with ours: its scans, undistorted by its own poses."""

import numpy as np

from app.baselines.features import undistorted
from app.baselines.mounting import mounting
from app.slam import lie
from app.slam.keyframes import KeyframeStore, is_due
from app.slam.params import Params
from app.slam.types import F64, NON_GROUND, Cloud, Keyframe, Scan

Stamped = tuple[int, F64]
"""A time in ns and T_odom_imu (4, 4) at it."""


def keep_keyframe(store: KeyframeStore, scan: Scan, now: Stamped, last: Stamped | None, params: Params) -> None:
    """Store the scan if the pose is far enough from that of the last keyframe."""
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
    cloud = Cloud(points.astype(np.float32), labels, scan.intensity, scan.ring, scan.offsets_ns)
    store.append(Keyframe(len(store), -1, stamp_ns, T_odom_imu, T_imu_lidar, np.zeros((6, 6)), cloud))
