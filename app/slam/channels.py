"""Correct the known errors of each scan line of a LiDAR, before anything else uses a scan."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from app.slam.kernels import clouds
from app.slam.sections import SensorParams
from app.slam.types import F64, Scan


def corrected(scan: Scan, params: SensorParams) -> Scan:
    """The scan with `sensor.elevation_corrections` and `sensor.range_corrections`; the same one if there are none."""
    elevations, ranges = numbers(params.elevation_corrections), numbers(params.range_corrections)
    return bent(scan, np.radians(elevations), ranges) if len(elevations) or len(ranges) else scan


def bent(scan: Scan, elevations: F64, ranges: F64) -> Scan:
    """The scan with the beams of line i raised by `elevations[i]` rad and lengthened by `ranges[i]` m; both (k,)."""
    points = np.empty_like(scan.points)
    clouds.correct(scan.points, scan.ring, elevations, ranges, points)
    return replace(scan, points=points)


@lru_cache(maxsize=8)
def numbers(text: str) -> F64:
    """(k,), the numbers in a text."""
    return np.array(text.split(), np.float64)


def text(values: F64, digits: int) -> str:
    """The inverse of `numbers`, rounded; "" if all values round to zero."""
    rounded = np.round(values, digits) + 0.0
    return " ".join(f"{value:g}" for value in rounded) if rounded.any() else ""
