"""Small drawings for one loop: the two Scan Contexts from above, the distance over shifts, the residuals."""

from html import escape
from typing import Final

import numpy as np

from app.slam.loops.scan_context import YAWS
from app.slam.types import F32, F64, U8
from app.ui.colours import TABLES
from app.ui.html import QUIET, WARN

UNSEEN: Final = (104, 108, 116)
"""Grey: never looked at, so that it counts for neither side."""
_DISC: Final = 300
_GAP: Final = 20
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 300.0, 92.0, 26.0, 16.0, 4.0
_LINE: Final = "#40b8f0"


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
    """Both contexts side by side, the newer turned by `turn` (rad) to lie as the older does."""
    gap = np.zeros((_DISC, _GAP, 4), np.uint8)
    return np.concatenate((disc(older), gap, disc(newer, turn)), axis=1)


def best_yaw(shift_distances: F64) -> float:
    """rad: the heading of the newer in the older's frame at which their contexts are most alike."""
    return float(YAWS[int(np.argmin(shift_distances))])


def shift_plot(shift_distances: F64, limit: float) -> str:
    """(sectors,) distance of the contexts over the heading by which the newer is turned, as SVG."""
    order = np.argsort(YAWS)
    yaws, values = np.degrees(YAWS[order]), np.asarray(shift_distances, dtype=np.float64)[order]
    best = float(np.degrees(best_yaw(shift_distances)))
    frame = _Frame(-180.0, 180.0, 0.0, 1.0)
    points = " ".join(f"{frame.x(yaw):.1f},{frame.y(value):.1f}" for yaw, value in zip(yaws, values, strict=True))
    return frame.svg(
        f'<line x1="{_LEFT}" x2="{_WIDTH}" y1="{frame.y(limit):.1f}" y2="{frame.y(limit):.1f}" stroke="{WARN}"'
        ' stroke-dasharray="3 3"/>',
        f'<line x1="{frame.x(best):.1f}" x2="{frame.x(best):.1f}" y1="{_TOP}" y2="{frame.y(0.0):.1f}"'
        f' stroke="{QUIET}"/>',
        f'<polyline points="{points}" fill="none" stroke="{_LINE}" stroke-width="1.5"/>',
        x=[(-180, "−180°"), (-90, "−90°"), (0, "0°"), (90, "90°"), (180, "180°")],
        y=[(0, "0"), (0.5, "0.5"), (1, "1")],
    )


def histogram(residuals: F64, limit: float, bins: int = 30) -> str:
    """(k,) m, how many points lie how far from the other submap's surface, as SVG; `limit` m is marked."""
    values = 1000 * np.abs(residuals[np.isfinite(residuals)])
    if not len(values):
        return ""
    high = max(float(np.percentile(values, 99)), 1.1 * 1000 * limit)
    counts, edges = np.histogram(values, bins=bins, range=(0.0, high))
    frame = _Frame(0.0, high, 0.0, float(max(counts.max(), 1)))
    bars = "".join(
        f'<rect x="{frame.x(left):.1f}" y="{frame.y(count):.1f}" width="{frame.x(right) - frame.x(left) - 0.6:.1f}"'
        f' height="{frame.y(0) - frame.y(count):.1f}" fill="{_LINE}"/>'
        for count, left, right in zip(counts, edges, edges[1:], strict=False)
    )
    line = frame.x(1000 * limit)
    mark = f'<line x1="{line:.1f}" x2="{line:.1f}" y1="{_TOP}" y2="{frame.y(0):.1f}" stroke="{WARN}" '
    step = 10 ** np.floor(np.log10(high))
    step = step / 2 if high / step < 3 else step
    ticks = [(tick, f"{tick:g}") for tick in np.arange(0.0, high, step)]
    return frame.svg(bars, mark + 'stroke-dasharray="3 3"/>', x=ticks, y=[(0, "0"), (counts.max(), f"{counts.max()}")])


class _Frame:
    """Plot coordinates, and the axes around them."""

    def __init__(self, left: float, right: float, low: float, high: float) -> None:
        self._left, self._right, self._low, self._high = left, right, low, high

    def x(self, value: float) -> float:
        return _LEFT + (value - self._left) / (self._right - self._left) * (_WIDTH - 6 - _LEFT)

    def y(self, value: float) -> float:
        share = (value - self._low) / (self._high - self._low)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)

    def svg(self, *parts: str, x: list[tuple[float, str]], y: list[tuple[float, str]]) -> str:
        ticks = "".join(
            f'<text x="{self.x(at):.1f}" y="{_HEIGHT - 4}" text-anchor="middle">{escape(text)}</text>' for at, text in x
        ) + "".join(
            f'<text x="{_LEFT - 4}" y="{self.y(at) + 3:.1f}" text-anchor="end">{escape(text)}</text>' for at, text in y
        )
        base = f'<line x1="{_LEFT}" x2="{_WIDTH - 6}" y1="{self.y(self._low):.1f}" y2="{self.y(self._low):.1f}"'
        return (
            f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" style="width:100%;display:block" font-size="9"'
            f' fill="{QUIET}">{base} stroke="{QUIET}" stroke-width="0.7"/>{"".join(parts)}{ticks}</svg>'
        )
