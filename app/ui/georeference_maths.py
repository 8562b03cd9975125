"""Values for the georeference panel: rows of the table, lines in the scene, and the centre of a target sphere."""

from typing import Any, Final, NamedTuple

import numpy as np

from app.georeference.align import Alignment
from app.georeference.control import control_table
from app.mapping.earth import FIX, POINT
from app.mapping.kept import Spot
from app.server.protocol import Chunk, Snapshot
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops.edits import Override
from app.slam.types import F32, F64
from app.ui.measure_maths import around

MOST_ROWS: Final = 100
_NEAR_M, _FEWEST, _WORST_M = 0.03, 12, 0.01
"""Points of a sphere: largest distance from its surface (m), how many are needed, and largest RMS distance (m)."""


class Row(NamedTuple):
    """A fix or control point in the table. word: what a click on it sends. texts: residuals in m, distance in σ."""

    name: str
    word: str
    used: bool
    edited: bool
    texts: tuple[str, ...]


def rows_of(found: Alignment, current: Snapshot) -> list[Row]:
    """Rows of the table: rejected and overridden entries first, then by decreasing residual."""
    survey = current.earth.survey
    kind = POINT if survey is not None and survey.control else FIX
    edited = {edit.what for edit in current.loops.undo if isinstance(edit, Override)}
    overridden = np.array([kind + name in edited for name in found.names])
    length = np.linalg.norm(found.residuals, axis=1)
    order = np.lexsort((-length, found.used & ~overridden))
    return [
        Row(
            found.names[k],
            f"override {kind}{found.names[k]}",
            bool(found.used[k]),
            bool(overridden[k]),
            (*(f"{value:+.3f}" for value in found.residuals[k]), f"{found.distances[k]:.1f}"),
        )
        for k in order[:MOST_ROWS].tolist()
    ]


def lines_of(found: Alignment) -> tuple[F32, F32]:
    """(n, 3) m, measured positions of fixes or points, and (n, 2, 3) m, lines from these to their places in the map."""
    measured = found.reference.from_crs(found.grid)
    at = measured - found.residuals @ np.array(found.reference.rotation)
    return measured.astype(np.float32), np.stack((measured, at), axis=1).astype(np.float32)


def names_of(text: str) -> tuple[str, ...]:
    """Names of the control points in a table, each once: a dropdown with duplicates would blank the page.

    Raises:
        HemislamError: it has no heading, or a row is cut.
    """
    return tuple(dict.fromkeys(control_table(text).columns.get("name", ()))) if text.strip() else ()


def numbers_in(text: str, what: str, count: int) -> list[float]:
    """Exactly `count` numbers, or none. Raises HemislamError, which names `what`."""
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        found = [np.nan]
    if len(found) not in (0, count) or not np.isfinite(found).all():
        raise HemislamError(f"The {what} is {text}; it takes {count} number{'s' if count > 1 else ''}, or nothing.")
    return found


def centre_of_sphere(chunks: tuple[Chunk, ...], poses: F64, spot: Spot, radius: float) -> tuple[float, float, float]:
    """The centre of a sphere of known radius (m), fitted to the points around a spot on it.

    Args:
        poses: (k, 4, 4) T_map_imu of the chunks' keyframes.

    Returns:
        m, in the IMU frame of the spot's keyframe.

    Raises:
        HemislamError: the points there do not form such a sphere.
    """
    from scipy import optimize  # imported here: the page loads this module, but few users need spheres

    least_squares: Any = optimize.least_squares  # mypy takes it for the module of that name
    T = poses[spot.keyframe]
    at = lie.moved(T, spot.at)
    points = around(chunks, poses, at, 2.5 * radius)
    behind = at + radius * (at - T[:3, 3]) / np.linalg.norm(at - T[:3, 3])

    def off(centre: F64) -> F64:
        return np.asarray(np.linalg.norm(points - centre, axis=1) - radius)

    if len(points) >= _FEWEST:
        behind = least_squares(off, behind, loss="cauchy", f_scale=_NEAR_M / 3).x
        near = np.abs(off(behind)) < _NEAR_M
        if near.sum() >= _FEWEST:
            behind = least_squares(lambda centre: off(centre)[near], behind).x
            if np.sqrt((off(behind)[near] ** 2).mean()) < _WORST_M and near.mean() > 0.5:
                x, y, z = (T[:3, :3].T @ (behind - T[:3, 3])).tolist()
                return x, y, z
    raise HemislamError(
        f"The points there do not form a sphere of {radius:g} m radius; click its middle, or pick a point instead."
    )
