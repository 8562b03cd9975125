"""The handles of a clip box: where they are, and how moving one changes the box. Also boxes along a line."""

from typing import Final

import numpy as np

from app.export.box import Box
from app.slam.types import F32, F64

LEAST_M: Final = 0.05
"""Least length, width and height of a box."""
FACES: Final = tuple((axis, sign) for axis in range(3) for sign in (-1, 1))
"""Sides of a box: the axis (in the box's own frame), and -1 for its low or +1 for its high end."""
_EDGES: Final = np.array([(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1])


def handle(box: Box, axis: int, sign: int) -> tuple[F64, F64]:
    """(3, 3) rotation and (3,) position in the map of a side's handle; the handle's axis points outwards."""
    axes = box.axes
    if sign < 0:  # rotate by 180° about another axis
        flip = -np.ones(3)
        flip[(axis + 1) % 3] = 1.0
        axes = axes * flip
    return axes, box.middle + box.axes[:, axis] * sign * box.size[axis] / 2


def pulled(box: Box, axis: int, sign: int, place: F64) -> Box:
    """The box after one side's handle was moved to (3,) m; the other sides stay."""
    other = -sign * box.size[axis] / 2
    now = float((place - box.middle) @ box.axes[:, axis])
    now = max(now, other + LEAST_M) if sign > 0 else min(now, other - LEAST_M)
    size = box.size.copy()
    size[axis] = abs(now - other)
    return Box.around(box.middle + box.axes[:, axis] * (now + other) / 2, size, box.turn)


def carried(box: Box, R: F64, place: F64) -> Box:
    """The box after its middle handle was moved to (3,) m and turned: (3, 3) rotation about z."""
    return Box.around(place, box.size, float(np.degrees(np.arctan2(R[1, 0], R[0, 0]))))


def along_line(first: F64, second: F64, width: float, low: float, high: float) -> Box | None:
    """A slab of the map from one place (3,) to another, `width` thick. Seen from its front, the first is on the left.

    Args:
        low, high: least and greatest z of the map, m.

    Returns:
        None if one place is above the other.
    """
    across = (second - first)[:2]
    length = float(np.hypot(*across))
    if length < LEAST_M:
        return None
    middle = np.append((first + second)[:2] / 2, (low + high) / 2)
    size = (length, width, max(high - low, LEAST_M))
    return Box.around(middle, size, float(np.degrees(np.arctan2(across[1], across[0]))))


def edges(box: Box) -> F32:
    """(12, 2, 3) m, the edges of a box in the map."""
    corners = np.array([[(k >> axis & 1) - 0.5 for axis in range(3)] for k in range(8)]) * box.size
    return np.asarray((corners @ box.axes.T + box.middle)[_EDGES], np.float32)
