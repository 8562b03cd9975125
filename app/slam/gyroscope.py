"""Scale errors of the gyroscope, estimated from how scans correct the predicted turns.

If the scale of an axis is too small, every turn about this axis is measured too short by the same share, and the scan's
correction adds the rest. A regression over many frames gives the shares. Only their symmetric part is learnt: the
antisymmetric part turns all axes together, like an error of the mounting, which the filter refines.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from app.slam.clock import LARGEST_TURN, TURN_RAD
from app.slam.kernels import manifold
from app.slam.types import F64, ImuSamples, NavState

GYRO_SCALE = 0.006
"""Possible error of a turn, as a share: of scale and between the axes [data sheets of MEMS gyroscopes]."""
PRIOR = (TURN_RAD / GYRO_SCALE) ** 2 * np.diag([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
"""rad²: sum of squared turns that carries as much information as the prior. Shares between two axes count twice."""


@dataclass(frozen=True, slots=True)
class GyroErrors:
    """Attributes:
    shares: (3, 3) symmetric, what to add to a rate, for each rad/s about each axis.
    seen, moment: (6, 6) rad² and (6,) rad², sums of the regression: of the turns, and of these and their corrections.
    """

    shares: F64 = field(default_factory=lambda: np.zeros((3, 3)))
    seen: F64 = field(default_factory=lambda: np.zeros((6, 6)))
    moment: F64 = field(default_factory=lambda: np.zeros(6))

    def set_right(self, samples: ImuSamples) -> ImuSamples:
        return replace(samples, gyro=samples.gyro + samples.gyro @ self.shares)

    def learnt(self, begin: NavState, predicted: NavState, posterior: NavState) -> "GyroErrors":
        """This estimate, updated with a frame: its state before, the one predicted, and that after its scan."""
        turn = manifold.log(begin.R_odom_imu.T @ predicted.R_odom_imu)
        correction = manifold.log(predicted.R_odom_imu.T @ posterior.R_odom_imu)
        if not np.abs(correction).max() <= LARGEST_TURN:
            return self
        x, y, z = turn
        by_share = np.array([[x, 0, 0, y, z, 0], [0, y, 0, x, 0, z], [0, 0, z, 0, x, y]])
        seen = self.seen + by_share.T @ by_share
        moment = self.moment + by_share.T @ (correction + self.shares @ turn)
        xx, yy, zz, xy, xz, yz = np.linalg.solve(seen + PRIOR, moment)
        return GyroErrors(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), seen, moment)
