"""Which scan line a point belongs to: the rank of the line's elevation, 0 = lowest = outermost cone."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, F64, U16

if TYPE_CHECKING:
    from app.sensors.pointcloud import CloudMessage


@dataclass(frozen=True, slots=True)
class Rings:
    """Where the ring of a point comes from: a field of the message, or the point's elevation.

    Attributes:
        field: name of the field; None: from the elevation.
        rank: (lines,) uint16, rank by elevation of each value of the field; None: it is the rank.
        bounds: (lines - 1,) rad, ascending, elevations between the lines, when there is no field.
        centre: (radial, height) m, where the beams start from, when there is no field.
    """

    field: str | None
    rank: U16 | None = None
    bounds: F64 | None = None
    centre: tuple[float, float] = (0.0, 0.0)

    def of(self, cloud: "CloudMessage", points: F32, index: npt.NDArray[np.intp] | None) -> U16:
        """(n,) uint16 ring of the kept points; `index` tells which of the message they are."""
        if self.field is None:
            assert self.bounds is not None
            return np.searchsorted(self.bounds, elevation(points, self.centre)).astype(np.uint16)
        raw = cloud.column(self.field)
        raw = (raw if index is None else raw.take(index)).astype(np.uint16)
        if self.rank is None:
            return raw
        return self.rank[np.minimum(raw, len(self.rank) - 1)]


def elevation(points: F32, centre: tuple[float, float] = (0.0, 0.0)) -> F64:
    """(n,) rad above the sensor's base plane, seen from where the beams start (radial, height) m."""
    radial, height = centre
    level = np.hypot(points[:, 0], points[:, 1]) - np.float32(radial)
    return np.arctan2(points[:, 2] - np.float32(height), level).astype(np.float64)
