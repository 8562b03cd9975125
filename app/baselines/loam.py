"""LOAM, the paper's first baseline: scan-to-scan LiDAR odometry, then registration to the map. No IMU, no loops.

Written from Zhang and Singh, "LOAM: Lidar Odometry and Mapping in Real-time", RSS 2014. A scan is undistorted with the
motion before it. The paper solves for motion and distortion together, which oscillates if the scanner sees a wall only
early in each revolution. Single scan-to-scan steps also oscillate if azimuth steps are large: by 0.1 m at rest
outdoors. Therefore the speed is the mean of several steps in the map, to which every scan is registered.
"""

from functools import partial

import numpy as np

from app.baselines.features import Features, extract
from app.baselines.matching import FeatureMap, LastScan, register
from app.baselines.poses import levelled, mounting
from app.slam import lie
from app.slam.params import Params
from app.slam.types import F64, Measurement

ODOMETRY_ROUNDS, MAP_ROUNDS = 5, 4
"""How often points are matched again."""
EDGE_VOXEL_M, PLANE_VOXEL_M, MAP_REACH_M = 0.2, 0.4, 80.0
STEPS = 5
"""Number of scans over which the speed is averaged; in so short a time, a person may turn but hardly changes speed."""


class Loam:
    """LOAM on one recording. `step` takes scans in order and never fails; unconstrained directions are predicted."""

    def __init__(self, params: Params) -> None:
        self._near, self._far = params.sensor.min_range, params.sensor.max_range
        self._T_imu_lidar = mounting(params)
        self._T_odom_map: F64 | None = None  # from the first pose of the LiDAR
        self._last: LastScan | None = None
        self._predicted = np.eye(4)  # T_last_next, from scan end to scan end
        self._T_map_lidar = np.eye(4)
        self._map = FeatureMap(EDGE_VOXEL_M, PLANE_VOXEL_M, MAP_REACH_M)
        self._steps = np.zeros((0, 3))

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        """Process a scan; returns its end in ns and T_odom_imu (4, 4) at that time."""
        scan = measurement.scan
        if self._T_odom_map is None:
            self._T_odom_map = levelled(measurement.imu) @ self._T_imu_lidar
        features = extract(scan, self._near, self._far).seen_at_end(self._predicted)
        motion = self._odometry(features)
        T_map_lidar = self._mapping(features, self._T_map_lidar @ motion)
        step = (lie.inverse(self._T_map_lidar) @ T_map_lidar)[:3, 3]
        self._steps = np.vstack([self._steps, step])[-STEPS:]
        self._predicted = lie.transform(motion[:3, :3], self._steps.mean(axis=0))
        self._last, self._T_map_lidar = LastScan(features.edge_map, features.plane_map), T_map_lidar
        return scan.end_ns, self._T_odom_map @ T_map_lidar @ lie.inverse(self._T_imu_lidar)

    def _odometry(self, features: Features) -> F64:
        """The motion (4, 4) since the last scan's end (section V)."""
        if self._last is None:
            return self._predicted
        pairs = partial(self._last.pairs, features.edges, features.planes)
        return register(self._predicted, pairs, ODOMETRY_ROUNDS).T

    def _mapping(self, features: Features, T: F64) -> F64:
        """Register the undistorted scan to the map, starting at T_map_lidar, and add it to the map (section VI)."""
        edges, planes = self._map.thinned(features.edge_map.points, features.plane_map.points)
        T = register(T, partial(self._map.pairs, edges, planes), MAP_ROUNDS).T
        self._map.insert(lie.moved(T, edges), lie.moved(T, planes), T[:3, 3])
        return T
