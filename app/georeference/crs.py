"""Coordinate systems by pyproj: which fits a place, and the scale that its grid has there."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from app.slam.errors import HemislamError

if TYPE_CHECKING:  # imported where it is used: most runs need no coordinate system
    import pyproj

WGS84 = "EPSG:4979"
"""Latitude, longitude and height above the ellipsoid, as GNSS gives them."""
EARTH_M = 6_371_000.0
"""Mean radius."""
STEP_M = 50.0
"""Distance of the places from which the stretch of a grid is computed."""
SAME_STRETCH = 1e-5
"""Lengths in two directions may differ by this share: 1 mm in 100 m."""


@lru_cache(maxsize=32)
def projected(name: str) -> "pyproj.CRS":
    """A coordinate system by "EPSG:code" or WKT.

    Raises:
        HemislamError: it does not exist, is not a plane grid of eastings and northings in metres, or has heights.
    """
    crs = _system(name, "give one as EPSG:32632")
    if crs.is_compound:
        parts = (":".join(part.to_authority() or (part.name,)) for part in crs.sub_crs_list)
        raise HemislamError(f"{name} ({crs.name}) also has heights; give {' and, as that of heights, '.join(parts)}.")
    if not crs.is_projected:
        raise HemislamError(f"{name} ({crs.name}) is not a plane grid; give a projected one such as EPSG:32632.")
    if any(abs(axis.unit_conversion_factor - 1.0) > 1e-12 for axis in crs.axis_info):
        raise HemislamError(f"{name} ({crs.name}) is not in metres; give one that is.")
    if any(axis.direction == "west" for axis in crs.axis_info):
        raise HemislamError(
            f"{name} ({crs.name}) counts towards the west; give a grid of eastings and northings, such as ESRI:102562"
            " for EPSG:2048 or EPSG:5514 for EPSG:5513."
        )
    return crs


ELLIPSOIDAL = "ellipsoidal"
"""Heights above the ellipsoid of a grid."""
_ELLIPSOIDAL_WKT1 = (
    'VERT_CS["ellipsoidal height",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


def vertical(height: str) -> "pyproj.CRS | None":
    """The system of heights named "EPSG:code"; None if they are named in other words.

    Raises:
        HemislamError: it does not exist, or is not a system of upward heights in metres.
    """
    if not height.upper().startswith("EPSG:"):
        return None
    crs = _system(height, "give one of heights as EPSG:3855")
    up = crs.is_vertical and crs.axis_info[0].direction == "up" and crs.axis_info[0].unit_conversion_factor == 1.0
    if not up or crs.is_compound:
        raise HemislamError(f"{height} ({crs.name}) is not one of heights in metres; give one such as EPSG:3855.")
    return crs


def _system(name: str, advice: str) -> "pyproj.CRS":
    """Raises HemislamError: no system has this name; `advice` says what to give."""
    import pyproj

    try:
        return pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError:
        raise HemislamError(f"{name} names no coordinate system; {advice}.") from None


def wkt1(name: str, height: str) -> str:
    """A grid and its heights as well-known text of the form that LAS and E57 use; without heights if they have no code.

    WKT1 has no grids in 3-D. Heights above the ellipsoid are a vertical system of type 2002 (OGC 01-009), which PROJ
    and GDAL take for the third axis of the grid.
    """
    grid, heights = projected(name), vertical(height)
    if heights is None and height != ELLIPSOIDAL:
        return str(grid.to_wkt("WKT1_GDAL"))
    up = _ELLIPSOIDAL_WKT1 if heights is None else heights.to_wkt("WKT1_GDAL")
    return f'COMPD_CS["{grid.name} + {height if heights is None else heights.name}",{grid.to_wkt("WKT1_GDAL")},{up}]'


@lru_cache(maxsize=32)
def transformer(source: str, target: str) -> "pyproj.Transformer":
    """From one system to another; longitude before latitude, easting before northing. It leaves heights alone."""
    import pyproj

    first, second = (pyproj.CRS.from_user_input(name).to_2d() for name in (source, target))
    return pyproj.Transformer.from_crs(first, second, always_xy=True)


def utm(latitude: float, longitude: float) -> str:
    """The EPSG code of the UTM zone of a place in degrees; of the polar grids beyond 84° N and 80° S."""
    if latitude > 84.0 or latitude < -80.0:
        return "EPSG:32661" if latitude > 0 else "EPSG:32761"
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32  # south-west Norway
    if latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)  # Svalbard
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def check_place(name: str, latitude: float, longitude: float) -> None:
    """Raises HemislamError if a place in degrees is far outside the area that a coordinate system is made for."""
    crs = projected(name)
    area = crs.area_of_use
    if area is None:
        return
    width = area.east - area.west + (360.0 if area.east < area.west else 0.0)
    beside = (longitude - area.west + 1.0) % 360.0 > width + 2.0
    if beside or not area.south - 1.0 <= latitude <= area.north + 1.0:
        raise HemislamError(
            f"{name} ({crs.name}) is not made for latitude {latitude:.4f}°, longitude {longitude:.4f}°;"
            f" {utm(latitude, longitude)} is."
        )


def place(name: str, east: float, north: float) -> tuple[float, float]:
    """Latitude and longitude (degrees) of a place in a grid. Raises HemislamError: the grid is not made for it."""
    longitude, latitude = transformer(name, WGS84).transform(east, north)
    if not math.isfinite(longitude + latitude):
        raise HemislamError(f"{name} has no place at E {east:.0f}, N {north:.0f}; check the grid.")
    check_place(name, latitude, longitude)
    return latitude, longitude


def stretches(name: str, latitude: float, longitude: float) -> tuple[float, float]:
    """The greatest and the least metres of a grid per metre on the ellipsoid, over all directions at a place."""
    import pyproj

    ways = np.array([90.0, 270.0, 0.0, 180.0])
    geod, here = pyproj.Geod(ellps="WGS84"), (np.full(4, longitude), np.full(4, latitude))
    east, north = transformer(WGS84, name).transform(*geod.fwd(*here, ways, np.full(4, STEP_M))[:2])
    steps = [[axis[0] - axis[1], axis[2] - axis[3]] for axis in (east, north)]
    most, least = np.linalg.svd(steps, compute_uv=False).tolist()
    return most / (2 * STEP_M), least / (2 * STEP_M)


def grid_scale(name: str, latitude: float, longitude: float, height: float) -> float:
    """Metres of the grid per metre on the ground at a place in degrees and m, such as 0.9996 in the middle of UTM."""
    most, least = stretches(name, latitude, longitude)
    return math.sqrt(most * least) * EARTH_M / (EARTH_M + height)


def distortion(name: str, east: float, north: float) -> str:
    """That a grid stretches one direction more than another, and which grid does not; "" if it hardly does."""
    here = place(name, east, north)
    most, least = stretches(name, *here)
    more = most / least - 1.0
    if more < SAME_STRETCH:
        return ""
    return (
        f"{name} stretches lengths by {100 * more:.2f} % more in one direction than in another. The map keeps its"
        f" shape, so it cannot fit this grid everywhere; {utm(*here)} stretches all directions alike."
    )
