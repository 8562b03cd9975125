"""True metres on the ground around a place; those of a grid are stretched, and its numbers are large."""

from dataclasses import dataclass, replace

import numpy as np

from app.georeference import crs
from app.georeference.fixes import Fixes
from app.georeference.reference import GeoReference
from app.slam.arrays import F64
from app.slam.errors import HemislamError


@dataclass(frozen=True, slots=True)
class Ground:
    """Places in true metres on the ground, relative to a point near them.

    Attributes:
        grid: (n, 3) easting, northing, height, m. places: (n, 3) m east, north, up of the centre.
        centre: a level map whose origin is that point: whole metres of the grid, and its scale there.
    """

    grid: F64
    places: F64
    centre: GeoReference

    @classmethod
    def of(cls, fixes: Fixes, name: str = "") -> "Ground":
        """Raises HemislamError: the grid does not exist, or is not made for the place."""
        latitude, longitude, height = fixes.places.T
        middle = float(np.median(latitude)), float(np.median(longitude))
        name = name or crs.utm(*middle)
        crs.check_place(name, *middle)
        flat = crs.transformer(crs.WGS84, name).transform(longitude, latitude)
        return cls.in_grid(np.column_stack([*flat, height]), name)

    @classmethod
    def in_grid(cls, grid: F64, name: str) -> "Ground":
        """From (n, 3) easting, northing and height. Raises HemislamError: the grid is not made for the place."""
        east, north, up = np.round(np.median(grid, axis=0)).tolist()
        try:
            latitude, longitude = crs.place(name, east, north)
        except HemislamError:
            if _is_place(name, north, east):
                raise HemislamError(
                    f"Easting and northing seem to be swapped: only with them exchanged does {name} fit; exchange the"
                    " columns."
                ) from None
            raise
        scale = crs.grid_scale(name, latitude, longitude, up)
        level = GeoReference(name, (east, north, up), scale=scale)
        return cls(grid, level.from_crs(grid), level)

    def reference(self, R_ground_map: F64, shift: F64, height: str) -> GeoReference:
        """The georeference of a map whose origin is at `shift` (3,) m from the centre."""
        (origin,), rows = self.centre.to_crs(shift).tolist(), map(tuple, R_ground_map.tolist())
        return replace(self.centre, origin=tuple(origin), rotation=tuple(rows), height=height)  # type: ignore[arg-type]


def _is_place(name: str, east: float, north: float) -> bool:
    """Whether a grid is made for the place with these coordinates, m."""
    try:
        crs.place(name, east, north)
    except HemislamError:
        return False
    return True
