"""Prediction without an IMU: the device goes on, and turns on, as fast as it did.

The angular velocity is held by the state as the bias of a gyroscope that reads zero, so the filter corrects it as it
corrects any bias. Gravity is the normal of the floor where one is seen.
"""

from dataclasses import replace

import numpy as np

from app.slam import ground, lie
from app.slam.imu import BA, BG, DIM, EXT_POS, EXT_ROT, GRAV, POS, ROT, VEL, Belief, Path
from app.slam.params import Params
from app.slam.types import F64, NavState, Scan

PUSHED, TURNED = 1.5, 1.0
"""m/s², rad/s²: standard deviations of how a walking person's hand accelerates."""
FIRST_SPEED, FIRST_RATE = 1.5, 1.0
"""m/s, rad/s: standard deviations before the first two scans are compared."""
KNOT_S = 0.0025
UPRIGHT = np.array([[0.0, 0.0, 1.0]])
FORWARD = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
"""What may be up in the LiDAR frame: of a scanner held upright, and of a hemispherical one that looks forward."""
BELOW_DEG = -3.0
"""A LiDAR that sees lower than this is one that is held upright."""


def begin(scan: Scan, params: Params) -> Belief:
    """Belief at the first scan's begin; odom's z is the normal of the floor that the scan shows, if it shows one."""
    R_imu_lidar = lie.from_rpy_degrees(params.sensor.rotation)
    up = R_imu_lidar @ _up(scan, params)
    sigma = np.zeros(DIM)
    sigma[ROT] = sigma[POS] = 1e-4
    sigma[VEL], sigma[BG], sigma[BA], sigma[GRAV] = FIRST_SPEED, FIRST_RATE, 1e-3, 1e-3
    sigma[EXT_ROT] = sigma[EXT_POS] = 1e-6
    state = NavState(
        stamp_ns=scan.stamp_ns,
        R_odom_imu=lie.between(up, np.array([0.0, 0.0, 1.0])),
        p_odom_imu=np.zeros(3),
        v_odom_imu=np.zeros(3),
        b_gyro=np.zeros(3),
        b_accel=np.zeros(3),
        g_odom=np.array([0.0, 0.0, -params.imu.gravity]),
        R_imu_lidar=R_imu_lidar,
        p_imu_lidar=np.array(params.sensor.translation, dtype=np.float64),
    )
    return Belief(state, np.diag(sigma**2))


def propagate(belief: Belief, end_ns: int) -> tuple[Belief, Path]:
    """Carry the belief forward to `end_ns` at constant velocity and angular velocity."""
    state = belief.state
    dt = max((end_ns - state.stamp_ns) * 1e-9, 1e-6)
    times = np.linspace(-dt, 0.0, int(np.ceil(dt / KNOT_S)) + 1)
    rate = -state.b_gyro
    R = np.stack([state.R_odom_imu @ lie.exp(rate * (t + dt)) for t in times])
    p = state.p_odom_imu + (times + dt)[:, None] * state.v_odom_imu
    F, Q = np.eye(DIM), np.zeros((DIM, DIM))
    F[ROT, ROT], F[ROT, BG], F[POS, VEL] = lie.exp(-rate * dt), -dt * np.eye(3), dt * np.eye(3)
    for value, change, size, sign in ((ROT, BG, TURNED, -1.0), (POS, VEL, PUSHED, 1.0)):
        Q[value, value], Q[change, change] = (size * dt**2 / 2) ** 2 * np.eye(3), (size * dt) ** 2 * np.eye(3)
        Q[value, change] = Q[change, value] = sign * size**2 * dt**3 / 2 * np.eye(3)
    moved = replace(state, stamp_ns=end_ns, R_odom_imu=R[-1], p_odom_imu=p[-1])
    return Belief(moved, F @ belief.covariance @ F.T + Q), Path(times, np.concatenate([R, p[:, :, None]], axis=2))


def _up(scan: Scan, params: Params) -> F64:
    """Up in the LiDAR frame: as such a scanner is usually held, made exact by the floor. The nearer plane is the floor,
    the farther one a ceiling."""
    heights = scan.points[:, 2] / np.maximum(np.linalg.norm(scan.points, axis=1), 1e-3)
    lowest = np.degrees(np.arcsin(np.percentile(heights, 0.5))) if len(heights) else 0.0
    guesses = UPRIGHT if lowest < BELOW_DEG else FORWARD
    floors = [ground.segment(scan.points, scan.ring, -up, params.ground) for up in guesses]
    found = [floor for floor in floors if floor.found]
    if not found:
        return np.asarray(guesses[0])
    floor = min(found, key=lambda plane: abs(plane.centroid @ plane.normal))
    again = ground.segment(scan.points, scan.ring, -floor.normal, params.ground)
    return again.normal if again.found else floor.normal
