"""One point of a frame: found by a click, described in numbers."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from app.slam.study import MATCH_M, Patch, nearest_match, neighbourhood, point_numbers
from app.slam.types import F32, F64, GROUND, SEED, StepResult
from app.ui.html import BAD, GOOD, number, tile, tiles

_CLOSE: Final = np.radians(0.4)
_REACH: Final = np.radians(1.0)
"""Of the points so close to the ray the nearest is meant; else the one closest to the ray, within reach of it."""
_LABELS: Final = {GROUND: "ground", SEED: "seed"}


def nearest_to_ray(points: F32, origin: F64, direction: F64) -> int | None:
    """Index of the point of (n, 3) that a click means; the ray is in the points' frame. None: there is none near it."""
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


@dataclass(frozen=True, slots=True)
class Match:
    """The point that the filter used nearest to the one clicked, with the plane that the map gave for it.

    Attributes:
        away: m from the point clicked. residual: signed m; nan where the plane was not accepted.
        center, normal: (3,) m, odom frame; None where there was no plane.
    """

    away: float
    residual: float
    center: F64 | None
    normal: F64 | None


@dataclass(frozen=True, slots=True)
class Picked:
    """A point under study. Lengths m, angles rad; `patch` in the LiDAR frame."""

    index: int
    range: float
    angle: float
    distance: float
    threshold: float
    patch: Patch
    match: Match | None


def pick(result: StepResult, index: int, sigma: float, neighbours: int) -> Picked:
    """Everything about one point of the result's cloud.

    Args:
        sigma: of the ground threshold, m per m of range. neighbours: how many points its patch has.
    """
    point = result.cloud.points[index]
    numbers = point_numbers(point[None], result)
    return Picked(
        index=index,
        range=float(numbers.range[0]),
        angle=float(numbers.angle[0]),
        distance=float(numbers.distance[0]),
        threshold=sigma * float(numbers.range[0]),
        patch=neighbourhood(result.cloud.points, index, neighbours),
        match=_match(result, point),
    )


def _match(result: StepResult, point: F32) -> Match | None:
    matches = result.registration.matches
    (nearest,), (away,) = nearest_match(point[None], result)
    if matches is None or nearest < 0:
        return None
    found = bool(np.any(matches.normals[nearest]))
    return Match(
        away=float(away),
        residual=float(matches.residuals[nearest]),
        center=matches.centers[nearest].astype(np.float64) if found else None,
        normal=matches.normals[nearest].astype(np.float64) if found else None,
    )


def describe(result: StepResult, picked: Picked) -> str:
    """Tiles of one point."""
    cloud, i, patch = result.cloud, picked.index, picked.patch
    under = abs(picked.distance) < picked.threshold
    thickness = 1e3 * float(np.sqrt(patch.variances[2]))
    tilt = np.degrees(np.arccos(min(abs(float(patch.normal @ result.ground.down)), 1.0)))
    off = 1e3 * float((cloud.points[i] - patch.center) @ patch.normal)
    return tiles(
        (
            tile("label", _LABELS.get(int(cloud.labels[i]), "not ground")),
            tile("ring", str(int(cloud.ring[i]))),
            tile("range", number(picked.range), "m"),
            tile("angle to down", number(np.degrees(picked.angle), 1), "°"),
            tile("intensity", number(float(cloud.intensity[i]), 0)),
            tile("time in scan", number(1e-6 * int(cloud.offsets_ns[i]), 1), "ms"),
            tile(
                "distance to plane",
                number(100 * picked.distance, 1),
                f"cm · threshold {number(100 * picked.threshold, 1)} cm",
                colour="" if np.isnan(picked.distance) else GOOD if under else BAD,
                width="wide",
            ),
            tile("plane of its neighbours", number(tilt, 1), "° from level", width="half",
                 note=f"{len(patch.indices)} points within {100 * patch.radius:.0f} cm"),
            tile("thickness", number(thickness, 1), "mm", width="half", note=f"this point {off:+.1f} mm off"),
            _match_tile(picked.match),
        )
    )  # fmt: skip


def _match_tile(match: Match | None) -> str:
    name = "nearest point that the filter used"
    if match is None:
        return tile(name, "none", f"within {100 * MATCH_M:.0f} cm", width="wide")
    away = f"{100 * match.away:.1f} cm away"
    if match.normal is None:
        return tile(name, "no plane in the map", note=away, width="wide")
    if np.isnan(match.residual):
        return tile(name, "not used", note=f"{away}; its plane is too far off", width="wide")
    return tile(name, f"{1e3 * match.residual:+.1f}", "mm to the map's plane", note=away, width="wide")
