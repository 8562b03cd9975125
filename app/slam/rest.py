"""Updates of the filter at rest: the velocity is zero, and the IMU measures only gravity and its biases.

A scan may leave a direction unobserved (along a street, over bare ground), and small errors of its planes then
move the pose. The zero velocity holds the pose in place and makes the biases observable.
"""

import numpy as np

from app.slam import lie
from app.slam.iekf import boxplus
from app.slam.imu import BA, DIM, GRAV, ROT, VEL, Belief
from app.slam.kernels import manifold
from app.slam.types import F64, ImuSamples

MOVING_GYRO = 0.05
MOVING_ACCEL = 0.4
"""Standard deviations (rad/s, m/s²) above which a device is moving: ten to thirty times the noise of a
consumer IMU at 200-500 Hz, and well below those of any step."""
LARGEST_BIAS = 0.2
"""rad/s; a steady rate above this is a turn, not the bias of a gyroscope."""
TREMOR = 0.005
"""m/s, standard deviation of the velocity of a device held still by hand."""
LIKELY = 2.37
"""Median of chi-squared with three degrees of freedom. A missed rest costs nothing, since the next frame
will do; a false one would hold back the first step."""


def is_moving(imu: ImuSamples) -> bool:
    """Whether the samples spread more than those of a device at rest, or show a steady turn."""
    turning = np.linalg.norm(imu.gyro.mean(axis=0)) > LARGEST_BIAS
    return bool(turning or np.any(imu.gyro.std(axis=0) > MOVING_GYRO) or np.any(imu.accel.std(axis=0) > MOVING_ACCEL))


def hold(belief: Belief, imu: ImuSamples) -> Belief:
    """The belief with its velocity observed as zero, if its samples and its own velocity agree with a rest.

    In a lift or on a cart at constant speed the samples look like a rest; the velocity known so far does not.
    """
    if len(imu) < 2 or is_moving(imu):
        return belief
    noise = TREMOR**2 * np.eye(3)
    velocity = belief.state.v_odom_imu
    if velocity @ np.linalg.solve(belief.covariance[VEL, VEL] + noise, velocity) > LIKELY:
        return belief
    H = np.zeros((3, DIM))
    H[:, VEL] = np.eye(3)
    return observe(belief, H, -velocity, noise)


def level(belief: Belief, specific_force: F64, sigma: F64) -> Belief:
    """The belief of a device at rest that feels `specific_force` (3,) m/s², each axis known to `sigma` (3,).

    A device at rest does not accelerate, so the sum of gravity and the accelerometer's bias is known well, although
    neither of them is known alone. Their correlation in the covariance expresses this.
    """
    state = belief.state
    up = -state.R_odom_imu.T @ state.g_odom
    H = np.zeros((3, DIM))
    H[:, ROT] = lie.hat(up)
    H[:, BA] = np.eye(3)
    H[:, GRAV] = state.R_odom_imu.T @ lie.hat(state.g_odom) @ manifold.tangent_basis(state.g_odom)
    return observe(belief, H, specific_force - (up + state.b_accel), np.diag(sigma**2))


def observe(belief: Belief, H: F64, innovation: F64, noise: F64) -> Belief:
    """Kalman update with innovation (m,) = H (m, 23) error + noise, of covariance `noise` (m, m)."""
    P = belief.covariance
    gain = np.linalg.solve(H @ P @ H.T + noise, H @ P).T
    kept = np.eye(DIM) - gain @ H
    return Belief(boxplus(belief.state, gain @ innovation), kept @ P @ kept.T + gain @ noise @ gain.T)
