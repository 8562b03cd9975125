"""An upright box in the map, rotated about its middle, for clipping, exports and sections."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from app.slam.errors import HemislamError
from app.slam.types import F64, Vector

_FARTHEST_M: Final = 1e6
"""Largest distance from the map's origin: no map is that large."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box in the map. Its front is the side that faces -y before the box is rotated.

    Attributes:
        low, high: least and greatest x, y, z before rotation, m, map.
        turn: rotation about the vertical through its middle, degrees, anticlockwise from above.

    Raises:
        HemislamError: a value is not a number, out of range, or low is not below high.
    """

    low: Vector
    high: Vector
    turn: float = 0.0

    def __post_init__(self) -> None:
        if not all(-_FARTHEST_M < low < high < _FARTHEST_M for low, high in zip(self.low, self.high, strict=True)):
            raise HemislamError("The box is empty; give xmin,ymin,zmin,xmax,ymax,zmax with each minimum first.")
        if not abs(self.turn) <= 360:
            raise HemislamError(f"A box cannot be turned by {self.turn:g}°; give -360 to 360.")

    @classmethod
    def around(cls, middle: npt.ArrayLike, size: npt.ArrayLike, turn: float = 0.0) -> "Box":
        """A box given by its middle and size, (3,) m each."""
        half = np.asarray(size, np.float64) / 2
        low, high = np.asarray(middle) - half, np.asarray(middle) + half
        return cls((low[0], low[1], low[2]), (high[0], high[1], high[2]), (turn + 180) % 360 - 180)

    @property
    def middle(self) -> F64:
        """(3,) m."""
        return (np.array(self.low) + self.high) / 2

    @property
    def size(self) -> F64:
        """(3,) m, size along the box's own axes."""
        return np.array(self.high) - self.low

    @property
    def axes(self) -> F64:
        """(3, 3) the box's axes as columns, in the map."""
        c, s = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def own(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """(n, 3) points of the map relative to the box's middle, along its axes; same precision."""
        return (points - self.middle.astype(points.dtype)) @ self.axes.astype(points.dtype)

    def holds(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
        """(n,) whether points of the map are inside."""
        return np.asarray((np.abs(self.own(points)) <= self.size / 2).all(axis=1))
