"""The engine on plain arrays: a sensor moves 2 m through a room of 10 x 8 x 3 m. All input is computed here.

python examples/engine_on_arrays.py
"""

import numpy as np

from app.slam.engine import Engine
from app.slam.params import Params
from app.slam.types import ImuSamples, Scan

LOW, HIGH = np.array([-4.0, -3.0, -1.2]), np.array([6.0, 5.0, 1.8])  # the room's corners, m
REST_S, MOVE_S, LENGTH_M = 1.5, 4.0, 2.0


def position(t: np.ndarray) -> np.ndarray:
    """Positions (n, 3) m at times (n,) s: at rest, then along x with a smooth start and end."""
    u = np.clip((t - REST_S) / MOVE_S, 0, 1)
    x = LENGTH_M * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def scan(start_s: float) -> Scan:
    """One revolution of 0.1 s with 32 lines; each ray starts at the sensor's position at the ray's own time."""
    azimuth, line = (
        grid.ravel() for grid in np.meshgrid(np.linspace(0, 2 * np.pi, 360, endpoint=False), np.arange(32))
    )
    elevation, offset_s = np.radians(-45 + 3 * line), 0.1 * azimuth / (2 * np.pi)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) * np.cos(elevation)[:, None]
    rays, origin = np.column_stack([flat, np.sin(elevation)]), position(start_s + offset_s)
    with np.errstate(divide="ignore"):
        reach = np.maximum((HIGH - origin) / rays, (LOW - origin) / rays).min(axis=1)
    points, offsets = (rays * reach[:, None]).astype(np.float32), (1e9 * offset_s).astype(np.int32)
    return Scan(int(1e9 * start_s), points, offsets, np.ones(len(points), np.float32), line.astype(np.uint16))


def imu(first_s: float, last_s: float) -> ImuSamples:
    """Samples at 200 Hz that cover the interval: zero angular rate, and the acceleration of the motion plus gravity."""
    times = np.arange(round(200 * first_s) - 1, round(200 * last_s) + 2) / 200
    u = np.clip((times - REST_S) / MOVE_S, 0, 1)
    accel = np.tile([0.0, 0.0, 9.81], (len(times), 1))
    accel[:, 0] = LENGTH_M * 2 * np.pi * np.sin(2 * np.pi * u) / MOVE_S**2
    return ImuSamples((1e9 * times).astype(np.int64), np.zeros((len(times), 3)), accel)


engine, end_s = Engine(Params()), 0.0
for frame in range(60):
    measured = scan(0.1 * frame)
    result = engine.step(measured, imu(end_s, measured.end_ns * 1e-9))
    end_s = measured.end_ns * 1e-9
moved = result.state.p_odom_imu
print(f"{result.status}: moved {moved[0]:.3f} {moved[1]:.3f} {moved[2]:.3f} m; the truth is {LENGTH_M:.3f} 0 0 m")
engine.close()
