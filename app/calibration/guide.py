"""The motion of the LiDAR within a scan, by the IMU, once its mounting is roughly known."""

from dataclasses import dataclass

import numpy as np

from app.calibration.inertial import Inertial
from app.slam import lie
from app.slam.coast import Course
from app.slam.types import F64

STEP_S = 0.005


@dataclass(frozen=True, slots=True)
class Guide:
    """Motion by the IMU.

    Attributes:
        inertial: samples at knots `STEP_S` apart by the LiDAR's clock, without biases. attitudes: (m, 3, 3) of the IMU
            at these, in any one frame.
        R_imu_lidar: (3, 3). p_imu_lidar: (3,) m. gravity: (3,) m/s² in the world of the odometry; None: unknown.
    """

    inertial: Inertial
    attitudes: F64
    R_imu_lidar: F64
    p_imu_lidar: F64
    gravity: F64 | None

    @classmethod
    def of(
        cls, inertial: Inertial, R_imu_lidar: F64, late: float, gyro_bias: F64,
        p_imu_lidar: F64 | None = None, accel_bias: F64 | None = None, gravity: F64 | None = None,
    ) -> "Guide":  # fmt: skip
        knots = np.arange(inertial.times[0] + late, inertial.times[-1] + late + STEP_S, STEP_S)
        zero = np.zeros(3)
        forces = inertial.forces(knots - late) - (zero if accel_bias is None else accel_bias)
        steady = Inertial(knots, inertial.rates(knots - late) - gyro_bias, forces)
        attitudes = inertial.attitudes(knots, late, gyro_bias)
        return cls(steady, attitudes, R_imu_lidar, zero if p_imu_lidar is None else p_imu_lidar, gravity)

    def course(self, end: float, back: F64, R_world_lidar: F64) -> Course:
        """The motion of the LiDAR to its pose at the time `end` s.

        Args:
            back: (k,) s, ascending to 0. R_world_lidar: (3, 3) at the first of these times.
        """
        turned, rates = self._turned(end, back)
        of_lidar = np.asarray(self.R_imu_lidar.T @ turned @ self.R_imu_lidar)
        nothing = np.zeros((len(back), 3))
        if self.gravity is None:
            return Course(back, of_lidar, nothing, nothing)
        R_world_imu = R_world_lidar @ of_lidar[0].T @ self.R_imu_lidar.T  # at the end
        felt = (turned @ self.inertial.forces(end + back)[:, :, None])[:, :, 0] + R_world_imu.T @ self.gravity
        h = np.diff(back)[:, None]
        speeds, ways = nothing.copy(), nothing.copy()  # of the IMU, integrated back from the end
        for k in range(len(back) - 2, -1, -1):
            mean = 0.5 * (felt[k] + felt[k + 1])
            speeds[k] = speeds[k + 1] - mean * h[k]
            ways[k] = ways[k + 1] - speeds[k + 1] * h[k] + 0.5 * mean * h[k] ** 2
        spin = lie.hat(rates)
        arm, whirl = self.p_imu_lidar, turned @ spin  # the LiDAR at the end of its lever
        ways = ways + turned @ arm - arm - back[:, None] * (spin[-1] @ arm)
        speeds = speeds + whirl @ arm - spin[-1] @ arm
        return Course(back, of_lidar, ways @ self.R_imu_lidar, speeds @ self.R_imu_lidar)

    def _turned(self, end: float, back: F64) -> tuple[F64, F64]:
        """(k, 3, 3) R_end_then of the IMU, and its rates (k, 3) then."""
        times, knots = end + back, self.inertial.times
        k = np.clip(np.searchsorted(knots, times) - 1, 0, len(knots) - 2)
        rates = self.inertial.rates(times)
        middle = 0.5 * (self.inertial.gyro[k] + rates)
        then = self.attitudes[k] @ lie.exp(middle * (times - knots[k])[:, None])
        return np.asarray(then[-1].T @ then), rates
