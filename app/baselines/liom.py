"""LIOM, the paper's second baseline: tightly coupled IMU and LiDAR in a window of scans, refined on a map. No loops.

Written from Ye, Chen and Liu, "Tightly Coupled 3D Lidar Inertial Odometry and Mapping", ICRA 2019. Where the paper
has a factor for each point, all points of a scan form one factor here: their best-fitting pose relative to the window's
first scan, with its information matrix. So the IMU determines the directions that the points do not constrain.
"""

from collections import deque
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from app.baselines.features import extract
from app.baselines.matching import FeatureMap, PoseFit, register
from app.baselines.poses import mounting
from app.slam import lie, start
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.sections import ImuParams
from app.slam.types import F64, ImuSamples, Measurement, NavState

WINDOW = 10
"""Number of scans whose states are estimated jointly; older ones are marginalised."""
MAP_EVERY = 2
"""Number of scans between two refinements on the map."""
ROUNDS = 4
"""How often points are matched again."""
WINDOW_VOXELS_M, MAP_VOXELS_M, MAP_REACH_M = (0.2, 0.3), (0.2, 0.4), 80.0
"""Voxel sizes of edges and of planes, m."""
POINT_NOISE_M = 0.1
"""Sigma of a point's distance to its plane. Neighbours share their plane's error, so it exceeds the sensor's noise."""
UPRIGHT = np.eye(6)[2:]
"""The paper's rotational constraint: the map corrects only heading and position; the IMU observes roll and pitch."""


class Liom:
    """LIOM on one recording. Call `step` with the scans in order."""

    def __init__(self, params: Params) -> None:
        self._params, self._T_imu_lidar = params, mounting(params)
        self._preintegration = _preintegration(params.imu)
        self._still: ImuSamples | None = None
        self._smoother: gtsam.BatchFixedLagSmoother | None = None
        self._index = 0
        self._window: deque[tuple[F64, F64]] = deque(maxlen=WINDOW - 1)  # edges and planes, in the IMU's frame
        self._T_map_odom = np.eye(4)
        self._map = FeatureMap(*MAP_VOXELS_M, MAP_REACH_M)

    def step(self, measurement: Measurement) -> tuple[int, F64]:
        """Process a scan; returns its end in ns and T_odom_imu (4, 4) at that time.

        Raises:
            HemislamError: there is no IMU.
        """
        scan, imu = measurement.scan, measurement.imu
        if not len(imu):
            raise HemislamError("LIOM needs an IMU, and the recording has none.")
        if self._smoother is None:
            started = start.proceed(self._still, scan, imu, self._params)
            self._still = started.still
            if started.waiting:
                return scan.end_ns, started.belief.state.T_odom_imu
            self._begin(started.belief.state)
        summed = self._summed(imu, scan.end_ns)
        state = summed.predict(self._state, self._bias)
        T_last_now = lie.inverse(self._state.pose().matrix()) @ state.pose().matrix()
        motion = lie.inverse(self._T_imu_lidar) @ T_last_now @ self._T_imu_lidar
        features = extract(scan, self._params.sensor.min_range, self._params.sensor.max_range).seen_at_end(motion)
        edges, planes = (lie.moved(self._T_imu_lidar, part.points) for part in (features.edge_map, features.plane_map))
        edges, planes = self._map.thinned(edges, planes)
        self._smooth(summed, state, scan.end_ns, self._relative(edges, planes, state.pose().matrix()))
        self._window.append((edges, planes))
        T_odom_imu = self._state.pose().matrix()
        if self._index % MAP_EVERY == 0:
            self._refine(edges, planes, T_odom_imu)
        return scan.end_ns, self._T_map_odom @ T_odom_imu

    def _begin(self, state: NavState) -> None:
        """Begin the first window from the state at the end of the initialisation."""
        self._bias = gtsam.imuBias.ConstantBias(state.b_accel, state.b_gyro)
        pose = gtsam.Pose3(state.T_odom_imu)
        self._state, self._stamp_ns = gtsam.NavState(pose, state.v_odom_imu), state.stamp_ns
        self._restart(1e-3, 0.1)

    def _restart(self, pose_sigma: float, speed_sigma: float) -> None:
        """Begin a new window from the present state, also after a failure of the smoother. Sigmas: m and rad; m/s."""
        graph, values, k = gtsam.NonlinearFactorGraph(), gtsam.Values(), self._index
        of = gtsam.noiseModel.Isotropic.Sigma
        bias = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05] * 3 + [0.01] * 3))
        graph.addPriorPose3(X(k), self._state.pose(), of(6, pose_sigma))
        graph.addPriorVector(V(k), self._state.velocity(), of(3, speed_sigma))
        graph.addPriorConstantBias(B(k), self._bias, bias)
        _insert(values, k, self._state, self._bias)
        self._window.clear()
        self._smoother = gtsam.BatchFixedLagSmoother(float(WINDOW))
        self._smoother.update(graph, values, {key: float(k) for key in (X(k), V(k), B(k))})

    def _summed(self, imu: ImuSamples, end_ns: int) -> gtsam.PreintegratedCombinedMeasurements:
        """Preintegrate the samples from the last state to `end_ns` (their section III.B)."""
        summed = gtsam.PreintegratedCombinedMeasurements(self._preintegration, self._bias)
        inside = (imu.stamps_ns > self._stamp_ns) & (imu.stamps_ns < end_ns)
        at = (np.concatenate([[self._stamp_ns], imu.stamps_ns[inside], [end_ns]]) - self._stamp_ns) * 1e-9
        have = (imu.stamps_ns - self._stamp_ns) * 1e-9
        middle = 0.5 * (at[1:] + at[:-1])
        gyro, accel = (
            np.stack([np.interp(middle, have, values[:, axis]) for axis in range(3)], axis=1)
            for values in (imu.gyro, imu.accel)
        )
        for rate, force, lasting in zip(gyro, accel, np.diff(at), strict=True):
            if lasting > 0:
                summed.integrateMeasurement(force, rate, lasting)
        return summed

    def _relative(self, edges: F64, planes: F64, T_odom_imu: F64) -> tuple[int, PoseFit] | None:
        """The pose relative to the window's first scan (their section III.C), and which scan that is."""
        if not self._window or self._smoother is None:
            return None
        first = self._index + 1 - len(self._window)
        estimate = self._smoother.calculateEstimate()
        T_first_odom = lie.inverse(estimate.atPose3(X(first)).matrix())
        local = FeatureMap(*WINDOW_VOXELS_M, MAP_REACH_M)
        parts = []
        for k, clouds in enumerate(self._window, first):
            T = T_first_odom @ estimate.atPose3(X(k)).matrix()
            parts.append([lie.moved(T, cloud) for cloud in clouds])
        all_edges, all_planes = (np.concatenate(clouds) for clouds in zip(*parts, strict=True))
        local.insert(all_edges, all_planes, np.zeros(3))
        return first, register(T_first_odom @ T_odom_imu, partial(local.pairs, edges, planes), ROUNDS)

    def _smooth(
        self, summed: gtsam.PreintegratedCombinedMeasurements, predicted: gtsam.NavState, end_ns: int,
        relative: tuple[int, PoseFit] | None,
    ) -> None:  # fmt: skip
        """Add the scan's state and factors, and estimate the window again."""
        assert self._smoother is not None
        graph, values, k = gtsam.NonlinearFactorGraph(), gtsam.Values(), self._index + 1
        graph.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), summed))
        if relative is not None and relative[1].pairs:
            first, fit = relative
            noise = gtsam.noiseModel.Gaussian.Information(_in_body(fit) / POINT_NOISE_M**2 + 1e-6 * np.eye(6))
            graph.add(gtsam.BetweenFactorPose3(X(first), X(k), gtsam.Pose3(fit.T), noise))
        _insert(values, k, predicted, self._bias)
        self._index, self._stamp_ns = k, end_ns
        try:
            self._smoother.update(graph, values, {key: float(k) for key in (X(k), V(k), B(k))})
            estimate = self._smoother.calculateEstimate()
            self._state = gtsam.NavState(estimate.atPose3(X(k)), estimate.atVector(V(k)))
            self._bias = estimate.atConstantBias(B(k))
        except RuntimeError:  # the window has become singular: continue from the prediction
            self._state = predicted
            self._restart(0.1, 1.0)

    def _refine(self, edges: F64, planes: F64, T_odom_imu: F64) -> None:
        """Register to the map, without roll and pitch (their section III.D)."""
        T = register(self._T_map_odom @ T_odom_imu, partial(self._map.pairs, edges, planes), ROUNDS, UPRIGHT).T
        self._T_map_odom = T @ lie.inverse(T_odom_imu)
        self._map.insert(lie.moved(T, edges), lie.moved(T, planes), T[:3, 3])


def _in_body(fit: PoseFit) -> F64:
    """The information (6, 6) of a fit for perturbations in the moving frame, in the order of gtsam's Pose3."""
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = fit.T[:3, :3]
    return np.asarray(turned.T @ fit.information @ turned)


def _preintegration(params: ImuParams) -> gtsam.PreintegrationCombinedParams:
    made = gtsam.PreintegrationCombinedParams.MakeSharedU(params.gravity)
    eye = np.eye(3)
    made.setAccelerometerCovariance(params.accel_noise**2 * eye)
    made.setGyroscopeCovariance(params.gyro_noise**2 * eye)
    made.setBiasAccCovariance(params.accel_bias_walk**2 * eye)
    made.setBiasOmegaCovariance(params.gyro_bias_walk**2 * eye)
    made.setIntegrationCovariance(1e-6 * eye)
    return made


def _insert(values: gtsam.Values, k: int, state: gtsam.NavState, bias: gtsam.imuBias.ConstantBias) -> None:
    values.insert(X(k), state.pose())
    values.insert(V(k), state.velocity())
    values.insert(B(k), bias)
