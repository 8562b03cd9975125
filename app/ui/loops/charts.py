"""Small drawings for one loop: the two Scan Contexts from above, the distance over shifts, the residuals."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from app.slam.loops.scan_context import YAWS
from app.slam.types import F32, F64, U8
from app.ui.colours import TABLES
from app.ui.html import QUIET, WARN

UNSEEN: Final = (104, 108, 116)
"""Grey: never seen, so it counts for neither side."""
_DISC: Final = 300
_GAP: Final = 20
_WIDTH, _HEIGHT, _LEFT, _BASE, _TOP = 300.0, 92.0, 26.0, 76.0, 4.0


def disc(context: F32, turn: float = 0.0, size: int = _DISC) -> U8:
    """(size, size, 4) a context as seen from above, x to the right and y up; clear outside its radius.

    Args:
        context: (rings, sectors), nan where never seen. turn: rad, by which it is turned anticlockwise.
    """
    rings, sectors = context.shape
    at = (np.arange(size) + 0.5) / (size / 2) - 1.0
    x, y = np.meshgrid(at, -at)
    radius = np.hypot(x, y)
    ring = np.minimum((radius * rings).astype(np.int64), rings - 1)
    sector = np.floor((np.arctan2(y, x) - turn) * (sectors / (2 * np.pi))).astype(np.int64) % sectors
    values = context[ring, sector]
    seen = np.isfinite(values)
    high = max(float(np.nanmax(context)), 1e-6) if np.isfinite(context).any() else 1.0
    colours = TABLES["viridis"][np.clip(np.where(seen, values, 0.0) / high * 255, 0, 255).astype(np.uint8)]
    image = np.empty((size, size, 4), np.uint8)
    image[..., :3] = np.where(seen[..., None], colours, np.array(UNSEEN, np.uint8))
    image[..., 3] = np.where(radius <= 1.0, 255, 0)
    return image


def contexts_image(older: F32, newer: F32, turn: float) -> U8:
    """Both contexts side by side, the newer one turned by `turn` (rad) to match the older one."""
    gap = np.zeros((_DISC, _GAP, 4), np.uint8)
    return np.concatenate((disc(older), gap, disc(newer, turn)), axis=1)


def best_yaw(shift_distances: F64) -> float:
    """rad: the heading of the newer keyframe in the older one's frame at which their contexts are most alike."""
    return float(YAWS[int(np.argmin(shift_distances))])


@dataclass(frozen=True, slots=True)
class Plot:
    """What the template `plot` draws, in pixels: bars (x, y, width, height), lines (x1, y1, x2, y2, colour, dashes)."""

    ticks: list[tuple[str, str, str, str]]
    bars: list[tuple[str, str, str, str]] = field(default_factory=list)
    lines: list[tuple[str, str, str, str, str, str]] = field(default_factory=list)
    points: str = ""
    width: float = 300.0
    height: float = 92.0
    colour: str = "#40b8f0"
    quiet: str = QUIET


class _Frame:
    """Maps numbers to pixels of a plot."""

    def __init__(self, left: float, right: float, low: float, high: float) -> None:
        self._left, self._right, self._low, self._high = left, right, low, high

    def x(self, value: float) -> str:
        return f"{_LEFT + (value - self._left) / (self._right - self._left) * (_WIDTH - 6 - _LEFT):.1f}"

    def y(self, value: float) -> str:
        return f"{_BASE - (value - self._low) / (self._high - self._low) * (_BASE - _TOP):.1f}"

    def upright(self, value: float, colour: str, dashes: str = "") -> tuple[str, str, str, str, str, str]:
        return self.x(value), str(_TOP), self.x(value), str(_BASE), colour, dashes

    def level(self, value: float, colour: str, dashes: str = "") -> tuple[str, str, str, str, str, str]:
        return self.x(self._left), self.y(value), self.x(self._right), self.y(value), colour, dashes

    def ticks(self, x: list[tuple[float, str]], y: list[tuple[float, str]]) -> list[tuple[str, str, str, str]]:
        across = [(self.x(at), str(_HEIGHT - 4), "middle", text) for at, text in x]
        return across + [(str(_LEFT - 4), f"{float(self.y(at)) + 3:.1f}", "end", text) for at, text in y]


def shift_plot(shift_distances: F64, limit: float) -> Plot:
    """(sectors,) distance of the contexts over the heading by which the newer one is turned."""
    order = np.argsort(YAWS)
    yaws, values = np.degrees(YAWS[order]), np.asarray(shift_distances, dtype=np.float64)[order]
    frame = _Frame(-180.0, 180.0, 0.0, 1.0)
    across = [(-180.0, "−180°"), (-90.0, "−90°"), (0.0, "0°"), (90.0, "90°"), (180.0, "180°")]
    return Plot(
        ticks=frame.ticks(across, [(0.0, "0"), (0.5, "0.5"), (1.0, "1")]),
        lines=[
            frame.level(0.0, QUIET),
            frame.level(limit, WARN, "3 3"),
            frame.upright(float(np.degrees(best_yaw(shift_distances))), QUIET),
        ],
        points=" ".join(f"{frame.x(yaw)},{frame.y(value)}" for yaw, value in zip(yaws, values, strict=True)),
    )


def histogram(residuals: F64, limit: float, bins: int = 30) -> Plot | None:
    """(k,) m, how many points are how far from the other submap's surface; `limit` m is marked."""
    values = 1000 * np.abs(residuals[np.isfinite(residuals)])
    if not len(values):
        return None
    high = max(float(np.percentile(values, 99)), 1.1 * 1000 * limit)
    counts, edges = np.histogram(values, bins=bins, range=(0.0, high))
    most = max(int(counts.max()), 1)
    frame = _Frame(0.0, high, 0.0, float(most))
    bars = [
        (frame.x(left), frame.y(count), f"{width - 0.6:.1f}", f"{_BASE - float(frame.y(count)):.1f}")
        for count, left, right in zip(counts, edges, edges[1:], strict=False)
        for width in (float(frame.x(right)) - float(frame.x(left)),)
    ]
    step = 10 ** np.floor(np.log10(high))
    step = step / 2 if high / step < 3 else step
    across = [(float(tick), f"{tick:g}") for tick in np.arange(0.0, high, step)]
    return Plot(
        ticks=frame.ticks(across, [(0.0, "0"), (float(most), f"{counts.max()}")]),
        bars=bars,
        lines=[frame.level(0.0, QUIET), frame.upright(1000 * limit, WARN, "3 3")],
    )
