"""The residuals of a calibration before and after, as one SVG file."""

from collections.abc import Sequence

import numpy as np

from app.calibration.calibrate import Calibration
from app.evaluation.figures import PALETTE, Line, chart
from app.slam.types import F64

_HEIGHT = 300
_STYLE = (
    "<style>text{font:11px sans-serif;fill:#374151}.grid{stroke:#e5e7eb}.axis{font-weight:600}</style>"
    '<rect width="100%" height="100%" fill="white"/>'
)


def residual_plot(calibration: Calibration) -> str:
    """How much the LiDAR's turns and ways differ from the IMU's, and how far the points of each scan line are from
    planes."""
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
    return page(charts)


def page(charts: Sequence[str]) -> str:
    """Charts of the usual height below one another, as a file of their own."""
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
    return str(chart(lines, x_label, f"{label}, red before, blue after", from_zero=True, height=_HEIGHT))
