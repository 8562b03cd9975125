"""Detect where odometry slipped: surfaces seen just before the slip and just after it do not coincide.

A submap across a slip holds every surface twice. A cloud registered to such a submap ends up between the two copies, or
on the copy that does not belong to the submap's keyframe.
"""

from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.loops.verification import Prepared, assess, information, register
from app.slam.types import F64

REACH = 4
"""Keyframes on each side of a step; their clouds are registered to each other."""
POINT_M, INDEPENDENT = 0.03, 0.05
"""Standard deviation of a point's distance to a plane seen moments before; share of points with independent errors."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.25)
"""Smallest standard deviations of such a registration, however many points it has."""
BREAK_M, BREAK_RAD = 1.0, np.radians(15.0)
"""A slip larger than this may be a break. Odometry that drifts a lot slips at every step, but by less."""
BREAK_OVERLAP = 0.3
"""Least overlap at a break; loops need the same (`loops.min_overlap`)."""
LIKELY = 2.5
"""Largest deviation, in standard deviations, at which odometry still counts as right."""


@dataclass(frozen=True, slots=True)
class Slip:
    """Attributes:
    moved: (6,) rad and m, how far registration moves the surroundings seen after a step from where odometry places
        them: rotation about their origin, then translation, in level axes.
    is_break: whether the slip is so large and so well seen that odometry across the step is no evidence.
    """

    moved: F64
    is_break: bool


def slip(before: Prepared, after: Prepared, T_guess: F64) -> Slip | None:
    """How odometry slipped on a step; None if it is right within `LIKELY` standard deviations.

    Args:
        before, after: surroundings seen on either side of the step. T_guess: (4, 4) T_before_after of the level frames,
            by odometry.
    """
    T = register(before, after, T_guess)
    moved = np.concatenate([lie.log(T[:3, :3] @ T_guess[:3, :3].T), T[:3, 3] - T_guess[:3, 3]])
    certain = np.linalg.pinv(information(before, after, T) * (INDEPENDENT / POINT_M**2))
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    if moved @ np.linalg.solve(certain + floor, moved) <= LIKELY**2:
        return None
    far = bool(np.linalg.norm(moved[:3]) > BREAK_RAD or np.linalg.norm(moved[3:]) > BREAK_M)
    return Slip(moved, far and assess(before, after, T).overlap >= BREAK_OVERLAP)
