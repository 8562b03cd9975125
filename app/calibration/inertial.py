"""What the IMU says of a motion, at the times of the scans."""

from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.types import F64

SUBSTEPS = 20
"""Of a gyroscope between two scans."""


@dataclass(frozen=True, slots=True)
class Inertial:
    """IMU samples: times (k,) s after the end of the first scan by the IMU's own clock, gyro and accel (k, 3)."""

    times: F64
    gyro: F64
    accel: F64

    def rates(self, at: F64) -> F64:
        """(..., 3) rad/s at times (...)."""
        return np.stack([np.interp(at, self.times, self.gyro[:, axis]) for axis in range(3)], axis=-1)

    def forces(self, at: F64) -> F64:
        """(..., 3) m/s² at times (...)."""
        return np.stack([np.interp(at, self.times, self.accel[:, axis]) for axis in range(3)], axis=-1)

    def turns(self, times: F64, late: float, bias: F64) -> F64:
        """(n - 1, 3, 3) rotations R_imu(t)_imu(t+1) between times (n,).

        Args:
            late: s, added to the IMU's times. bias: (3,) rad/s, of the gyroscope.
        """
        span = np.diff(times)
        middle = times[:-1, None] - late + span[:, None] * (np.arange(SUBSTEPS) + 0.5) / SUBSTEPS
        steps = lie.exp((self.rates(middle) - bias) * (span / SUBSTEPS)[:, None, None])
        while steps.shape[1] > 1:  # pairs, then pairs of pairs
            even = steps.shape[1] // 2 * 2
            steps = np.concatenate([steps[:, 0:even:2] @ steps[:, 1:even:2], steps[:, even:]], axis=1)
        return np.asarray(steps[:, 0])

    def attitudes(self, times: F64, late: float, bias: F64) -> F64:
        """(n, 3, 3) attitudes of the IMU at ascending times (n,), in its own frame at the first of them."""
        out = np.empty((len(times), 3, 3))
        out[0] = np.eye(3)
        for k, turn in enumerate(self.turns(times, late, bias)):
            out[k + 1] = out[k] @ turn
        return out
