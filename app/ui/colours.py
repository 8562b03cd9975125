"""Colours of points: by label, or by a number through a perceptually uniform colour map. `MODES` declares the modes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from app.server.protocol import Chunk
from app.slam.types import F32, F64, GROUND, I64, MOVING, NON_GROUND, SEED, U8, U16, Cloud, Mask
from app.ui.html import panel

Rgb = tuple[int, int, int]

LABEL_COLOURS: Final[dict[int, Rgb]] = {
    NON_GROUND: (136, 148, 168),
    GROUND: (52, 199, 170),
    SEED: (255, 205, 80),
    MOVING: (214, 62, 104),
}
"""Blue-grey, teal, amber and crimson: distinct for every kind of colour vision, and by lightness alone."""

LABEL_NAMES: Final[dict[int, str]] = {GROUND: "ground", NON_GROUND: "not ground", SEED: "seed", MOVING: "moving"}

_ANCHORS: Final[dict[str, str]] = {
    # Evenly spaced colours of matplotlib's maps (CC0, van der Walt and Smith), which are uniform in CAM02-UCS.
    # Their dark ends are left out because they would be invisible on the dark page.
    "viridis": "3b518b 2c718e 21908d 27ad81 5cc863 aadc32 fde725",
    "plasma": "7e03a8 a92395 cc4778 e56b5d f89540 fdc527 f0f921",
    "cividis": "3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
    "magma": "812581 b5367a e55964 fb8761 fec287 fcfdbf",
    # From behind to in front, with grey between: visible on a dark and on a light page.
    "sides": "2f62d9 5f8ae0 94aed8 b0b4ba d9a58c d9704f c8321f",
    # Successive keyframes get very different colours.
    "wheel": "e0564f d9913a c9c23c 6cc24a 3fc1a5 4aa3dc 6f74e0 b565d9 e0569a e0564f",
}


def _table(anchors: str) -> U8:
    colours = np.array([[int(text[i : i + 2], 16) for i in (0, 2, 4)] for text in anchors.split()], dtype=np.float64)
    at = np.linspace(0.0, len(colours) - 1.0, 256)
    channels = [np.interp(at, np.arange(len(colours)), colours[:, c]) for c in range(3)]
    return np.round(np.column_stack(channels)).astype(np.uint8)


TABLES: Final[dict[str, U8]] = {name: _table(anchors) for name, anchors in _ANCHORS.items()}
"""(256, 3) uint8 per colour map, from the lowest value to the highest."""

NOTHING: Final[Rgb] = (92, 100, 114)
"""Colour of points without a number."""
DIMMED: Final[dict[bool, Rgb]] = {False: (52, 57, 66), True: (206, 211, 218)}
"""Colour of the map while it is dimmed behind the scan, on a dark and on a light background."""
_LABEL_TABLE: Final[U8] = np.array([LABEL_COLOURS[label] for label in range(len(LABEL_COLOURS))], dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class Limits:
    """The values at the two ends of a colour map; low < high."""

    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class PointSet:
    """The values from which a colour mode may take the colours of points.

    Attributes:
        points: (n, 3) m, LiDAR frame. labels, intensity, ring: (n,). T_map_lidar: (4, 4).
        seconds: time of the scan since the recording's start. light: (n,) brightness up to 1, or None.
        keyframe: its index, or -1. numbers: (n,) values of the points from `app.ui.map_numbers`, or None.
    """

    points: F32
    labels: U8
    intensity: F32
    ring: U16
    T_map_lidar: F64
    seconds: float
    light: F32 | None = None
    keyframe: int = -1
    numbers: F32 | None = None

    @classmethod
    def of(cls, cloud: Cloud | Chunk, shown: I64 | Mask, T_map_lidar: F64, seconds: float, *more: Any) -> "PointSet":
        """Some points of a cloud. more: the other attributes."""
        points, labels, intensity, ring = cloud.points, cloud.labels, cloud.intensity, cloud.ring
        return cls(points[shown], labels[shown], intensity[shown], ring[shown], T_map_lidar, seconds, *more)


@dataclass(frozen=True, slots=True)
class ColourMode:
    """One way to colour points.

    Attributes:
        legend: the unit, or what the numbers mean. table: a name in `TABLES`.
        values: (n,) the number of each point. step: limits read from the data grow in such steps, so that the map is
            rarely recoloured. share: percent of the values beyond the limits at each end.
        fixed: limits known beforehand, from the recording's duration in s; None: read from the data.
        of_map: a point's number depends on the whole map (`app.ui.map_numbers`).
    """

    name: str
    legend: str
    table: str
    values: Callable[[PointSet], npt.NDArray[np.floating]]
    step: float = 1.0
    share: float = 0.0
    fixed: Callable[[float], Limits] | None = None
    of_map: bool = False


def _height(cloud: PointSet) -> F64:
    return np.asarray(cloud.points @ cloud.T_map_lidar[2, :3] + cloud.T_map_lidar[2, 3], dtype=np.float64)


def _numbers(cloud: PointSet) -> F32:
    return cloud.numbers if cloud.numbers is not None else np.full(len(cloud.points), np.nan, np.float32)


def _own_colour(cloud: PointSet) -> F64:
    """Steps by the golden ratio, which fractions approximate worst: neighbours get very different colours."""
    return np.full(len(cloud.points), cloud.keyframe * 0.618034 % 1.0 if cloud.keyframe >= 0 else np.nan)


LABEL: Final = "label"
"""The mode without numbers: each label has its colour."""
HEIGHT: Final = "height"
INTENSITY: Final = "intensity"
DENSITY: Final = "density"
DISTANCE: Final = "distance"
KEYFRAME: Final = "keyframe"
LOOK: Final = "height × intensity"
"""The default mode: colour by height, brightness by intensity, and the labels as a tint."""
BY_POSE: Final = (HEIGHT, LOOK)
"""The modes whose colours depend on the keyframe's pose."""
_TINTS: Final = np.array([0.0, 0.35, 0.35, 0.8])
"""By label: the share of the label's colour in a point's colour."""
_DIMMEST: Final = 0.75
"""Brightness at the lowest intensity."""

MODES: Final[dict[str, ColourMode]] = {
    mode.name: mode
    for mode in (
        ColourMode(LOOK, "m", "cividis", _height, share=1.0),
        ColourMode(HEIGHT, "m", "viridis", _height, share=1.0),
        ColourMode(INTENSITY, "sensor's scale", "magma", lambda cloud: cloud.intensity, step=16.0, share=1.0),
        ColourMode("ring", "0 = outermost line", "viridis", lambda cloud: cloud.ring.astype(np.float32)),
        ColourMode(
            "time",
            "s",
            "plasma",
            lambda cloud: np.full(len(cloud.points), cloud.seconds),
            fixed=lambda duration: Limits(0.0, max(duration, 1.0)),
        ),
        ColourMode(KEYFRAME, "each its own colour", "wheel", _own_colour, fixed=lambda _: Limits(0.0, 1.0)),
        ColourMode(DENSITY, "points within 25 cm", "viridis", _numbers, of_map=True),
        ColourMode(DISTANCE, "m in front", "sides", _numbers, of_map=True),
    )
}
"""Every mode except `LABEL`, in the order shown."""

COLOUR_BY: Final = (LOOK, LABEL, *(name for name in MODES if name != LOOK))


def colours(cloud: PointSet, by: str, limits: Mapping[str, Limits]) -> U8:
    """(n, 3) colours of points. limits: ends of the colour maps by mode; labels need none."""
    found = label_colours(cloud.labels)
    if by != LABEL and by in limits:
        values = value_colours(MODES[by].values(cloud), limits[by], TABLES[MODES[by].table])
        found = _tinted(values, found, cloud, limits[INTENSITY]) if by == LOOK else values
    elif by != LABEL and MODES[by].of_map:
        found[:] = NOTHING
    if cloud.light is None or by not in (LOOK, LABEL):
        return found
    return np.asarray(found * cloud.light[:, None], dtype=np.uint8)


def _tinted(values: U8, labels: U8, cloud: PointSet, limits: Limits) -> U8:
    """(n, 3) colours by height, with brightness by intensity and a tint by label."""
    share = np.clip((cloud.intensity - limits.low) / (limits.high - limits.low), 0.0, 1.0)
    found = values * (_DIMMEST + (1 - _DIMMEST) * np.nan_to_num(share))[:, None]
    tint = _TINTS[_known(cloud.labels)][:, None]
    return np.asarray(found + tint * (labels - found), dtype=np.uint8)


def label_colours(labels: U8) -> U8:
    """(n,) labels -> (n, 3) colours. Labels unknown to this version are drawn as not ground."""
    return _LABEL_TABLE[_known(labels)]


def _known(labels: U8) -> U8:
    return np.where(labels < len(_LABEL_TABLE), labels, np.uint8(NON_GROUND))


def value_colours(values: npt.ArrayLike, limits: Limits, table: U8) -> U8:
    """(n,) numbers -> (n, 3) colours; values beyond the limits take the colour of the nearer end, nan is grey."""
    scaled = (np.asarray(values, dtype=np.float32) - limits.low) * (255.0 / (limits.high - limits.low))
    known = np.isfinite(scaled)
    found: U8 = table[np.where(known, np.clip(scaled, 0.0, 255.0), 0.0).astype(np.uint8)]
    found[~known] = NOTHING
    return found


def grown(limits: Limits | None, mode: ColourMode, values: npt.ArrayLike) -> Limits | None:
    """`limits` widened to hold nearly all of `values`, rounded outwards.

    Limits never shrink, so that a colour keeps its meaning for the user.
    """
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return limits
    low, high = np.percentile(finite, (mode.share, 100.0 - mode.share))
    low, high = float(np.floor(low / mode.step) * mode.step), float(np.ceil(high / mode.step) * mode.step)
    if limits is not None:
        low, high = min(low, limits.low), max(high, limits.high)
    return Limits(low, max(high, low + mode.step))


def chosen_ends(limits: Mapping[str, Limits], by: str, ends: Limits | None) -> Mapping[str, Limits]:
    """The ends of the colour maps, with those that the user chose for the mode `by`."""
    return limits if ends is None else {**limits, by: ends}


@dataclass(frozen=True, slots=True, eq=False)
class Key:
    """What colours mean.

    Attributes:
        stops: (k, 3) colours of `what`, from the value `low` to `high`; empty if colours do not stand for numbers.
        names: single colours and their names.
    """

    stops: U8 = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    low: str = ""
    what: str = ""
    high: str = ""
    names: tuple[tuple[Rgb, str], ...] = ()


def key(by: str, limits: Limits | None, ends: Limits | None = None) -> Key:
    """What the colours mean. limits: of all values; None before there are any. ends: chosen by the user."""
    names = tuple((LABEL_COLOURS[label], name) for label, name in LABEL_NAMES.items()) if by in (LABEL, LOOK) else ()
    if by == LABEL:
        return Key(names=names)
    mode, shown = MODES[by], ends or limits
    low, high = (f"{shown.low:.3g}", f"{shown.high:.3g}") if shown is not None and by != KEYFRAME else ("", "")
    return Key(TABLES[mode.table], low, "height · m" if by == LOOK else f"{mode.name} · {mode.legend}", high, names)


def legend(by: str, limits: Limits | None, ends: Limits | None = None) -> str:
    """The key as HTML; arguments as for `key`. The ends of its bar can be dragged."""
    found = key(by, limits, ends)
    names, stops = panel("keys", found.names) if found.names else "", found.stops[::32]
    if not len(stops):
        return names
    if limits is None or by == KEYFRAME:
        why = panel("note", "Choose the map to compare with under View, Distance to another map.")
        return panel("macros.bar", stops, "", found.what, "") + names + why * (by == DISTANCE)
    shown = ends or limits
    shares = [round(100 * (end - limits.low) / (limits.high - limits.low)) for end in (shown.low, shown.high)]
    low, high = (min(max(share, 0), 100) for share in shares)
    return panel("colour_ends", stops, found.low, found.what, found.high, low, high) + names
