"""The path of the LiDAR from its scans: each scan is registered to the map of the earlier ones, as the engine does
without an IMU (`app.slam.coast`)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.calibration.excerpt import Excerpt
from app.calibration.guide import Guide
from app.slam import coast, lie
from app.slam.imu import BG, ROT
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.types import F32, F64

GYRO = 0.05
"""rad/√s, noise of turns by the gyroscope."""
AROUND_S = 0.15
"""How far the clocks of the sensors may be apart."""
LEAST_CHANGES = (0.05, 0.2)
"""rad/s and m/s²: change of the rate, and acceleration, that is always possible."""


@dataclass(frozen=True, slots=True)
class Track:
    """Poses of the LiDAR at the ends of n scans.

    Attributes:
        times: (n,) s after the end of the first scan. rotations: (n, 3, 3) and positions (n, 3) m, in the world.
        residuals: (n,) m, RMS of point to plane; nan where the scan could not be registered to the map.
        points: of each scan (k, 3) m, in the LiDAR frame at the scan's end.
    """

    times: F64
    rotations: F64
    positions: F64
    residuals: F64
    points: tuple[F32, ...] = ()

    @property
    def residual(self) -> float:
        """m, the median over the scans."""
        return float(np.nanmedian(self.residuals)) if np.isfinite(self.residuals).any() else float("nan")


def track(
    excerpt: Excerpt, guide: Guide | None = None, progress: Callable[[float], None] = lambda fraction: None
) -> Track:
    """Register each scan to the local map of the earlier ones.

    Args:
        guide: how the LiDAR turns and sways between two scans; None: at constant rates, up to what the scans show.
    """
    params = Params()  # the LiDAR is the IMU, and its first pose the world
    local_map = LocalMap(params.map)
    times = excerpt.seconds(excerpt.ends_ns)
    here = coast.standing(excerpt.scans[0].end_ns, np.eye(3), params)
    if guide is not None:  # it gives the turns, so there is no additional rate
        here.covariance[BG, BG] = 1e-12 * np.eye(3)
    states, residuals, clouds = [here.state], [float("nan")], [excerpt.scans[0].points]
    local_map.insert(excerpt.scans[0].points, np.zeros(3), params.map)
    for k, scan in enumerate(excerpt.scans[1:], 1):
        last, changes = here.state, _changes(excerpt, scan.end_ns)
        course = coast.Course.steady(last.stamp_ns, scan.end_ns)
        if guide is None:
            here = coast.propagate(here, scan.end_ns, course, changes)
        else:
            course = guide.course(float(times[k]), course.times, last.R_odom_imu)
            here = coast.propagate(here, scan.end_ns, course, (0.0, changes[1]))
            here.covariance[ROT, ROT] += GYRO**2 * -course.times[0] * np.eye(3)
        here, registration = coast.update(here, scan, course, local_map, params.filter)
        state = here.state
        if not np.isfinite(state.T_odom_imu).all():
            raise np.linalg.LinAlgError("the odometry gave no finite pose")
        points = coast.deskew(scan, state, course)
        local_map.insert(lie.moved(state.T_odom_imu.astype(np.float32), points), state.p_odom_imu, params.map)
        states.append(state)
        residuals.append(registration.residual_rms)
        clouds.append(points)
        progress(k / (len(excerpt.scans) - 1))
    poses = np.stack([state.T_odom_imu for state in states])
    return Track(times, poses[:, :3, :3], poses[:, :3, 3], np.array(residuals), tuple(clouds))


def _changes(excerpt: Excerpt, end_ns: int) -> tuple[float, float]:
    """How fast a scan's rates may change, by the IMU (rad/s and m/s²; norms, so that its mounting does not matter)."""
    around = np.searchsorted(excerpt.imu.stamps_ns, end_ns + np.array([-AROUND_S - 0.1, AROUND_S]) * 1e9)
    gyro, accel = excerpt.imu.gyro[slice(*around)], excerpt.imu.accel[slice(*around)]
    if len(gyro) < 3:
        return coast.CHANGES
    turning = float(np.linalg.norm(gyro - gyro.mean(axis=0), axis=1).max())
    moving = float(np.linalg.norm(accel.std(axis=0)))
    return max(turning, LEAST_CHANGES[0]), max(moving, LEAST_CHANGES[1])
