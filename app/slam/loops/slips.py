"""Where odometry slipped: there the surfaces seen just before and just after lie apart.

A submap across a slip holds every surface twice. What is laid on it comes to lie in between, or on the part that does
not belong to its keyframe.
"""

import numpy as np

from app.slam import lie
from app.slam.loops.verification import Prepared, information, register
from app.slam.types import F64

REACH = 4
"""Keyframes on either side of a step that are laid on one another."""
POINT_M, INDEPENDENT = 0.03, 0.05
"""Standard deviation of a point's distance to a plane seen moments before, and the share of independent errors."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.25)
"""Least standard deviations of such a registration, however many points it has."""
LIKELY = 2.5
"""Standard deviations up to which odometry holds."""


def slip(before: Prepared, after: Prepared, T_guess: F64) -> F64 | None:
    """How far the surroundings seen after a step lie from where odometry says, in directions that they constrain.

    Args:
        T_guess: (4, 4) T_before_after of the level frames, by odometry.

    Returns:
        (6,) rad and m, rotation about the origin of `after`, then translation, in level axes; None: odometry holds.
    """
    T = register(before, after, T_guess)
    moved = np.concatenate([lie.log(T[:3, :3] @ T_guess[:3, :3].T), T[:3, 3] - T_guess[:3, 3]])
    certain = np.linalg.pinv(information(before, after, T) * (INDEPENDENT / POINT_M**2))
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    return moved if moved @ np.linalg.solve(certain + floor, moved) > LIKELY**2 else None
