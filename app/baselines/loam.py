"""LOAM, the paper's first baseline: LiDAR odometry at scan rate, and mapping at a lower rate. No IMU, no loops.

Written from Zhang and Singh, "LOAM: Lidar Odometry and Mapping in Real-time", RSS 2014. A scan is freed of its
distortion by the motion of the scan before. The paper solves for the motion and the distortion together, which on a
scanner that sees a wall only early in each turn swings up from scan to scan.
"""

import numpy as np

from app.baselines.features import Features, extract
from app.baselines.matching import FeatureMap, LastScan, moved, solve
from app.baselines.mounting import levelled, mounting
from app.slam import lie
from app.slam.params import Params
from app.slam.types import F64, Measurement

MAP_EVERY = 2
"""Scans between two registrations to the map."""
ODOMETRY_ROUNDS, MAP_ROUNDS = 5, 4
"""Times that points are matched anew."""
EDGE_VOXEL_M, PLANE_VOXEL_M, MAP_REACH_M = 0.2, 0.4, 80.0


class Loam:
    """LOAM on one recording. `step` takes scans in order and never fails; what a scan leaves open is predicted."""

    def __init__(self, params: Params) -> None:
        self._near, self._far = params.sensor.min_range, params.sensor.max_range
        self._T_imu_lidar = mounting(params)
        self._T_odom_start: F64 | None = None  # of the LiDAR
        self._last: LastScan | None = None
        self._motion = np.eye(4)  # T_last_next, from scan end to scan end
        self._T_start_lidar = np.eye(4)  # by odometry alone
        self._T_map_start = np.eye(4)
        self._map = FeatureMap(EDGE_VOXEL_M, PLANE_VOXEL_M, MAP_REACH_M)
        self._scans = 0

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        """Process a scan; returns its end in ns and T_odom_imu (4, 4) at that time."""
        scan = measurement.scan
        if self._T_odom_start is None:
            self._T_odom_start = levelled(measurement.imu) @ self._T_imu_lidar
        features = extract(scan, self._near, self._far).seen_at_end(self._motion)
        self._odometry(features)
        self._last = LastScan(features.edge_map, features.plane_map)
        if self._scans % MAP_EVERY == 0:
            self._mapping(features.edge_map.points, features.plane_map.points)
        self._scans += 1
        T_map_lidar = self._T_map_start @ self._T_start_lidar
        return scan.end_ns, self._T_odom_start @ T_map_lidar @ lie.inverse(self._T_imu_lidar)

    def _odometry(self, features: Features) -> None:
        """Section V: the motion since the last scan's end, predicted as the motion before (constant velocity)."""
        if self._last is None:
            return
        T = self._motion
        for _ in range(ODOMETRY_ROUNDS):
            fit = solve(T, self._last.pairs(features.edges, features.planes, T))
            change = lie.log_se3(lie.inverse(T) @ fit.T)
            T = fit.T
            if np.linalg.norm(change) < 1e-3:
                break
        self._motion = T
        self._T_start_lidar = self._T_start_lidar @ T

    def _mapping(self, edges: F64, planes: F64) -> None:
        """Section VI: register the undistorted scan to the map, and correct the odometry's drift by what was found."""
        T = self._T_map_start @ self._T_start_lidar
        few = self._map.thinned(edges, planes)
        for _ in range(MAP_ROUNDS):
            fit = solve(T, self._map.pairs(*few, T))
            change = lie.log_se3(lie.inverse(T) @ fit.T)
            T = fit.T
            if np.linalg.norm(change) < 1e-3:
                break
        self._T_map_start = T @ lie.inverse(self._T_start_lidar)
        self._map.insert(moved(T, few[0]), moved(T, few[1]), T[:3, 3])
