"""Moving a browser's camera to a place."""

import time
from typing import Final

import numpy as np
import viser

from app.slam.types import F64

_STEPS: Final = 14
_STEP_S: Final = 0.03
_LEAST_SLOPE: Final = 0.9
"""Least steepness of the view downwards (z over the horizontal), to see into a building."""


def stand(position: F64, look_at: F64, target: F64, distance: float) -> F64:
    """(3,) where the camera must be to see `target` from `distance` (m), on the side it looked from before."""
    back = position - look_at
    flat = back[:2] if np.linalg.norm(back[:2]) > 1e-6 else np.array([-1.0, -1.0])
    flat = flat / np.linalg.norm(flat)
    slope = max(float(back[2] / max(np.linalg.norm(back[:2]), 1e-6)), _LEAST_SLOPE)
    way = np.array([*flat, min(slope, 3.0)])
    return np.asarray(target + distance * way / np.linalg.norm(way))


def fly(client: viser.ClientHandle, target: F64, distance: float) -> None:
    """Move one browser's camera to `target` (3,), in the scene's frame, within half a second."""
    camera = client.camera
    position, look_at = np.array(camera.position), np.array(camera.look_at)
    there = stand(position, look_at, target, distance)
    for step in range(1, _STEPS + 1):
        share = step / _STEPS
        share = share * share * (3 - 2 * share)
        with client.atomic():
            camera.position = (1 - share) * position + share * there
            camera.look_at = (1 - share) * look_at + share * target
        time.sleep(_STEP_S)
