"""Saved pictures: a legend and a scale drawn onto the browser's rendering, and the camera stations of a flight."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d  # type: ignore[attr-defined]

from app.slam.metrics import walked_m
from app.slam.types import F64, U8
from app.ui.camera import FOV
from app.ui.colours import Key
from app.ui.geometry import wxyz
from app.ui.scale import bar, length_text

BACKGROUND: Final = {False: (20, 20, 20), True: (255, 255, 255)}
_INK: Final = {False: (236, 240, 244), True: (24, 32, 42)}
"""Colours on a dark and on a light background."""
_SMOOTH_M: Final = 1.5
_STEP_M: Final = 0.1
_AHEAD_M: Final = 4.0
"""The camera of a flight looks this far ahead along the path."""


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """A camera: position (3,), orientation in viser's convention, and vertical field of view (rad)."""

    position: F64
    wxyz: F64
    fov: float = FOV


def composed(rendered: U8, key: Key, *, light: bool, seen_m: float = 0.0) -> Image.Image:
    """A picture with its legend and scale.

    Args:
        rendered: (h, w, 4), transparent where nothing is drawn. key: of its colours.
        light: a light background. seen_m: height of the scene that the picture shows at its middle, m; 0: no scale.
    """
    picture = Image.new("RGB", (rendered.shape[1], rendered.shape[0]), BACKGROUND[light])
    seen = Image.fromarray(rendered)
    picture.paste(seen, mask=seen.getchannel("A"))
    unit = max(picture.height / 900, 0.5)
    draw, font, ink = ImageDraw.Draw(picture), ImageFont.load_default(18 * unit), _INK[light]
    margin, low = 24 * unit, picture.height - 24 * unit
    y = low
    for rgb, name in reversed(key.names):
        draw.ellipse((margin, y - 14 * unit, margin + 14 * unit, y), rgb)
        draw.text((margin + 22 * unit, y), name, ink, font, anchor="ls")
        y -= 26 * unit
    if len(key.stops):
        width, height = int(260 * unit), int(12 * unit)
        row = np.repeat(key.stops[np.linspace(0, len(key.stops) - 1, width).astype(int)][None], height, axis=0)
        picture.paste(Image.fromarray(row), (int(margin), int(y - height - 24 * unit)))
        for text, at, anchor in ((key.low, 0, "ls"), (key.high, width, "rs")):
            draw.text((margin + at, y), text, ink, font, anchor=anchor)
        draw.text((margin, y - height - 34 * unit), key.what, ink, font, anchor="ls")
    if seen_m > 0:
        length = bar(seen_m)
        right, wide = picture.width - margin, length / seen_m * picture.height
        draw.line((right - wide, low, right, low), ink, max(round(3 * unit), 1))
        draw.text((right - wide / 2, low - 8 * unit), length_text(length), ink, font, anchor="ms")
    return picture


def flight(path: F64, count: int, behind: float, above: float) -> list[Station]:
    """`count` stations, evenly spaced along a path of (n, 3) m and looking ahead.

    Args:
        behind, above: m, how far the camera stays behind the walker and above the path.
    """
    walked = walked_m(path)
    even = np.arange(0.0, max(walked[-1], _STEP_M), _STEP_M)
    smooth = np.column_stack([np.interp(even, walked, path[:, axis]) for axis in range(3)])
    smooth = gaussian_filter1d(smooth, _SMOOTH_M / _STEP_M, axis=0, mode="nearest")
    flown = walked_m(smooth)
    first, last = (smooth[place] for place in (min(len(smooth) - 1, 20), -min(len(smooth), 21)))
    begin, end = first - smooth[0], smooth[-1] - last

    def at(where: F64) -> F64:
        """(k, 3) places at these distances, m, along the path, which continues straight beyond its ends."""
        inside = np.column_stack([np.interp(where, flown, smooth[:, axis]) for axis in range(3)])
        before, after = np.minimum(where, 0.0)[:, None], np.maximum(where - flown[-1], 0.0)[:, None]
        return np.asarray(inside + before * _unit(begin) + after * _unit(end))

    along = np.linspace(0.0, flown[-1], count)
    eyes, aims = at(along - behind) + np.array([0.0, 0.0, above]), at(along + _AHEAD_M)
    return [Station(eye, wxyz(looking(aim - eye))) for eye, aim in zip(eyes, aims, strict=True)]


def _unit(vector: F64) -> F64:
    """Horizontal direction of a vector; the x axis if it has none."""
    level = np.array([vector[0], vector[1], 0.0])
    length = float(np.linalg.norm(level))
    return level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def looking(ahead: F64) -> F64:
    """(3, 3) rotation from a camera's axes (x right, y down, z ahead) to the map's, upright."""
    z = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.column_stack((x, np.cross(z, x), z))
