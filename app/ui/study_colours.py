"""Colours of a frame under study, and what they mean."""

from enum import StrEnum
from typing import Final

import numpy as np

from app.slam.study import point_numbers
from app.slam.types import F32, F64, U8, StepResult
from app.ui.colours import TABLES, Limits, value_colours
from app.ui.html import box, css


class StudyBy(StrEnum):
    MAP = "as the map"
    RING = "ring"
    ANGLE = "angle to down"
    DISTANCE = "distance to plane"
    RESIDUAL = "residual to the map"


_TABLE: Final = {
    StudyBy.RING: "viridis",
    StudyBy.ANGLE: "plasma",
    StudyBy.DISTANCE: "viridis",
    StudyBy.RESIDUAL: "plasma",
}
_UNIT: Final = {
    StudyBy.RING: "0 = outermost line",
    StudyBy.ANGLE: "°",
    StudyBy.DISTANCE: "cm, above or below",
    StudyBy.RESIDUAL: "mm · points the filter used; grey: none",
}
_LIMITS: Final = {
    StudyBy.ANGLE: Limits(0.0, 120.0),
    StudyBy.DISTANCE: Limits(0.0, 50.0),
    StudyBy.RESIDUAL: Limits(0.0, 60.0),
}
"""Fixed, so that a colour means the same in every frame; what is beyond takes the colour of the end."""
NOTHING: Final = (110, 118, 130)
"""Of points that have no such number."""


def points_shown(result: StepResult, by: StudyBy) -> F32:
    """(n, 3) m, LiDAR frame: the scan, or the points that were looked up in the map."""
    if by is StudyBy.RESIDUAL:
        matches = result.registration.matches
        return matches.points if matches is not None else np.empty((0, 3), np.float32)
    return result.cloud.points


def study_values(result: StepResult, by: StudyBy) -> F64:
    """(n,) the number that each of `points_shown` is coloured by, in the legend's unit; nan where there is none."""
    if by is StudyBy.RING:
        return result.cloud.ring.astype(np.float64)
    if by is StudyBy.RESIDUAL:
        matches = result.registration.matches
        return 1e3 * np.abs(matches.residuals.astype(np.float64)) if matches is not None else np.empty(0)
    numbers = point_numbers(result.cloud.points, result)
    return np.degrees(numbers.angle) if by is StudyBy.ANGLE else 100 * np.abs(numbers.distance)


def study_limits(result: StepResult, by: StudyBy) -> Limits:
    """The numbers at the two ends of the colours."""
    if by is StudyBy.RING:
        return Limits(0.0, float(max(int(result.cloud.ring.max(initial=1)), 1)))
    return _LIMITS[by]


def study_colours(result: StepResult, by: StudyBy) -> U8:
    """(n, 3) of `points_shown`."""
    values = study_values(result, by)
    colours = value_colours(values, study_limits(result, by), TABLES[_TABLE[by]])
    colours[np.isnan(values)] = NOTHING
    return colours


def study_legend(result: StepResult | None, by: StudyBy) -> str:
    """What the colours mean, with units."""
    if by is StudyBy.MAP or result is None:
        return box('<span class="hs-note">The scan is coloured like the map; see the tab View.</span>')
    limits = study_limits(result, by)
    stops = ",".join(css((int(r), int(g), int(b))) for r, g, b in TABLES[_TABLE[by]][::32])
    over = "" if by is StudyBy.RING else "+"
    return box(
        f'<div class="hs-bar" style="background:linear-gradient(90deg,{stops})"></div>',
        f'<div class="hs-row hs-note"><span>{limits.low:g}</span><span>{by} · {_UNIT[by]}</span>'
        f'<span style="white-space:nowrap">{limits.high:g}{over}</span></div>',
    )
