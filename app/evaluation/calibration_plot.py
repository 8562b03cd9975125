"""The residuals of a calibration before and after, as one SVG file."""

from collections.abc import Sequence

import numpy as np

from app.calibration.calibrate import Calibration
from app.calibration.lines import Lines
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
    turned, moved = calibration.turned, calibration.moved
    charts = [
        _chart(np.degrees(turned.before), np.degrees(turned.after), "turning (deg)"),
        _chart(moved.before * 1e3, moved.after * 1e3, "motion (mm)"),
    ]
    if np.isfinite(calibration.lines.after).any():
        charts.append(_of_lines(calibration.lines))
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


def _chart(before: F64, after: F64, label: str) -> str:
    first, last = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    return _before_and_after(first, last, "scan", f"{label}: scans against IMU")


def _of_lines(lines: Lines) -> str:
    return _before_and_after(lines.before * 1e3, lines.after * 1e3, "scan line", "points on planes (mm)")


def _before_and_after(before: F64, after: F64, x_label: str, label: str) -> str:
    lines = [
        Line(name, colour, np.flatnonzero(np.isfinite(values)).astype(np.float64), values[np.isfinite(values)])
        for name, colour, values in (("before", PALETTE[4], before), ("after", PALETTE[0], after))
    ]
    return str(chart(lines, x_label, f"{label}, red before, blue after", from_zero=True, height=_HEIGHT))
