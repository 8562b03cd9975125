"""Where on Earth a map lies."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from app.georeference import crs
from app.slam.arrays import F64, Vector
from app.slam.errors import HemislamError

FILE, RESIDUALS, PLOT = "georeference.json", "gnss_residuals.csv", "georeference.svg"
"""Files beside the results: the georeference, the fixes that it is made from, and a drawing of both."""
ELLIPSOIDAL = crs.ELLIPSOIDAL


@dataclass(frozen=True, slots=True)
class GeoReference:
    """Where on Earth a map lies: grid = origin + scale * (rotation @ map), with a height that has no scale.

    Attributes:
        crs: a projected system in metres: "EPSG:32632" or WKT2.
        origin: easting, northing and height of the map's origin, m.
        rotation: rows of the (3, 3) rotation from the map's axes to east, north and up of the grid.
        scale: metres of the grid per metre on the ground there; a map keeps its true size, a grid does not.
        height: what heights are above: "ellipsoidal", "EPSG:code" of a system of heights, or other words.

    Raises:
        HemislamError: the code is not that of a system of heights.
    """

    crs: str
    origin: Vector
    rotation: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scale: float = 1.0
    height: str = ELLIPSOIDAL

    def __post_init__(self) -> None:
        crs.vertical(self.height)

    def to_crs(self, points_map: F64) -> F64:
        """(n, 3) m in the map to (n, 3) float64 easting, northing, height, m."""
        points = np.asarray(points_map, np.float64).reshape(-1, 3)
        return np.asarray(self.origin + (points @ np.array(self.rotation).T) * self._scales)

    def from_crs(self, points_crs: F64) -> F64:
        """The inverse of `to_crs`."""
        points = np.asarray(points_crs, np.float64).reshape(-1, 3) - self.origin
        return np.asarray((points / self._scales) @ np.array(self.rotation))

    def to_geographic(self, points_map: F64) -> F64:
        """(n, 3) m in the map to (n, 3) float64 latitude and longitude in degrees (WGS84) and height in m."""
        east, north, height = self.to_crs(points_map).T
        longitude, latitude = crs.transformer(self.crs, crs.WGS84).transform(east, north)
        return np.column_stack([latitude, longitude, height])

    def wkt1(self) -> str:
        """Grid and heights as well-known text; without heights if they are named in other words."""
        return crs.wkt1(self.crs, self.height)

    @property
    def raster_crs(self) -> str:
        """The same for a GeoTIFF, as code or text: GDAL cannot write a grid with heights above the ellipsoid there."""
        return crs.projected(self.crs).to_wkt() if self.height == ELLIPSOIDAL else self.wkt1()

    @property
    def _scales(self) -> F64:
        return np.array([self.scale, self.scale, 1.0])

    def to_json(self) -> str:
        """Every digit, so that `from_json` gives an equal value."""
        return json.dumps(asdict(self), indent=2, ensure_ascii=False) + "\n"

    @staticmethod
    def from_json(text: str | bytes) -> "GeoReference":
        """Raises HemislamError: it is not a georeference, or its coordinate system cannot be used."""
        try:
            read = _ADAPTER.validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            raise HemislamError(
                f"This is not a georeference ({'.'.join(map(str, first['loc']))}: {first['msg']}); write a new one with"
                " hemislam georeference."
            ) from None
        R = np.array(read.rotation)
        sound = (
            np.isfinite(read.origin).all() and 0.01 < read.scale < 100.0 and np.allclose(R @ R.T, np.eye(3), atol=1e-3)
        )
        if not sound:
            raise HemislamError(
                "This is not a georeference (its numbers are no place, no rotation or no scale); write a new one with"
                " hemislam georeference."
            )
        crs.projected(read.crs)
        return read


_ADAPTER = TypeAdapter(GeoReference)


def read(folder: Path) -> tuple[GeoReference | None, str]:
    """The georeference of the results in a folder; else None, and why the one there is not used ("" if none is)."""
    try:
        return GeoReference.from_json((folder / FILE).read_bytes()), ""
    except FileNotFoundError:
        return None, ""
    except (HemislamError, OSError) as error:
        why = f"it cannot be read: {error.strerror}." if isinstance(error, OSError) else error
        return None, f"The georeference of {folder / FILE} is not used: {why}"
