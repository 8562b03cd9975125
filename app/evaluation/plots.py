"""Plots of the residuals of a calibration and of a georeference, each as one SVG file."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from app.evaluation.figures import PALETTE, Line, chart
from app.slam.types import F64

if TYPE_CHECKING:  # each plot needs only its own package
    from app.calibration.calibrate import Calibration
    from app.georeference.align import Alignment

_HEIGHT = 300
_CROSS = np.array([[-0.3, 0.3, 0, 0, 0], [0, 0, 0, 0.3, -0.3]])
"""m, of a rejected fix."""
_STYLE = (
    "<style>text{font:11px sans-serif;fill:#374151}.grid{stroke:#e5e7eb}.axis{font-weight:600}</style>"
    '<rect width="100%" height="100%" fill="white"/>'
)


def residual_plot(calibration: "Calibration") -> str:
    """Differences between LiDAR and IMU in rotation and motion; distances of each scan line's points from planes."""
    turned, moved, lines = calibration.turned, calibration.moved, calibration.lines
    turns = np.linalg.norm(np.degrees([turned.before, turned.after]), axis=2)
    ways = np.linalg.norm(np.multiply([moved.before, moved.after], 1e3), axis=2)
    charts = [
        _before_and_after(turns, "scan", "turning (deg): scans against IMU"),
        _before_and_after(ways, "scan", "motion (mm): scans against IMU"),
    ]
    if np.isfinite(lines.after).any():
        charts.append(
            _before_and_after(1e3 * np.array([lines.before, lines.after]), "scan line", "points on planes (mm)")
        )
    return _page(charts)


def georeference_plot(alignment: "Alignment", positions: F64) -> str:
    """Two charts in metres: east and north from the map's origin, and the residual of each fix.

    Args:
        positions: (n, 3) m of the walked path in the map.
    """
    origin = np.array(alignment.reference.origin)
    path = alignment.reference.to_crs(positions) - origin
    fixes, used = alignment.grid - origin, alignment.used
    lines = [
        Line("fixes that count", PALETTE[2], fixes[used, 0], fixes[used, 1], dashed=True),
        Line("path", PALETTE[0], path[:, 0], path[:, 1]),
        *(Line("rejected", PALETTE[4], *(place[:2, None] + _CROSS)) for place in fixes[~used]),
    ]
    at = np.flatnonzero(used).astype(np.float64)
    over = [
        Line(name, PALETTE[colour], at, alignment.residuals[used, axis])
        for axis, (name, colour) in enumerate((("east", 0), ("north", 1), ("height", 2)))
    ]
    return _page(
        [
            chart(lines, "east (m)", "north (m): fixes green, rejected red", equal=True),
            chart(over, "fix", "residual (m): east blue, north orange, height green"),
        ]
    )


def _page(charts: Sequence[str]) -> str:
    """One file with charts of the usual height below one another."""
    placed = [
        str(svg).replace("<svg ", f'<svg y="{_HEIGHT * k}" width="560" height="{_HEIGHT}" ', 1)
        for k, svg in enumerate(charts)
    ]
    height = _HEIGHT * len(charts)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 560 {height}" width="560" height="{height}">'
    return head + _STYLE + "".join(placed) + "</svg>\n"


def _before_and_after(both: F64, x_label: str, label: str) -> str:
    """both: (2, n)."""
    lines = [
        Line(name, colour, np.flatnonzero(np.isfinite(values)).astype(np.float64), values[np.isfinite(values)])
        for name, colour, values in zip(("before", "after"), (PALETTE[4], PALETTE[0]), both, strict=True)
    ]
    return str(chart(lines, f"{x_label} (red before, blue after)", label, from_zero=True, height=_HEIGHT))
