"""The path of the IMU, and of an antenna on it, at any time between the poses of a trajectory; its fit to places."""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from app.slam import lie
from app.slam.arrays import F64, Mask
from app.slam.trajectory import Trajectory

SEARCH_S = 10.0
"""Fixes may be stamped this much too early or too late."""
GAP_S = 1.0
"""Between poses farther apart in time than this, the place of the antenna is unknown."""


class PathOverTime:
    """Where the IMU was between the poses of a trajectory (4 or more); times in s since the first pose."""

    def __init__(self, trajectory: Trajectory) -> None:
        from scipy.interpolate import make_interp_spline  # every process imports this module, and few need a path

        self.start_ns = int(trajectory.stamps_ns[0])
        self._times = (trajectory.stamps_ns - self.start_ns) * 1e-9
        self._places = make_interp_spline(self._times, trajectory.positions, k=3)
        self._turns = Slerp(self._times, trajectory.rotations)
        self._asked: tuple[F64, F64, Rotation] | None = None

    def known(self, t: F64) -> Mask:
        """(n,) whether there are poses near these times."""
        after = np.clip(np.searchsorted(self._times, t), 1, len(self._times) - 1)
        near = self._times[after] - self._times[after - 1] < GAP_S
        return np.asarray(near & (t >= self._times[0]) & (t <= self._times[-1]))

    def within_search(self, t: F64) -> Mask:
        """(n,) whether the clocks' offset may bring these times into the walk."""
        return np.asarray((t >= self._times[0] - SEARCH_S) & (t <= self._times[-1] + SEARCH_S))

    def poses(self, t: F64) -> F64:
        """(n, 4, 4) T_map_imu."""
        places, turns = self._at(t)
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = turns.as_matrix(), places
        return T

    def antenna(self, t: F64, lever: F64) -> F64:
        """(n, 3) m in the map, of a point `lever` (3,) in the IMU frame."""
        places, turns = self._at(t)
        return np.asarray(places + turns.apply(lever))

    def _at(self, t: F64) -> tuple[F64, Rotation]:
        """Places (n, 3) and attitudes. The last result is kept: most steps of a fit ask for the same times."""
        asked = self._asked
        if asked is None or not np.array_equal(asked[0], t):
            inside = np.clip(t, self._times[0], self._times[-1])
            self._asked = asked = np.array(t), self._places(inside), self._turns(inside)
        return asked[1:]


def aligned_robustly(points: F64, places: F64) -> tuple[float, F64, F64]:
    """The yaw (rad) and shift (3,) that move points (n, 3) onto places with the smallest sum of distances.

    Returns also the distance of each, m (n,). By reweighted least squares (Weiszfeld), so a few wrong places do not
    matter.
    """
    weights = np.ones(len(points))
    for _ in range(8):
        share = weights / weights.sum()
        middle, there = share @ points, share @ places
        a, b = points - middle, places - there
        sine = share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        yaw = float(np.arctan2(sine, share @ (a[:, :2] * b[:, :2]).sum(axis=1)))
        R = lie.exp(np.array([0.0, 0.0, yaw]))
        shift = there - R @ middle
        off = np.linalg.norm(places - points @ R.T - shift, axis=1)
        weights = 1.0 / np.maximum(off, 1e-3)
    return yaw, shift, off
