"""The IMU: exact motion, plus the noise and biases of the paper's Owllmo IMU3910."""

from dataclasses import dataclass

import numpy as np

from app.sensors.simulator.trajectory import SmoothTrajectory, seconds
from app.slam.types import F64, I64, ImuSamples

RATE_HZ = 200


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Gyroscope in rad/s, accelerometer in m/s^2.

    Attributes:
        gyro, accel: spread of a sample's white noise (paper 2.1, in the units it prints).
        gyro_bias, accel_bias: spread of the constant bias each axis starts with.
        gyro_walk, accel_walk: growth of the bias's random walk, per sqrt(s) (paper 2.1).
    """

    gyro: float = 1.2e-3
    accel: float = 1.3e-2
    gyro_bias: float = 5e-3
    accel_bias: float = 3e-2
    gyro_walk: float = 2.5e-5
    accel_walk: float = 1.0e-4


PERFECT = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def measure(
    trajectory: SmoothTrajectory, stamps_ns: I64, start_ns: int, noise: ImuNoise, rng: np.random.Generator
) -> ImuSamples:
    """Read the IMU at `stamps_ns`; the trajectory's time 0 is `start_ns`."""
    t = seconds(stamps_ns - start_ns)
    rate, force = trajectory.motion(t)
    gyro = rate + _errors(len(t), noise.gyro, noise.gyro_bias, noise.gyro_walk, rng)
    accel = force + _errors(len(t), noise.accel, noise.accel_bias, noise.accel_walk, rng)
    return ImuSamples(stamps_ns, gyro, accel)


def _errors(count: int, white: float, bias: float, walk: float, rng: np.random.Generator) -> F64:
    start = rng.normal(scale=1.0, size=3) * bias
    steps = rng.normal(size=(count, 3)) * (walk / np.sqrt(RATE_HZ))
    return np.asarray(start + np.cumsum(steps, axis=0) + rng.normal(size=(count, 3)) * white)
