"""Lower bound on the standard deviation of any estimate of the clock offset from fixes with Gaussian noise.

The unknowns are the offset, and the rotation and translation of the map. The Cramér-Rao bound for noise assumes an
exact map. The bound for noise and drift models the map's errors as a random walk with their true rate; an estimator
that knew this rate, and so weighted slow and fast motion optimally, would reach it.
"""

import numpy as np

from app.sensors.simulator.trajectory import SmoothTrajectory
from app.slam.metrics import umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64

STEP_S = 1e-3
STRETCH = 80
"""Drift is measured over this many poses: 8 s of scans."""


def drift_rate(trajectory: Trajectory, truth: F64) -> float:
    """Growth of the variance of position errors in each direction, m²/s. truth: (n, 3) m, true positions."""
    T = umeyama(trajectory.positions, truth)
    off = trajectory.positions @ T[:3, :3].T + T[:3, 3] - truth
    seconds = (trajectory.stamps_ns[STRETCH:] - trajectory.stamps_ns[:-STRETCH]) * 1e-9
    return float(((off[STRETCH:] - off[:-STRETCH]) ** 2).mean() / seconds.mean())


def least_sigma_s(walked: SmoothTrajectory, times: F64, lever: F64, noise: float, drift: float = 0.0) -> float:
    """Bound (s) on the offset from fixes at times (n,), s, if noise (m) and drift (m²/s) are the only errors.

    Args:
        walked: the true motion of the IMU. lever: (3,) m, from the IMU to the antenna.
    """

    def antenna(t: F64) -> F64:
        places, rotations = walked.poses(t)
        return np.asarray(places + rotations @ lever)

    at = antenna(times)
    velocity = (antenna(times + STEP_S) - antenna(times - STEP_S)) / (2 * STEP_S)
    arms = at - at.mean(axis=0)
    turns = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)  # (n, 3, 3): derivative by each rotation
    since = times - times[0]
    covariance = noise**2 * np.eye(len(times)) + drift * np.minimum.outer(since, since)
    information = np.zeros((7, 7))
    for axis in range(3):
        shift = np.tile(np.eye(3)[axis], (len(times), 1))
        J = np.column_stack([turns[:, axis], shift, -velocity[:, axis]])
        information += J.T @ np.linalg.solve(covariance, J)
    return float(np.linalg.inv(information)[6, 6] ** 0.5)
