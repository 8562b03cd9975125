"""The least standard deviation that any estimate of the clocks' offset can have, from fixes with Gaussian noise.

Unknown are the offset, the map's rotation and its shift. The Cramér-Rao bound by noise takes the map for exact. The
bound by noise and drift takes the map's errors for a random walk, of the rate that they truly have: an estimator that
knew this rate, and so weighted slow and fast motion best, would reach it.
"""

import numpy as np

from app.sensors.simulator.trajectory import SmoothTrajectory
from app.slam.metrics import umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64

STEP_S = 1e-3
STRETCH = 80
"""Poses between which drift is measured: 8 s of scans."""


def drift_rate(trajectory: Trajectory, truth: F64) -> float:
    """Variance that errors of positions gain in each direction, m²/s. truth: (n, 3) m, where the poses truly are."""
    T = umeyama(trajectory.positions, truth)
    off = trajectory.positions @ T[:3, :3].T + T[:3, 3] - truth
    seconds = (trajectory.stamps_ns[STRETCH:] - trajectory.stamps_ns[:-STRETCH]) * 1e-9
    return float(((off[STRETCH:] - off[:-STRETCH]) ** 2).mean() / seconds.mean())


def least_sigma_s(walked: SmoothTrajectory, times: F64, lever: F64, noise: float, drift: float = 0.0) -> float:
    """Of the offset by fixes at these times (n,), s, if nothing but noise (m) and drift (m²/s) is wrong.

    Args:
        walked: the true motion of the IMU. lever: (3,) m, from it to the antenna.
    """

    def antenna(t: F64) -> F64:
        places, rotations = walked.poses(t)
        return np.asarray(places + rotations @ lever)

    at = antenna(times)
    velocity = (antenna(times + STEP_S) - antenna(times - STEP_S)) / (2 * STEP_S)
    arms = at - at.mean(axis=0)
    turns = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)  # (n, 3, 3): change by each rotation
    since = times - times[0]
    covariance = noise**2 * np.eye(len(times)) + drift * np.minimum.outer(since, since)
    information = np.zeros((7, 7))
    for axis in range(3):
        shift = np.tile(np.eye(3)[axis], (len(times), 1))
        J = np.column_stack([turns[:, axis], shift, -velocity[:, axis]])
        information += J.T @ np.linalg.solve(covariance, J)
    return float(np.linalg.inv(information)[6, 6] ** 0.5)
