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
    """Two charts over the scans: how much the LiDAR's turns and ways differ from the IMU's."""
    turned, moved = calibration.turned, calibration.moved
    charts = [
        _chart(np.degrees(turned.before), np.degrees(turned.after), "turning (deg)"),
        _chart(moved.before * 1e3, moved.after * 1e3, "motion (mm)"),
    ]
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
    lines = [
        Line(name, colour, np.arange(len(values), dtype=np.float64), np.linalg.norm(values, axis=1))
        for name, colour, values in (("before", PALETTE[4], before), ("after", PALETTE[0], after))
    ]
    title = f"{label}: scans against IMU, red before, blue after"
    return str(chart(lines, "scan", title, from_zero=True, height=_HEIGHT))
