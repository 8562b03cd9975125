"""Where odometry slipped: there the surfaces seen just before and just after lie apart.

A submap across a slip holds every surface twice. What is laid on it comes to lie in between, or on the part that does
not belong to its keyframe.
"""

import numpy as np

from app.slam import lie
from app.slam.loops.verification import Prepared, information, register

REACH = 4
"""Keyframes on either side of a step that are laid on one another."""
POINT_M, INDEPENDENT = 0.03, 0.05
"""Standard deviation of a point's distance to a plane seen moments before, and the share of independent errors."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.25)
"""Least standard deviations of such a registration, however many points it has."""
LIKELY = 2.5
"""Standard deviations up to which odometry holds."""


def slipped(before: Prepared, after: Prepared) -> bool:
    """Whether the surroundings seen after a step lie elsewhere than odometry says, in a direction that they constrain.

    Args:
        before, after: submaps in the same level frame, by odometry.
    """
    T = register(before, after, np.eye(4))
    moved = np.concatenate([lie.log(T[:3, :3]), T[:3, 3]])
    certain = np.linalg.pinv(information(before, after, T) * (INDEPENDENT / POINT_M**2))
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    return bool(moved @ np.linalg.solve(certain + floor, moved) > LIKELY**2)
