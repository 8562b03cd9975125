"""Odometry packages from PyPI as baselines, with their own defaults and the true mounting of the sensor.

Each package is imported only when needed: `app.baselines.systems` first adds its folder to the path.
"""

from typing import Any

import numpy as np

from app.baselines.poses import levelled, mounting
from app.slam import lie
from app.slam.params import Params
from app.slam.types import F64, I64, Measurement


class _Icp:
    """LiDAR-only odometry in the LiDAR's first frame; `step` returns poses of the IMU in a world with z up."""

    in_middle = False
    """Whether its poses refer to the middle of scans instead of their end."""

    def __init__(self, params: Params, odometry: Any) -> None:
        self._odometry, self._T_imu_lidar = odometry, mounting(params)
        self._T_odom_start: F64 | None = None  # of the LiDAR

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        scan = measurement.scan
        self._odometry.register_frame(
            scan.points.astype(np.float64), scan.offsets_ns / max(int(scan.offsets_ns.max()), 1)
        )
        if self._T_odom_start is None:
            self._T_odom_start = levelled(measurement.imu) @ self._T_imu_lidar
        T = np.asarray(self._T_odom_start @ np.asarray(self._odometry.last_pose) @ lie.inverse(self._T_imu_lidar))
        return (scan.stamp_ns + scan.end_ns) // 2 if self.in_middle else scan.end_ns, T


class KissIcp(_Icp):
    """KISS-ICP: Vizzo et al., RA-L 2023."""

    def __init__(self, params: Params) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.data.max_range, config.data.min_range = params.sensor.max_range, params.sensor.min_range
        config.mapping.voxel_size = config.data.max_range / 100.0  # the package's own rule
        super().__init__(params, KissICP(config))


class GenzIcp(_Icp):
    """GenZ-ICP: Lee, Lim and Han, RA-L 2025."""

    in_middle = True

    def __init__(self, params: Params) -> None:
        from genz_icp.config import GenZConfig
        from genz_icp.genz_icp import GenZICP

        config = GenZConfig()
        config.data.max_range, config.data.min_range = params.sensor.max_range, params.sensor.min_range
        config.data.deskew = True
        super().__init__(params, GenZICP(config))


class RkoLio:
    """RKO-LIO: Malladi et al., 2025. Its poses are those of the IMU at the scans' ends."""

    def __init__(self, params: Params) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        self._odometry, self._T_imu_lidar, self._last_ns = LIO(LIOConfig()), mounting(params), -1

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        scan, imu = measurement.scan, measurement.imu
        for stamp, gyro, accel in zip(imu.stamps_ns, imu.gyro, imu.accel, strict=True):
            if stamp > self._last_ns:
                self._odometry.add_imu_measurement(accel, gyro, int(stamp), np.eye(4))
                self._last_ns = int(stamp)
        stamps: I64 = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
        self._odometry.register_scan(scan.points.astype(np.float64), stamps, self._T_imu_lidar)
        return scan.end_ns, np.array(self._odometry.pose())
