"""How certain a pose is since the walk began, counting errors that repeat from frame to frame.

The filter takes the map and the mounting of the LiDAR as exact, so its covariance shows how well a scan fits the map,
and stays at millimetres however long the walk is. Two errors are left out, and neither averages out:

- The map lies where the filter put it. Each new view is mapped with an error of its own, as large as the filter's at
  that time. These errors add up to a random walk, and its rotations move all that follows.
- The tilt caused by a wrong mounting changes direction as the device turns, and so do the errors of the IMU's poses.
"""

from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.imu import EXT_POS, EXT_ROT, Belief
from app.slam.types import F64

VIEW_M = 50.0
"""After walking this far, the view has changed and new surfaces are mapped."""


@dataclass(frozen=True, slots=True)
class Certainty:
    """Attributes:
    first: (3, 3) R_odom_imu when the walk began. here: (3,) m, p_odom_imu up to which drift was added.
    drift: (6, 6) covariance of the map's error there, rotation then translation, odom axes.
    """

    first: F64
    here: F64
    drift: F64

    @classmethod
    def begin(cls, belief: Belief) -> "Certainty":
        return cls(belief.state.R_odom_imu, belief.state.p_odom_imu, np.zeros((6, 6)))

    def moved(self, belief: Belief) -> "Certainty":
        """With the drift of the way from `here` to the belief's position. At rest there is none."""
        step = belief.state.p_odom_imu - self.here
        carry = np.eye(6)
        carry[3:, :3] = -lie.hat(step)
        added = float(np.linalg.norm(step)) / VIEW_M * _in_odom(belief)
        return Certainty(self.first, belief.state.p_odom_imu, carry @ self.drift @ carry.T + added)

    def covariance(self, belief: Belief) -> F64:
        """(6, 6) of the belief's pose since the walk began, rotation (IMU frame) then translation (odom)."""
        R, P = belief.state.R_odom_imu, belief.covariance
        total = _in_odom(belief) + self.drift
        leaning = R - self.first
        mounting = belief.state.R_imu_lidar @ P[EXT_ROT, EXT_ROT] @ belief.state.R_imu_lidar.T
        total[:3, :3] += leaning @ mounting @ leaning.T
        total[3:, 3:] += leaning @ P[EXT_POS, EXT_POS] @ leaning.T
        total[:3] = R.T @ total[:3]
        total[:, :3] = total[:, :3] @ R
        return np.asarray(0.5 * (total + total.T))


def _in_odom(belief: Belief) -> F64:
    """(6, 6) of the pose against the map, rotation then translation, odom axes."""
    turn = np.eye(6)
    turn[:3, :3] = belief.state.R_odom_imu
    return np.asarray(turn @ belief.covariance[:6, :6] @ turn.T)
