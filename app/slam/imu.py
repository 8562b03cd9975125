"""Propagation through IMU samples, and deskew by backward propagation (paper 2.3)."""

from dataclasses import dataclass, replace

import numpy as np

from app.slam import lie
from app.slam.clock import USUAL_S
from app.slam.gyroscope import GYRO_SCALE
from app.slam.kernels import manifold, motion
from app.slam.params import Params
from app.slam.sections import ImuParams
from app.slam.types import F32, F64, ImuSamples, NavState, Scan

DIM = 23
ROT, POS, VEL, BG, BA, GRAV, EXT_ROT, EXT_POS = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15), slice(15, 17), slice(17, 20), slice(20, 23),
)  # fmt: skip
"""Order of the 23 error dimensions: rotation (IMU frame), position, velocity (odom), gyro bias, accel
bias, gravity (2, tangent of S²), extrinsic rotation (LiDAR frame), extrinsic translation (IMU frame)."""
POSE, MOTION, EXT = slice(0, 6), slice(0, 9), slice(17, 23)
"""Pose; pose and velocity; extrinsics."""

MAX_KNOT_STEP = 0.0025
"""s between two poses of a path; poses in between are interpolated linearly."""
LONG_GAP = 0.4
"""s, half the time of a step. Over a longer gap the accelerations at both ends do not determine the velocity."""
GAP_RATE, GAP_NOISE = 1.0, 1.0
"""rad/s, m/s²/√Hz: in a gap, standard deviation of the rate of turn and noise density of the acceleration, as of a
walking person's hand."""

KNOWN = 1e-4
"""rad, m: standard deviation of a pose that defines odom, or at which the map begins."""
WALKING = 1.5
"""m/s: standard deviation of a walking person's velocity while nothing is known about it."""
BIAS_LEAPS = 0.005, 0.05
"""rad/s, m/s²: how far a knock or a restart may shift the biases of a consumer IMU. Larger shifts take more frames."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What the filter knows: a state, and the (23, 23) covariance of its error."""

    state: NavState
    covariance: F64


@dataclass(frozen=True, slots=True)
class Path:
    """Poses of the IMU in odom between two scan ends.

    Attributes:
        times: (m,) s relative to the later scan end, <= 0, ascending.
        poses: (m, 3, 4) [R | p].
    """

    times: F64
    poses: F64


def at_origin(stamp_ns: int, R_odom_imu: F64, b_gyro: F64, sigma: F64, params: Params) -> Belief:
    """Belief at odom's origin: not moving, mounted as the parameters say, with gravity along -z.

    Args:
        R_odom_imu: (3, 3). b_gyro: (3,) rad/s. sigma: (DIM,) standard deviations.
    """
    state = NavState(
        stamp_ns=stamp_ns,
        R_odom_imu=R_odom_imu,
        p_odom_imu=np.zeros(3),
        v_odom_imu=np.zeros(3),
        b_gyro=b_gyro,
        b_accel=np.zeros(3),
        g_odom=np.array([0.0, 0.0, -params.imu.gravity]),
        R_imu_lidar=lie.from_rpy_degrees(params.sensor.rotation),
        p_imu_lidar=np.array(params.sensor.translation, dtype=np.float64),
    )
    return Belief(state, np.diag(sigma**2))


def mounting_to_pose(state: NavState) -> F64:
    """(6, 6) error of the IMU's pose for each error of the extrinsics, if the LiDAR's pose is right.

    Rows: rotation (IMU frame), position (odom). Columns: rotation (LiDAR frame), translation (IMU frame).
    """
    follows = np.zeros((6, 6))
    follows[:3, :3] = -state.R_imu_lidar
    follows[3:, :3] = -state.R_odom_imu @ lie.hat(state.p_imu_lidar) @ state.R_imu_lidar
    follows[3:, 3:] = -state.R_odom_imu
    return follows


def seen_from_the_lidar(belief: Belief) -> Belief:
    """The belief if the map begins at the LiDAR's pose: the IMU's is then as uncertain as the mounting between them."""
    follows = np.eye(DIM)
    follows[POSE, EXT] = mounting_to_pose(belief.state)
    return Belief(belief.state, follows @ belief.covariance @ follows.T)


def at_map_begin(belief: Belief, extrinsics: bool) -> Belief:
    """The belief if the map begins anew at its pose, which is then known; what is known of the rest is kept.

    Args:
        extrinsics: whether the mounting is refined.
    """
    covariance = belief.covariance.copy()
    covariance[POSE] = covariance[:, POSE] = 0.0
    covariance[POSE, POSE] = KNOWN**2 * np.eye(6)
    begun = Belief(belief.state, covariance)
    return seen_from_the_lidar(begun) if extrinsics else begun


def propagate(
    belief: Belief, imu: ImuSamples, end_ns: int, params: ImuParams, clock_sigma: float = USUAL_S
) -> tuple[Belief, Path]:
    """Carry the belief forward to `end_ns` through the samples that cover the time from its stamp.

    Rates are linear between samples, and constant before the first and after the last one. Through a long gap the
    velocity is constant, and once the samples end, the device does not turn either. clock_sigma: s, how well the offset
    of the IMU's clock is known.

    Returns the predicted belief and the path in between.
    """
    state = belief.state
    if end_ns <= state.stamp_ns:  # nothing to integrate
        here = state.T_odom_imu[None, :3]
        return belief, Path(np.array([-1.0, 0.0]), np.concatenate([here, here]))
    times, gyro, accel, spacing = _clipped(imu, state.stamp_ns, end_ns, state.b_gyro)
    R, p, v = state.R_odom_imu.copy(), state.p_odom_imu.copy(), state.v_odom_imu.copy()
    P = belief.covariance.copy()
    noise = np.array([params.gyro_noise, params.accel_noise, params.gyro_bias_walk, params.accel_bias_walk, GAP_NOISE])
    noise[:2] = np.hypot(noise[:2], _unsteady(times, gyro - state.b_gyro, accel, clock_sigma, _turn_error(belief)))
    knots = int(np.sum(np.ceil(np.maximum(np.diff(times), 0) / MAX_KNOT_STEP))) + 2 * len(times)
    knot_t, knot_T = np.empty(knots), np.empty((knots, 3, 4))
    basis = manifold.tangent_basis(state.g_odom)
    n = motion.propagate(
        times, gyro, accel, spacing > params.max_gap, spacing > LONG_GAP, MAX_KNOT_STEP, R, p, v,
        state.b_gyro, state.b_accel, state.g_odom, basis, P, noise, knot_t, knot_T,
    )  # fmt: skip
    if not (np.isfinite(p).all() and np.isfinite(v).all() and np.isfinite(R).all() and np.isfinite(P).all()):
        here = state.T_odom_imu[None, :3]  # the samples made no sense: stay, and leave the motion to the scan
        return Belief(replace(state, stamp_ns=end_ns), belief.covariance), Path(
            np.array([-1.0, 0.0]), np.r_[here, here]
        )
    R = 1.5 * R - 0.5 * R @ R.T @ R  # back onto SO(3) after many products: one Newton step of the polar form
    P = 0.5 * (P + P.T)
    moved = replace(state, stamp_ns=end_ns, R_odom_imu=R, p_odom_imu=p, v_odom_imu=v)
    return Belief(moved, P), Path(knot_t[:n] - times[-1], knot_T[:n])


def _turn_error(belief: Belief) -> float:
    """Share by which a turn may be wrong: by the gyroscope, or by the mounting, which tilts the axis of the turn."""
    across = 2.0 / 3.0 * float(np.trace(belief.covariance[EXT_ROT, EXT_ROT]))
    return float(np.sqrt(GYRO_SCALE**2 + across))


def _unsteady(times: F64, rates: F64, forces: F64, clock_sigma: float, turn_error: float) -> F64:
    """Noise densities (2,) (rad/s/√Hz, m/s²/√Hz) with the same effect as clock and turn errors over these (k,) s.

    rates, forces (k, 3) rad/s, m/s². A clock late by c gives an angle wrong by c times the change of the rate. At rest
    both errors are harmless, and only the noise of the data sheet remains.
    """
    lasting = max(times[-1] - times[0], 1e-3)
    turn = np.linalg.norm(rates.mean(axis=0))
    jerked = [np.abs(values - values.mean(axis=0)).max() / np.sqrt(lasting) for values in (rates, forces)]
    return np.hypot(clock_sigma * np.array(jerked), [turn_error * turn * np.sqrt(lasting), 0.0])


def longest_gap(imu: ImuSamples, end_ns: int) -> float:
    """s, the longest time without a sample, up to `end_ns`; 0 without any samples."""
    if not len(imu):
        return 0.0
    longest = max(int(np.diff(imu.stamps_ns).max(initial=0)), end_ns - int(imu.stamps_ns[-1]))
    return longest * 1e-9


def before_gap(belief: Belief) -> Belief:
    """The belief before a scan with a gap: its gyroscope bias is wide open and stands for the unknown rate of turn."""
    covariance = belief.covariance.copy()
    covariance[BG, BG] += GAP_RATE**2 * np.eye(3)
    return replace(belief, covariance=covariance)


def after_gap(belief: Belief, before: Belief) -> Belief:
    """The belief after such a scan, with the gyroscope bias that was known `before`."""
    covariance = belief.covariance.copy()
    covariance[BG] = covariance[:, BG] = 0.0
    covariance[BG, BG] = before.covariance[BG, BG]
    return Belief(replace(belief.state, b_gyro=before.state.b_gyro), covariance)


def with_open_motion(belief: Belief, surprise: float) -> Belief:
    """The belief with a covariance of pose and speed as large as the scan's `surprise` (see `Registration`) says.

    The covariance grows in proportion to the present one. So, along a direction that the scan leaves open, the estimate
    stays if it was well known a moment ago, and moves if it has been uncertain for long.
    """
    opened = np.ones(DIM)
    opened[MOTION] = np.sqrt(surprise)
    return replace(belief, covariance=belief.covariance * np.outer(opened, opened))


def with_open_biases(belief: Belief) -> Belief:
    """The belief after a scan has contradicted the IMU, whose biases may have shifted."""
    covariance = belief.covariance.copy()
    for bias, leap in zip((BG, BA), BIAS_LEAPS, strict=True):
        covariance[bias, bias] += leap**2 * np.eye(3)
    return replace(belief, covariance=covariance)


def deskew(scan: Scan, path: Path, state: NavState) -> F32:
    """Every point in the LiDAR frame at the path's end, the time of `state`.

    Returns (n, 3) float32 m. Times before the path are extrapolated from its first knots.

    Backward propagation: p_end = T_LI T_odom_end^-1 T_odom_t T_IL p_t.
    """
    T_imu_lidar = state.T_imu_lidar
    poses = np.zeros((len(path.times), 4, 4))
    poses[:, :3] = path.poses
    poses[:, 3, 3] = 1.0
    relative = lie.inverse(T_imu_lidar) @ lie.inverse(poses[-1]) @ poses @ T_imu_lidar
    shift = (scan.stamp_ns - state.stamp_ns) * 1e-9
    out = np.empty_like(scan.points)
    motion.deskew(scan.points, scan.offsets_ns, shift, path.times, np.ascontiguousarray(relative[:, :3]), out)
    return out


def _clipped(imu: ImuSamples, begin_ns: int, end_ns: int, b_gyro: F64) -> tuple[F64, F64, F64, F64]:
    """Samples from begin to end (s after begin), with values interpolated at both ends; b_gyro (3,) is the gyroscope's
    reading of a device that does not turn.

    The last value (k - 1,) is, for each interval, the time in s between the samples around it, so that a gap
    stays one gap however many scans end inside it.
    """
    inside = (imu.stamps_ns > begin_ns) & (imu.stamps_ns < end_ns)
    stamps = np.concatenate([[begin_ns], imu.stamps_ns[inside], [end_ns]])
    at = (stamps - begin_ns) * 1e-9
    have = (imu.stamps_ns - begin_ns) * 1e-9
    afterwards = b_gyro if at[-1] - have[-1] > LONG_GAP else imu.gyro[-1]
    gyro = np.stack([np.interp(at, have, imu.gyro[:, i], right=afterwards[i]) for i in range(3)], axis=1)
    accel = np.stack([np.interp(at, have, imu.accel[:, i]) for i in range(3)], axis=1)
    known = np.concatenate([[min(have[0], at[0])], have, [max(have[-1], at[-1])]])
    after = np.searchsorted(known, 0.5 * (at[1:] + at[:-1]))
    return at, gyro, accel, known[after] - known[after - 1]
