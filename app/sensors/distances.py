"""Whether a recording's distances are plausible: in metres, and without values that stand for missing returns."""

import math

import numpy as np

from app.sensors.findings import Finding
from app.slam.sections import SensorParams
from app.slam.types import F64, U16, Scan

NEAREST_M, USUAL_M = 10.0, 100.0
"""m: on a walk, some points are nearer than the first, and most are nearer than the second."""
SAME_M, SAME_SHARE, SAME_LINES = 0.001, 0.05, 3
"""Real points are never equally far in such numbers on this many lines; on one line they may be, on a level floor."""


def distance_findings(scans: list[Scan], params: SensorParams) -> list[Finding]:
    """Coordinates in other units, all out of range, or missing returns written as a distance, in the first scans."""
    distances = np.linalg.norm(np.concatenate([scan.points for scan in scans]).astype(np.float64), axis=1)
    return (
        _not_metres(distances)
        or _out_of_range(distances, params)
        or _missing(distances, np.concatenate([scan.ring for scan in scans]), params)
    )


def _not_metres(distances: F64) -> list[Finding]:
    nearest, usual = np.percentile(distances, [1, 50])
    if nearest < NEAREST_M or usual < USUAL_M:
        return []
    unit, parts = ("mm", 1000) if math.sqrt(nearest * usual) > 700 else ("cm", 100)  # 0.7 to 7 m on a walk
    text = (
        f"half of the points are beyond {usual:.0f} m and hardly any within {nearest:.0f} m: x, y and z seem to be in "
        f"{unit}; make the driver write metres, or divide them by {parts}"
    )
    return [Finding("distances", "needs you", text)]


def _out_of_range(distances: F64, params: SensorParams) -> list[Finding]:
    if ((distances > params.min_range) & (distances < params.max_range)).any():
        return []
    text = (
        f"none of the {len(distances):,} points of the first scans lies within {params.min_range:g} to "
        f"{params.max_range:g} m (sensor.min_range, sensor.max_range): the nearest {distances.min():.3g} m, the "
        f"farthest {distances.max():.3g} m away; check both limits and the LiDAR's driver"
    )
    return [Finding("distances", "needs you", text)]


def _missing(distances: F64, ring: U16, params: SensorParams) -> list[Finding]:
    if np.mean(distances > params.max_range - SAME_M) < SAME_SHARE:  # nothing is missing; sorting takes long
        return []
    steps, counts = np.unique(np.rint(distances / SAME_M), return_counts=True)
    distance = float(steps[counts.argmax()]) * SAME_M
    same = np.abs(distances - distance) < SAME_M
    beyond = np.count_nonzero(distances[~same] > distance)
    if (
        distance > params.max_range
        or same.mean() < SAME_SHARE
        or len(np.unique(ring[same])) < SAME_LINES
        or beyond > 0.5 * np.count_nonzero(~same)
    ):
        return []
    text = (
        f"{same.mean():.0%} of the points are exactly {distance:g} m away: the driver writes this for missing returns; "
        "set the maximum range below that"
    )
    return [Finding("distances", "needs you", text, f"--set sensor.max_range={0.99 * distance:.3g}")]
