"""Numbers of a studied frame: those that colour it, the ground threshold over range, and those of one point."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from app.slam import lie
from app.slam.study import MATCH_M, Patch, nearest_match, neighbourhood, point_numbers
from app.slam.types import F32, F64, U8, StepResult
from app.ui.colours import LABEL_NAMES, TABLES, Limits, value_colours
from app.ui.html import BAD, GOOD, Tile, number, panel


# --- colours -------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class StudyMode:
    """One way to colour a frame.

    Attributes:
        legend: the unit and what the numbers are. points: (n, 3) m, LiDAR frame, the points shown.
        values: (n,) their numbers in the legend's unit; NaN where there is none. limits: the two ends of the colours,
            fixed where possible, so that a colour means the same in every frame.
        open_end: numbers beyond the upper limit get the colour of that limit.
    """

    legend: str
    table: str
    values: Callable[[StepResult], F64]
    limits: Callable[[StepResult], Limits]
    points: Callable[[StepResult], F32] = lambda result: result.cloud.points
    open_end: bool = True


def _matched(result: StepResult) -> F32:
    matches = result.registration.matches
    return matches.points if matches is not None else np.empty((0, 3), np.float32)


def _residuals(result: StepResult) -> F64:
    matches = result.registration.matches
    return 1e3 * np.abs(matches.residuals.astype(np.float64)) if matches is not None else np.empty(0)


AS_MAP: Final = "as the map"
"""The scan is coloured like the map; nothing is drawn in its place."""
RESIDUAL: Final = "residual to the map"

STUDY_MODES: Final[dict[str, StudyMode]] = {
    "ring": StudyMode(
        "0 = outermost line",
        "viridis",
        lambda result: result.cloud.ring.astype(np.float64),
        lambda result: Limits(0.0, float(max(int(result.cloud.ring.max(initial=1)), 1))),
        open_end=False,
    ),
    "angle to down": StudyMode(
        "°",
        "plasma",
        lambda result: np.degrees(point_numbers(result.cloud.points, result).angle),
        lambda _: Limits(0.0, 120.0),
    ),
    "distance to plane": StudyMode(
        "cm, above or below",
        "viridis",
        lambda result: 100 * np.abs(point_numbers(result.cloud.points, result).distance),
        lambda _: Limits(0.0, 50.0),
    ),
    RESIDUAL: StudyMode(
        "mm · points the filter used; grey: none",
        "plasma",
        _residuals,
        lambda _: Limits(0.0, 60.0),
        points=_matched,
    ),
}
STUDY_BY: Final = (AS_MAP, *STUDY_MODES)


def study_colours(result: StepResult, by: str) -> U8:
    """(n, 3) colours of the points that a mode shows."""
    mode = STUDY_MODES[by]
    return value_colours(mode.values(result), mode.limits(result), TABLES[mode.table])


def study_legend(result: StepResult | None, by: str) -> str:
    if by == AS_MAP or result is None:
        return panel("note", "The scan is coloured like the map; see the tab View.")
    mode = STUDY_MODES[by]
    limits = mode.limits(result)
    high = f"{limits.high:g}{'+' if mode.open_end else ''}"
    return panel("macros.bar", TABLES[mode.table][::32], f"{limits.low:g}", f"{by} · {mode.legend}", high)


# --- the ground threshold ------------------------------------------------------------------------
MOST_POINTS: Final = 1200
HEADROOM: Final = 3.0
"""Points within this many thresholds of the plane are plotted; walls and ceilings would flatten the rest."""
_LEAST_M: Final = 2.0


@dataclass(frozen=True, slots=True)
class Curve:
    """The ground threshold over range, with the points under and over it.

    Attributes:
        range: (n,) m, ascending. threshold: (n,) cm.
        under, over: (n,) cm, |distance to the plane|; for each point, one of them is NaN.
        points_under, points_over: counts of all points, including those not shown.
    """

    range: F64
    under: F64
    over: F64
    threshold: F64
    points_under: int
    points_over: int


def curve(result: StepResult | None, sigma: float) -> Curve:
    """The curve of one frame; without points if it has no plane."""
    numbers = point_numbers(result.cloud.points, result) if result is not None else None
    if numbers is None or not np.isfinite(numbers.distance).all() or not len(numbers.range):
        nothing = np.full(2, np.nan)
        ends = np.array([0.0, 10.0])
        return Curve(ends, nothing, nothing, 100 * sigma * ends, 0, 0)
    distance, threshold = np.abs(numbers.distance), sigma * numbers.range
    under = distance < threshold
    farthest = max(_LEAST_M, 1.15 * float(np.percentile(numbers.range[under], 98)) if under.any() else 10.0)
    shown = np.flatnonzero((numbers.range < farthest) & (distance < HEADROOM * sigma * farthest))
    shown = shown[np.argsort(numbers.range[shown], kind="stable")]
    count = min(len(shown), MOST_POINTS)
    shown = shown[np.arange(count) * len(shown) // max(count, 1)]
    cm = 100 * distance[shown]
    # The first and last entries belong only to the line of the threshold.
    return Curve(
        range=np.concatenate(([0.0], numbers.range[shown], [farthest])),
        under=np.concatenate(([np.nan], np.where(under[shown], cm, np.nan), [np.nan])),
        over=np.concatenate(([np.nan], np.where(under[shown], np.nan, cm), [np.nan])),
        threshold=100 * sigma * np.concatenate(([0.0], numbers.range[shown], [farthest])),
        points_under=int(np.count_nonzero(under)),
        points_over=int(np.count_nonzero(~under)),
    )


# --- one point -----------------------------------------------------------------------------------
_CLOSE: Final = np.radians(0.4)
_REACH: Final = np.radians(1.0)
"""A click selects the nearest point within `_CLOSE` of its ray, else the one closest to the ray within `_REACH`."""


def nearest_to_ray(points: F32, origin: F64, direction: F64) -> int | None:
    """Index of the clicked point of (n, 3) points, or None. The ray is in the points' frame."""
    if len(points) == 0:
        return None
    towards = points.astype(np.float64) - origin
    along = towards @ (direction / np.linalg.norm(direction))
    depth = np.linalg.norm(towards, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(along > 0, np.arccos(np.clip(along / depth, -1.0, 1.0)), np.inf)
    close = np.flatnonzero(off < _CLOSE)
    if len(close):
        return int(close[np.argmin(depth[close])])
    best = int(np.argmin(off))
    return best if off[best] < _REACH else None


def point_at(result: StepResult, ray: tuple[F64, F64]) -> int | None:
    """Index of the clicked point of a frame, or None. ray: origin and direction, (3,) each, in the map."""
    T = lie.inverse(result.T_map_lidar)
    return nearest_to_ray(result.cloud.points, lie.moved(T, ray[0]), T[:3, :3] @ ray[1])


@dataclass(frozen=True, slots=True)
class Picked:
    """A studied point. Lengths in m, angles in rad; `patch` in the LiDAR frame.

    Attributes:
        match: index in the result's matches of the nearest point that the filter used; -1 without one. away: distance
            to it.
    """

    index: int
    range: float
    angle: float
    distance: float
    threshold: float
    patch: Patch
    match: int
    away: float


def pick(result: StepResult, index: int, sigma: float, neighbours: int) -> Picked:
    """Everything about one point of the result's cloud.

    Args:
        sigma: of the ground threshold, m per m of range. neighbours: number of points in the patch.
    """
    point = result.cloud.points[index : index + 1]
    numbers = point_numbers(point, result)
    (match,), (away,) = nearest_match(point, result)
    return Picked(
        index=index,
        range=float(numbers.range[0]),
        angle=float(numbers.angle[0]),
        distance=float(numbers.distance[0]),
        threshold=sigma * float(numbers.range[0]),
        patch=neighbourhood(result.cloud.points, index, neighbours),
        match=int(match),
        away=float(away),
    )


def describe(result: StepResult, picked: Picked) -> str:
    cloud, i, patch = result.cloud, picked.index, picked.patch
    under = abs(picked.distance) < picked.threshold
    tilt = np.degrees(np.arccos(min(abs(float(patch.normal @ result.ground.down)), 1.0)))
    off = 1e3 * float((cloud.points[i] - patch.center) @ patch.normal)
    near = f"{len(patch.indices)} points within {100 * patch.radius:.0f} cm"
    threshold = f"cm · threshold {number(100 * picked.threshold, 1)} cm"
    colour = "" if np.isnan(picked.distance) else GOOD if under else BAD
    tiles = [
        Tile("label", LABEL_NAMES.get(int(cloud.labels[i]), "not ground")),
        Tile("ring", str(int(cloud.ring[i]))),
        Tile("range", number(picked.range), "m"),
        Tile("angle to down", number(np.degrees(picked.angle), 1), "°"),
        Tile("intensity", number(float(cloud.intensity[i]), 0)),
        Tile("time in scan", number(1e-6 * int(cloud.offsets_ns[i]), 1), "ms"),
        Tile("distance to plane", number(100 * picked.distance, 1), threshold, "", colour, "wide"),
        Tile("plane of its neighbours", number(tilt, 1), "° from level", near, width="half"),
        Tile(
            "thickness",
            number(1e3 * float(np.sqrt(patch.variances[2])), 1),
            "mm",
            f"this point {off:+.1f} mm off",
            width="half",
        ),
        _match_tile(result, picked),
    ]
    return panel("macros.tiles", tiles)


def _match_tile(result: StepResult, picked: Picked) -> Tile:
    name, matches, i = "nearest point that the filter used", result.registration.matches, picked.match
    if matches is None or i < 0:
        return Tile(name, "none", f"within {100 * MATCH_M:.0f} cm", width="wide")
    away = f"{100 * picked.away:.1f} cm away"
    if not matches.normals[i].any():
        return Tile(name, "no plane in the map", note=away, width="wide")
    if np.isnan(matches.residuals[i]):
        return Tile(name, "not used", note=f"{away}; its plane is too far off", width="wide")
    return Tile(name, f"{1e3 * matches.residuals[i]:+.1f}", "mm to the map's plane", away, width="wide")
