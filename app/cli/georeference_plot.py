"""A georeference as one SVG file: the path and the fixes from above, and the residuals."""

import numpy as np

from app.evaluation.calibration_plot import page
from app.evaluation.figures import PALETTE, Line, chart
from app.georeference.align import Alignment
from app.slam.types import F64


def georeference_plot(alignment: Alignment, positions: F64) -> str:
    """Two charts, in metres from the map's origin: east against north, and the residual of each fix.

    Args:
        positions: (n, 3) m of the walked path in the map.
    """
    origin = np.array(alignment.reference.origin)
    path = alignment.reference.to_crs(positions) - origin
    fixes, used = alignment.grid - origin, alignment.used
    lines = [
        Line("fixes that count", PALETTE[2], fixes[used, 0], fixes[used, 1], dashed=True),
        Line("path", PALETTE[0], path[:, 0], path[:, 1]),
        *(_cross(place) for place in fixes[~used]),
    ]
    at = np.flatnonzero(used).astype(np.float64)
    over = [
        Line(name, PALETTE[colour], at, alignment.residuals[used, axis])
        for axis, (name, colour) in enumerate((("east", 0), ("north", 1), ("height", 2)))
    ]
    return page(
        [
            chart(lines, "east (m)", "north (m): fixes green, rejected red", equal=True),
            chart(over, "fix", "residual (m): east blue, north orange, height green"),
        ]
    )


def _cross(place: F64) -> Line:
    """A rejected fix."""
    east, north = place[0] + np.array([-0.3, 0.3, 0, 0, 0]), place[1] + np.array([0, 0, 0, 0.3, -0.3])
    return Line("rejected", PALETTE[4], east, north)
