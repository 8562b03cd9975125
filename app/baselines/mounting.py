"""Where the LiDAR is on the IMU, and how the world begins."""

import numpy as np

from app.slam import lie
from app.slam.params import Params
from app.slam.types import F64, ImuSamples


def mounting(params: Params) -> F64:
    """T_imu_lidar (4, 4), as the parameters say."""
    R = lie.from_rpy_degrees(params.sensor.rotation)
    return lie.transform(R, np.array(params.sensor.translation, np.float64))


def levelled(samples: ImuSamples) -> F64:
    """T_odom_imu (4, 4) of the first pose: at the origin, z against the gravity that the samples feel."""
    up = samples.accel.mean(axis=0) if len(samples) else np.array([0.0, 0.0, 1.0])
    return lie.transform(lie.between(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
