"""Colours of points: by label, or by a number through a perceptually uniform map.

Pure functions on arrays; the scene decides what to colour, the legend explains it.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from app.slam.types import GROUND, NON_GROUND, SEED, U8

Rgb = tuple[int, int, int]

LABEL_COLOURS: Final[dict[int, Rgb]] = {
    NON_GROUND: (136, 148, 168),
    GROUND: (52, 199, 170),
    SEED: (255, 205, 80),
}
"""Blue-grey, teal and amber: told apart by every kind of colour vision, and by lightness too."""

LABEL_NAMES: Final[dict[int, str]] = {GROUND: "ground", NON_GROUND: "not ground", SEED: "seed"}


class ColourBy(StrEnum):
    LABEL = "label"
    HEIGHT = "height"
    INTENSITY = "intensity"
    RING = "ring"
    TIME = "time"


_ANCHORS: Final[dict[str, str]] = {
    # Evenly spaced colours of matplotlib's maps (CC0, van der Walt and Smith), which are uniform in CAM02-UCS.
    # Their dark ends are left out: they would vanish on the page's dark ground.
    "viridis": "3b518b 2c718e 21908d 27ad81 5cc863 aadc32 fde725",
    "plasma": "7e03a8 a92395 cc4778 e56b5d f89540 fdc527 f0f921",
    "magma": "812581 b5367a e55964 fb8761 fec287 fcfdbf",
}

MAP_OF: Final[dict[ColourBy, str]] = {
    ColourBy.HEIGHT: "viridis",
    ColourBy.INTENSITY: "magma",
    ColourBy.RING: "viridis",
    ColourBy.TIME: "plasma",
}

UNIT_OF: Final[dict[ColourBy, str]] = {
    ColourBy.LABEL: "",
    ColourBy.HEIGHT: "m",
    ColourBy.INTENSITY: "sensor's scale",
    ColourBy.RING: "0 = outermost line",
    ColourBy.TIME: "s",
}

_ROUNDING: Final[dict[ColourBy, float]] = {ColourBy.HEIGHT: 1.0, ColourBy.INTENSITY: 16.0}
"""Limits that are read from the data grow in steps, so that the map is rarely coloured anew."""


def _table(anchors: str) -> U8:
    colours = np.array([[int(text[i : i + 2], 16) for i in (0, 2, 4)] for text in anchors.split()], dtype=np.float64)
    at = np.linspace(0.0, len(colours) - 1.0, 256)
    channels = [np.interp(at, np.arange(len(colours)), colours[:, c]) for c in range(3)]
    return np.round(np.column_stack(channels)).astype(np.uint8)


TABLES: Final[dict[str, U8]] = {name: _table(anchors) for name, anchors in _ANCHORS.items()}
"""(256, 3) uint8 per map, from the lowest value to the highest."""

_LABEL_TABLE: Final[U8] = np.array([LABEL_COLOURS[label] for label in range(3)], dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class Limits:
    """The values at the two ends of a colour map; low < high."""

    low: float
    high: float


def label_colours(labels: U8) -> U8:
    """(n,) labels -> (n, 3) colours. Labels unknown to this version are drawn as not ground."""
    known = np.where(labels < len(_LABEL_TABLE), labels, NON_GROUND)
    return _LABEL_TABLE[known]


def value_colours(values: npt.ArrayLike, limits: Limits, table: U8) -> U8:
    """(n,) numbers -> (n, 3) colours; values beyond the limits take the colour of the nearer end."""
    scaled = (np.asarray(values, dtype=np.float32) - limits.low) * (255.0 / (limits.high - limits.low))
    colours: U8 = table[np.nan_to_num(np.clip(scaled, 0.0, 255.0), nan=0.0).astype(np.uint8)]
    return colours


def grown(limits: Limits | None, by: ColourBy, values: npt.ArrayLike) -> Limits | None:
    """`limits` widened to hold nearly all of `values` (percentiles 1 to 99), rounded outwards.

    Limits never shrink: colours that a user has learnt to read stay, and what is drawn is seldom
    coloured anew.
    """
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return limits
    step = _ROUNDING.get(by, 1.0)
    low, high = np.percentile(finite, (1.0, 99.0)) if by in _ROUNDING else (finite.min(), finite.max())
    low, high = float(np.floor(low / step) * step), float(np.ceil(high / step) * step)
    if limits is not None:
        low, high = min(low, limits.low), max(high, limits.high)
    return Limits(low, max(high, low + step))
