"""The charts of one loop: two Scan Contexts from above, their distance over the turn, and the residuals."""

from typing import Final

import numpy as np

from app.slam.loops.scan_context import YAWS
from app.slam.types import F32, F64, U8
from app.ui.colours import TABLES

UNSEEN: Final = (104, 108, 116)
"""Grey: never seen, so it counts for neither side."""
_DISC: Final = 300
_GAP: Final = 20
_BARS: Final = 30


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


def shift_curve(shift_distances: F64, limit: float) -> tuple[F64, F64, F64]:
    """Degrees by which the newer context is turned, the contexts' distance there, and its limit, (sectors,) each."""
    order = np.argsort(YAWS)
    distances = np.asarray(shift_distances, dtype=np.float64)[order]
    return np.degrees(YAWS[order]), distances, np.full(len(distances), limit)


def histogram(residuals: F64, limit: float) -> tuple[F64, F64, F64]:
    """How many points are how far from the other submap's surface, as the outline of bars over mm.

    Args:
        residuals: (k,) m. limit: m; it lies between two bars, where the third series has its only numbers.
    """
    values = 1000 * np.abs(residuals[np.isfinite(residuals)])
    high = max(float(np.percentile(values, 99)), 1100 * limit) if len(values) else 1100 * limit
    per_limit = max(round(_BARS * 1000 * limit / high), 1)
    width = 1000 * limit / per_limit
    counts, edges = np.histogram(values, bins=width * np.arange(int(np.ceil(high / width)) + 1))
    mark = np.full(2 * len(counts), np.nan)
    mark[2 * per_limit - 1 : 2 * per_limit + 1] = 0.0, counts.max(initial=1)
    return np.repeat(edges, 2)[1:-1], np.repeat(counts, 2).astype(np.float64), mark
