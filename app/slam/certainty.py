"""How certain a pose is relative to the start of the walk, including errors that repeat from frame to frame.

The filter takes the map and the mounting of the LiDAR as exact, so its covariance shows how well a scan fits the map,
and stays at millimetres however long the walk is. Three errors are left out, and none averages out:

- The map lies where the filter put it. Each new view is mapped with an error of its own, as large as the filter's at
  that time. These errors add up to a random walk, and its rotations displace everything mapped later.
- The tilt caused by a wrong mounting changes direction as the device turns, and so do the errors of the IMU's poses.
- While the mounting is learnt, the IMU's later poses become right, but the first pose, which defines odom, stays wrong.
"""

from dataclasses import dataclass, replace

import numpy as np

from app.slam import iekf, lie
from app.slam.imu import DIM, EXT, POSE, Belief, mounting_to_pose
from app.slam.types import F64, NavState, Registration

VIEW_M = 7.0
"""After walking this far, the view has changed and new surfaces are mapped: about a room, or from door to door. With
5 m, the NEES of the position averaged 0.59 over 24 imperfect walks, where 1 is right."""

WRONG_SPEED = 0.5
"""m/s: how far the speed may be off along a direction that scans leave open, as in a dark passage."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """How far odometry may be off since the last keyframe, because its speed went wrong while scans showed little.

    A scan that contradicts the prediction reveals a wrong speed. If earlier scans constrained all directions, this
    scan is the outlier and there is no doubt about odometry.

    Attributes:
        open_s: s, for how long scans left a direction open. It falls as fast as it grew.
        metres: standard deviation, along each axis.
    """

    open_s: float = 0.0
    metres: float = 0.0

    def after(self, registration: Registration, seconds: float) -> "Doubt":
        """The doubt after one more scan, `seconds` after the last one."""
        open_s = max(0.0, self.open_s + (seconds if registration.degenerate else -seconds))
        if registration.surprise > iekf.SURPRISING:  # the speed has been found again
            return Doubt(0.0, self.metres + WRONG_SPEED * open_s)
        return Doubt(open_s, self.metres)


@dataclass(frozen=True, slots=True)
class Certainty:
    """Attributes:
    refined: whether the filter refines the mounting: the errors of its poses then include those of the mounting.
    first: (6, 6) change of the first pose per error of the mounting. mounting: (6, 6) covariance of that error then.
    here: (3,) m, p_odom_imu at which drift was last added.
    drift: (6, 6) covariance of the map's error there, rotation then translation, odom axes.
    """

    refined: bool
    first: F64
    mounting: F64
    here: F64
    drift: F64

    @classmethod
    def begin(cls, belief: Belief, *, refined: bool) -> "Certainty":
        state, mounting = belief.state, belief.covariance[EXT, EXT]
        return cls(refined, _by_mounting(state), mounting, state.p_odom_imu, np.zeros((6, 6)))

    def moved(self, belief: Belief) -> "Certainty":
        """This with the drift added that accrues from `here` to the belief's position. At rest there is none."""
        step = belief.state.p_odom_imu - self.here
        carry = np.eye(6)
        carry[3:, :3] = -lie.hat(step)
        added = float(np.linalg.norm(step)) / VIEW_M * self._seen(belief)[:6, :6]
        return replace(self, here=belief.state.p_odom_imu, drift=carry @ self.drift @ carry.T + added)

    def in_map(self, belief: Belief) -> F64:
        """(6, 6) of the belief's pose against the local map, rotation (IMU frame) then translation (odom)."""
        turn = _in_odom(belief.state)
        return np.asarray(turn.T @ self._seen(belief)[:6, :6] @ turn)

    def covariance(self, belief: Belief) -> F64:
        """(6, 6) of the belief's pose since the walk began, rotation (IMU frame) then translation (odom)."""
        state = belief.state
        turn = _in_odom(state)
        since = np.hstack([np.eye(6), _by_mounting(state) - self.first])
        learnt = self.mounting - belief.covariance[EXT, EXT]
        total = since @ self._seen(belief) @ since.T + self.first @ learnt @ self.first.T + self.drift
        total = turn.T @ total @ turn
        return np.asarray(0.5 * (total + total.T))

    def _seen(self, belief: Belief) -> F64:
        """(12, 12) of the LiDAR's pose against the map, moved to the IMU, and of the mounting; odom axes."""
        change = np.zeros((12, DIM))
        change[:6, POSE], change[6:, EXT] = _in_odom(belief.state), np.eye(6)
        if self.refined:
            change[:6, EXT] = -_by_mounting(belief.state)
        return np.asarray(change @ belief.covariance @ change.T)


def _by_mounting(state: NavState) -> F64:
    """(6, 6) change of the IMU's pose per error of the mounting, odom axes."""
    return np.asarray(_in_odom(state) @ mounting_to_pose(state))


def _in_odom(state: NavState) -> F64:
    """(6, 6) turns rotation errors from the IMU's frame into odom axes, and leaves translations."""
    turn = np.eye(6)
    turn[:3, :3] = state.R_odom_imu
    return turn
