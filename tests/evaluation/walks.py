"""Synthetic trajectories for the tests of evaluation, and the files that other tools would write for them."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
R_BODY_IMU = Rotation.from_matrix([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""The body has x right, y forward, z up; the IMU looks forward along its z, its x points down."""


def wandering(seconds: np.ndarray, seed: int = 0) -> Trajectory:
    """A smooth walk with the IMU's axes, at `seconds` after START_NS."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 6)
    x = 6 * np.sin(0.11 * seconds + phase[0]) + 0.9 * seconds
    y = 9 * np.cos(0.07 * seconds + phase[1])
    z = 0.3 * np.sin(0.4 * seconds + phase[2])
    heading = 0.9 * np.sin(0.21 * seconds + phase[3]) + 0.5 * np.sin(0.83 * seconds + phase[4])
    pitch = 0.06 * np.sin(1.7 * seconds + phase[5])
    roll = 0.05 * np.sin(1.1 * seconds + phase[0])
    body = Rotation.from_euler("ZXY", np.column_stack([-heading, pitch, roll]))
    stamps = START_NS + np.rint(seconds * 1e9).astype(np.int64)
    return Trajectory(stamps, np.column_stack([x, y, z]), (body * R_BODY_IMU).as_quat())


def frames(duration_s: float = 80.0, begin_s: float = 0.1) -> np.ndarray:
    """Ends of scans at 10 Hz."""
    return np.arange(begin_s, duration_s, 0.1)


def gnss_lines(walk: Trajectory, week_s: float, lever: tuple[float, float, float]) -> list[str]:
    """The H2LID table of a walk: its first pose is at `week_s` of the GPS week, positions are the antenna's."""
    body = walk.rotations * R_BODY_IMU.inv()
    antenna = walk.positions + body.apply(lever) + [533_843.632, 3_379_901.251, 17.899]
    yaw, pitch, roll = body.as_euler("ZXY", degrees=True).T
    seconds = (walk.stamps_ns - walk.stamps_ns[0]) * 1e-9 + week_s
    return [
        f"{t:.3f} {p[0]:.3f} {p[1]:.3f} {p[2]:.3f} {-h:.10f} {q:.10f} {r:.10f} 30.5388466765 114.3526809197"
        " 0.000 -0.002 -0.001 1"
        for t, p, h, q, r in zip(seconds, antenna, yaw, pitch, roll, strict=True)
    ]


def write(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path
