"""A made-up result of a calibration."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from app.calibration.calibrate import Calibration
from app.calibration.inertial import Noise
from app.calibration.lines import Lines
from app.calibration.rotation import Turned
from app.calibration.translation import Moved
from app.slam.params import Params

MID360 = np.array([-0.011, -0.02329, 0.04412])
"""Of the IMU in a Mid-360, by its manual."""
TURN = Rotation.from_euler("ZYX", [104.0, -50.0, 70.0], degrees=True).as_matrix()


def known(recording: Path, *, sure: bool = True, params: Params | None = None, preset: str = "") -> Calibration:
    """What might have been found."""
    wide = 1e-6 if sure else 1.0
    rows = np.linspace(0.0, 0.01, 30).reshape(-1, 3)
    turned = Turned(TURN, 0.02, np.zeros(3), np.eye(7) * wide, rows * 2, rows)
    moved = Moved(MID360, np.zeros(3), np.array([0.0, 0.0, -9.81]), np.eye(6) * wide, rows * 2, rows)
    return Calibration(
        recording,
        params or Params(),
        preset,
        30.0,
        turned,
        moved,
        np.array([0.0, 0.0, -1.0]),
        (0.02, 0.01),
        Noise(1e-3, 1e-4),
        Noise(1e-2, 1e-3),
        Lines.none(0),
    )
