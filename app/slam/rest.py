"""What standing still tells the filter: the velocity is zero, and the IMU feels nothing but gravity and bias.

A scan alone may leave a direction open (along a street, over bare ground), and its planes' small
errors then pull the pose about. Knowing the velocity at rest keeps it, and teaches the biases.
"""

import numpy as np

from app.slam import lie
from app.slam.iekf import boxplus
from app.slam.imu import BA, DIM, GRAV, ROT, VEL, Belief
from app.slam.kernels import manifold
from app.slam.types import F64, ImuSamples

MOVING_GYRO = 0.05
MOVING_ACCEL = 0.4
"""Standard deviations (rad/s, m/s²) above which a device is not standing still: ten to thirty times
the noise of a consumer IMU at 200-500 Hz, and well below any step."""
LARGEST_BIAS = 0.2
"""rad/s; an even turn faster than this is a turn and not a gyroscope's bias."""
TREMOR = 0.005
"""m/s, standard deviation of the velocity of a device that a hand holds still."""
LIKELY = 2.37
"""Chi-squared of three degrees of freedom that half of all rests stay below. A rest that is missed
costs nothing, the next frame will do; one that is none would hold the first step back."""


def is_moving(imu: ImuSamples) -> bool:
    """Whether the samples spread more than a device standing still would show, or tell of an even turn."""
    turning = np.linalg.norm(imu.gyro.mean(axis=0)) > LARGEST_BIAS
    return bool(turning or np.any(imu.gyro.std(axis=0) > MOVING_GYRO) or np.any(imu.accel.std(axis=0) > MOVING_ACCEL))


def hold(belief: Belief, imu: ImuSamples) -> Belief:
    """The belief with its velocity known to be zero, if neither the samples up to it nor itself speak against it.

    A lift or a cart that moves evenly feels like a rest; but then the velocity is known to be another.
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

    Neither gravity's direction nor the accelerometer's bias is known well, but their sum is: a device
    at rest does not accelerate. What that says lies in their correlation.
    """
    state = belief.state
    up = -state.R_odom_imu.T @ state.g_odom
    H = np.zeros((3, DIM))
    H[:, ROT] = lie.hat(up)
    H[:, BA] = np.eye(3)
    H[:, GRAV] = state.R_odom_imu.T @ lie.hat(state.g_odom) @ manifold.tangent_basis(state.g_odom)
    return observe(belief, H, specific_force - (up + state.b_accel), np.diag(sigma**2))


def observe(belief: Belief, H: F64, innovation: F64, noise: F64) -> Belief:
    """Kalman's update by innovation (m,) = H (m, 23) error + noise, of covariance `noise` (m, m)."""
    P = belief.covariance
    gain = np.linalg.solve(H @ P @ H.T + noise, H @ P).T
    kept = np.eye(DIM) - gain @ H
    return Belief(boxplus(belief.state, gain @ innovation), kept @ P @ kept.T + gain @ noise @ gain.T)
