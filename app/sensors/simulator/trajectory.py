"""The trajectory of a handheld scanner as one smooth curve, and the measurements of an IMU along it.

The curve is a quintic spline through samples of (x, y, z, yaw, pitch, roll), so that derivatives are exact: poses,
angular rates and specific forces are consistent.

Frames: `world` has z up; `body` has x forward, y left, z up. By default, the IMU is mounted as on H2LID: z forward,
x down, y left, so that it reads -9.81 m/s^2 on x at rest.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d  # type: ignore[attr-defined]  # scipy ships no types
from scipy.spatial.transform import Rotation

from app.slam.metrics import walked_m
from app.slam.types import F64, I64, ImuSamples

GRAVITY = 9.81
IMU_RATE_HZ = 200
R_BODY_IMU: F64 = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

_SAMPLE_HZ = 50.0
_STEP_HZ = 1.8


def seconds(ns: I64) -> F64:
    """Convert differences of integer nanoseconds to seconds, the unit of a trajectory's time."""
    return ns.astype(np.float64) * 1e-9


class SmoothTrajectory:
    """Poses of the IMU at any time. Times are seconds from the recording's start, (n,) arrays."""

    def __init__(self, times: F64, samples: F64, R_body_imu: F64 = R_BODY_IMU) -> None:
        """Args: times (n,) increasing; samples (n, 6) of x, y, z (m), yaw, pitch, roll (rad) of the body."""
        self.R_body_imu = R_body_imu
        self._spline: BSpline = make_interp_spline(times, samples, k=5)
        self._rate = self._spline.derivative(1)
        self._acceleration = self._spline.derivative(2)

    def poses(self, t: F64) -> tuple[F64, F64]:
        """Positions p_world_imu (n, 3) and rotations R_world_imu (n, 3, 3)."""
        values = self._spline(t)
        return values[:, :3], Rotation.from_euler("ZYX", values[:, 3:]).as_matrix() @ self.R_body_imu

    def motion(self, t: F64) -> tuple[F64, F64]:
        """Measurements of a perfect IMU: angular rate (n, 3) rad/s and specific force (n, 3) m/s^2, IMU frame."""
        _, pitch, roll = self._spline(t)[:, 3:].T
        yaw_rate, pitch_rate, roll_rate = self._rate(t)[:, 3:].T
        body_rate = np.column_stack(
            [
                roll_rate - yaw_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
                -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
            ]
        )
        _, R_world_imu = self.poses(t)
        force = self._acceleration(t)[:, :3] + np.array([0.0, 0.0, GRAVITY])
        return body_rate @ self.R_body_imu, np.einsum("nji,nj->ni", R_world_imu, force)


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """The errors of the paper's Owllmo IMU3910; gyroscope in rad/s, accelerometer in m/s^2.

    Attributes:
        gyro, accel: standard deviation of a sample's white noise (paper 2.1, in the units printed there).
        gyro_bias, accel_bias: standard deviation of each axis's initial bias.
        gyro_walk, accel_walk: growth of the bias's random walk, per sqrt(s) (paper 2.1).
    """

    gyro: float = 1.2e-3
    accel: float = 1.3e-2
    gyro_bias: float = 5e-3
    accel_bias: float = 3e-2
    gyro_walk: float = 2.5e-5
    accel_walk: float = 1.0e-4


def measured(
    trajectory: SmoothTrajectory, stamps_ns: I64, start_ns: int, noise: ImuNoise, rng: np.random.Generator
) -> ImuSamples:
    """Measurements of the IMU at `stamps_ns`; the trajectory's time 0 is `start_ns`."""
    t = seconds(stamps_ns - start_ns)
    rate, force = trajectory.motion(t)
    gyro = rate + _errors(len(t), noise.gyro, noise.gyro_bias, noise.gyro_walk, rng)
    accel = force + _errors(len(t), noise.accel, noise.accel_bias, noise.accel_walk, rng)
    return ImuSamples(stamps_ns, gyro, accel)


@dataclass(frozen=True, slots=True)
class Walker:
    """How the person who carries the sensor walks.

    Attributes:
        speed: m/s. height: m, of the IMU above the ground. still: s, standing still at the start.
        bob, sway: m, amplitudes of the motion up and down (every step) and sideways (every other step).
        pitch, roll, yaw: rad, standard deviations of the hand's slow rotation about each axis.
        wander: m, standard deviation of the slow sideways deviation from the path.
        back: turn round at the end of the path and walk back.
    """

    speed: float = 1.2
    height: float = 1.25
    still: float = 2.5
    bob: float = 0.02
    sway: float = 0.015
    pitch: float = np.deg2rad(2.5)
    roll: float = np.deg2rad(2.0)
    yaw: float = np.deg2rad(5.0)
    wander: float = 0.08
    back: bool = False


def walk(
    path: F64,
    duration_s: float,
    rng: np.random.Generator,
    *,
    walker: Walker,
    closed: bool = True,
    height: Callable[[F64], F64] | None = None,
    R_body_imu: F64 = R_BODY_IMU,
) -> SmoothTrajectory:
    """A person walks along waypoints: round a closed path for the whole time, or to the end of an open path.

    Args:
        path: (n, 2) waypoints in plan view, m, or (n, 3) with the floor's z at each. height: z of the ground at (n, 2)
            points; None: 0, or the path's z.
        R_body_imu: how the IMU is mounted.
    """
    t = np.arange(-1.0, duration_s + 1.0, 1.0 / _SAMPLE_HZ)
    awake = _smoothstep((t - walker.still) / 1.5)
    # Smoothing also affects the time before the first step, hence the delay of one second.
    walking = _smoothstep((t - walker.still - 1.0) / 1.5)
    speed = walker.speed * walking * (1.0 + 0.1 * _wander(t, rng, (0.05, 0.15)))
    travelled = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2) / _SAMPLE_HZ])

    if walker.back:
        path = np.vstack([path, path[:1], path[:0:-1]]) if closed else np.vstack([path, path[-2::-1]])
    line, arc = _unrolled(path, closed, travelled[-1] + 5.0)
    if not closed:
        travelled = _brake(travelled, arc[-1])
    places = places_at(travelled, arc, line)
    xy = np.column_stack([gaussian_filter1d(places[:, k], 0.4 * _SAMPLE_HZ, mode="nearest") for k in (0, 1)])

    # The walker looks half a metre ahead, and spreads a turn over about the same distance.
    step = 0.05
    s = np.arange(0.0, arc[-1], step)
    directions = np.unwrap(np.arctan2(*np.gradient(places_at(s, arc, line)[:, :2], axis=0).T[::-1]))
    directions = gaussian_filter1d(directions, 0.6 / step, mode="nearest")
    heading = np.interp(travelled + 0.5, s, directions)
    heading = gaussian_filter1d(heading, 0.2 * _SAMPLE_HZ, mode="nearest")

    floor = height(xy) if height is not None else places[:, 2] if places.shape[1] == 3 else np.zeros(len(t))
    floor = gaussian_filter1d(floor, 0.3 * _SAMPLE_HZ, mode="nearest")

    steps = 2 * np.pi * _STEP_HZ * (t + 0.3 * _wander(t, rng, (0.05, 0.1)) / _STEP_HZ)
    sideways = walker.sway * np.sin(steps / 2) + walker.wander * _wander(t, rng, (0.05, 0.2))
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    xy = xy + left * (awake * sideways)[:, None]
    z = floor + walker.height + awake * walker.bob * np.sin(steps)
    nod = np.deg2rad(0.5) * np.sin(steps + 1.0)
    samples = np.column_stack(
        [
            xy,
            z,
            heading + awake * walker.yaw * _wander(t, rng, (0.15, 0.7)),
            rng.normal(scale=np.deg2rad(1.0)) + awake * (walker.pitch * _wander(t, rng, (0.2, 1.0)) + nod),
            rng.normal(scale=np.deg2rad(1.0)) + awake * walker.roll * _wander(t, rng, (0.2, 1.0)),
        ]
    )
    return SmoothTrajectory(t, samples, R_body_imu)


def _smoothstep(x: F64) -> F64:
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (x * (6.0 * x - 15.0) + 10.0)


def _wander(t: F64, rng: np.random.Generator, band_hz: tuple[float, float]) -> F64:
    """A smooth random function with unit standard deviation: a few sines with frequencies in the band."""
    frequencies = rng.uniform(*band_hz, 5)
    phases = rng.uniform(0, 2 * np.pi, 5)
    return np.asarray(np.sin(2 * np.pi * np.outer(t, frequencies) + phases).sum(axis=1) * np.sqrt(2 / 5))


def _unrolled(path: F64, closed: bool, length: float) -> tuple[F64, F64]:
    """The path as one polyline, of at least `length` if closed, and the arc length at each vertex."""
    line = np.asarray(path, np.float64)
    if closed:
        lap = np.vstack([line, line[:1]])
        lap_length = float(np.linalg.norm(np.diff(lap, axis=0), axis=1).sum())
        line = np.vstack([line] * (int(length / lap_length) + 2))
    return line, walked_m(line)


def places_at(lengths: F64, arc: F64, line: F64) -> F64:
    """(k, 2 or 3) points on a polyline at these arc lengths; `arc` is `walked_m(line)`."""
    return np.column_stack([np.interp(lengths, arc, along) for along in line.T])


def _brake(travelled: F64, end: float) -> F64:
    """From two metres before the end of an open path, slow down gently; stop one metre before the end."""
    limit = end - 1.0
    over = np.maximum(travelled - (limit - 1.0), 0.0)
    return np.where(travelled > limit - 1.0, limit - 1.0 + np.tanh(over), travelled)


def _errors(count: int, white: float, bias: float, walk: float, rng: np.random.Generator) -> F64:
    start = rng.normal(scale=1.0, size=3) * bias
    steps = rng.normal(size=(count, 3)) * (walk / np.sqrt(IMU_RATE_HZ))
    return np.asarray(start + np.cumsum(steps, axis=0) + rng.normal(size=(count, 3)) * white)
