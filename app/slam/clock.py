"""How late the IMU's clock is, estimated from how scans correct the predicted turns.

If the clock is late by c, the turn predicted for a frame lags: it falls short of the true turn by c times the change of
the angular rate, and the scan's correction adds that. A regression over many frames gives c. Errors of bias, scale and
mounting do not affect it, since they follow the rate and not its change.
"""

from dataclasses import dataclass, replace

import numpy as np

from app.slam.kernels import manifold
from app.slam.types import F64, ImuSamples, NavState

USUAL_S = 5e-3
"""s, prior standard deviation of an unknown clock offset."""
JITTER_S = 0.5e-3
"""s, standard deviation of single stamps, however long the offset is learnt."""
TURN_RAD = 3e-3
"""Standard deviation of a scan's correction of a turn."""
PRIOR = (TURN_RAD / USUAL_S) ** 2
"""(rad/s)²: sum of squared rate changes that carries as much information as the prior."""
LARGEST_TURN, LARGEST_CHANGE = 0.05, 10.0
"""rad, rad/s: larger corrections or changes of the rate have another cause and are ignored."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Attributes:
    late: s, the estimate of how late the IMU's stamps are. `set_right` moves them back by it.
    rate: (3,) rad/s, mean of the last frame; None before the first.
    seen, moment: sum of the squared changes of the rate, (rad/s)², and of their products with corrections, rad²/s.
    """

    late: float = 0.0
    rate: F64 | None = None
    seen: float = 0.0
    moment: float = 0.0

    @property
    def sigma(self) -> float:
        """Standard deviation of a stamp once it is set right, s."""
        return float(np.hypot(JITTER_S, TURN_RAD / np.sqrt(self.seen + PRIOR)))

    def set_right(self, samples: ImuSamples) -> ImuSamples:
        return replace(samples, stamps_ns=samples.stamps_ns - round(self.late * 1e9))

    def learnt(self, samples: ImuSamples, predicted: NavState, posterior: NavState) -> "ClockOffset":
        """This estimate, updated with a frame: its samples, the state predicted from them, and that after its scan."""
        rate = np.asarray(samples.gyro.mean(axis=0))
        correction = manifold.log(predicted.R_odom_imu.T @ posterior.R_odom_imu)
        change = rate - (rate if self.rate is None else self.rate)
        if not (np.abs(correction).max() <= LARGEST_TURN and np.abs(change).max() <= LARGEST_CHANGE):
            return replace(self, rate=rate)
        turn = correction + self.late * change
        seen, moment = self.seen + float(change @ change), self.moment + float(change @ turn)
        return ClockOffset(moment / (seen + PRIOR), rate, seen, moment)
