"""How late the IMU's clock is, learnt from how scans correct the turns that it foretells.

Of a clock that is late by c, the turn foretold for a frame lags behind: it is short of the true one by c times the
change of the rate, which the scan then adds. The sum over many frames tells c, whatever the sensor's biases, scales and
mounting, since their errors follow the rate and not its change.
"""

from dataclasses import dataclass, replace

import numpy as np

from app.slam import lie
from app.slam.types import F64, ImuSamples, NavState

USUAL_S = 5e-3
"""s, standard deviation of clock offsets that are not known."""
TURN_RAD = 3e-3
"""Standard deviation of a scan's correction of a turn."""
LARGEST_TURN, LARGEST_CHANGE = 0.05, 10.0
"""rad, rad/s: corrections and changes of the rate beyond these have another cause."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Attributes:
    late: s by which the IMU's stamps are late, as learnt. They are moved back by it.
    rate: (3,) rad/s, mean of the last frame; None before the first. seen, moment: sums of squared changes of the rate,
        (rad/s)², and of their products with corrections, rad²/s.
    """

    late: float = 0.0
    rate: F64 | None = None
    seen: float = 0.0
    moment: float = 0.0

    def set_right(self, samples: ImuSamples) -> ImuSamples:
        return replace(samples, stamps_ns=samples.stamps_ns - round(self.late * 1e9))

    def learnt(self, samples: ImuSamples, predicted: NavState, posterior: NavState) -> "ClockOffset":
        """With what a frame's scan says. samples: of the frame; predicted: from them; posterior: with the scan."""
        rate = np.asarray(samples.gyro.mean(axis=0))
        correction = lie.log(predicted.R_odom_imu.T @ posterior.R_odom_imu)
        change = rate - (rate if self.rate is None else self.rate)
        if not (np.abs(correction).max() <= LARGEST_TURN and np.abs(change).max() <= LARGEST_CHANGE):
            return replace(self, rate=rate)
        turn = correction + self.late * change
        seen, moment = self.seen + float(change @ change), self.moment + float(change @ turn)
        return ClockOffset(moment / (seen + (TURN_RAD / USUAL_S) ** 2), rate, seen, moment)
