"""The motion as the IMU measures it, at the times of the scans."""

from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.types import F64

SUBSTEPS = 20
"""Number of integration steps of a gyroscope between two scans."""
DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)
"""Weights of five successive samples: they leave a thousandth of a hand's motion, but all of the white noise."""


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise of a sensor. density: RMS over the axes, unit/√Hz. sigma: its standard deviation."""

    density: float
    sigma: float

    @classmethod
    def of(cls, times: F64, values: F64) -> "Noise":
        """From samples (k, 3) at times (k,) s; nan if they last less than four seconds."""
        rest = sum(w * values[i : len(values) - 4 + i] for i, w in enumerate(DIFFERENCE))
        steps = np.diff(times)
        each = round(1.0 / float(np.median(steps))) if len(steps) else 1
        count = len(values) // max(each, 1) - 1
        if count < 4:
            return cls(float("nan"), float("nan"))
        seconds = np.mean(np.asarray(rest)[: count * each].reshape(count, -1) ** 2, axis=1)
        usual = float(np.median(seconds))  # knocks of a few seconds do not count
        density = float(np.sqrt(usual * np.median(steps)))
        spread = 1.48 * float(np.median(np.abs(seconds - usual))) / max(usual, 1e-30)
        return cls(density, density * spread * 1.25 / np.sqrt(count) / 2.0)


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
