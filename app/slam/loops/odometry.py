"""The factor that odometry puts between neighbouring keyframes."""

import numpy as np

from app.slam import lie
from app.slam.loops.detection import Head
from app.slam.loops.drift import Drift
from app.slam.loops.factors import Factor
from app.slam.types import F64

STILL_M, STILL_RAD = 0.001, np.radians(0.02)
"""Standard deviations of a step, however short."""
EVEN_M = 1.0
"""Distance over which drift goes on in one direction; a way L drifts by drift * sqrt(L * EVEN_M)."""


def odometry_factor(second: int, before: Head, after: Head, drift: Drift) -> Factor:
    """From one keyframe to the next.

    The filter gives the covariance of each pose in its map, not of the step between them, and holds
    the map for known. So: the covariances of both poses add up (as if they were independent, which
    is more than there is), and drift is added as a random walk: even over some metres, independent
    between them.
    """
    T = lie.inverse(before.T_odom_imu) @ after.T_odom_imu
    walked = float(np.linalg.norm(T[:3, 3]))
    turn = np.kron(np.eye(2), T[:3, :3].T)
    first = turn @ _own_axes(before) @ turn.T
    even = walked * EVEN_M
    noise = np.array([STILL_RAD**2 + drift.rotation**2 * even] * 3 + [STILL_M**2 + drift.translation**2 * even] * 3)
    covariance = first + _own_axes(after) + np.diag(noise)
    return Factor(second - 1, second, T, (covariance + covariance.T) / 2)


def _own_axes(head: Head) -> F64:
    """(6, 6) covariance with the position's error in the IMU's axes, as the rotation's is; zero if it is no number."""
    turn = np.eye(6)
    turn[3:, 3:] = head.T_odom_imu[:3, :3].T
    out = turn @ head.covariance @ turn.T
    return out if np.isfinite(out).all() else np.zeros((6, 6))
