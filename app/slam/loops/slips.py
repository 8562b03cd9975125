"""Detect where odometry slipped: surfaces seen just before and just after do not coincide there.

A submap across a slip holds every surface twice. A cloud registered to it ends up in between, or on the part that does
not belong to the submap's keyframe.
"""

import numpy as np

from app.slam import lie
from app.slam.loops.verification import Prepared, information, register
from app.slam.types import F64

REACH = 4
"""Keyframes on each side of a step; their clouds are registered to each other."""
POINT_M, INDEPENDENT = 0.03, 0.05
"""Standard deviation of a point's distance to a plane seen moments before; share of points with independent errors."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.25)
"""Smallest standard deviations of such a registration, however many points it has."""
BREAK_M, BREAK_RAD = 1.0, np.radians(15.0)
"""A slip larger than this is a break. Odometry that drifts a lot slips at every step, but by less."""
LIKELY = 2.5
"""Largest deviation, in standard deviations, at which odometry still counts as right."""


def is_break(slip: F64 | None) -> bool:
    """Whether a slip (6,) is so large that odometry is no evidence across it."""
    return slip is not None and bool(np.linalg.norm(slip[:3]) > BREAK_RAD or np.linalg.norm(slip[3:]) > BREAK_M)


def slip(before: Prepared, after: Prepared, T_guess: F64) -> F64 | None:
    """How far registration moves the surroundings seen after a step from where odometry places them.

    Args:
        T_guess: (4, 4) T_before_after of the level frames, by odometry.

    Returns:
        (6,) rad and m, rotation about the origin of `after`, then translation, in level axes; None if odometry is right
        within `LIKELY` standard deviations.
    """
    T = register(before, after, T_guess)
    moved = np.concatenate([lie.log(T[:3, :3] @ T_guess[:3, :3].T), T[:3, 3] - T_guess[:3, 3]])
    certain = np.linalg.pinv(information(before, after, T) * (INDEPENDENT / POINT_M**2))
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    return moved if moved @ np.linalg.solve(certain + floor, moved) > LIKELY**2 else None
