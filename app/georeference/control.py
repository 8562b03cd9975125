"""Lays a map on control points: known places, each picked in the map."""

from pathlib import Path

import numpy as np

from app.georeference import crs
from app.georeference.align import Alignment, Ground
from app.georeference.fixes import Fixes
from app.georeference.reference import ELLIPSOIDAL
from app.georeference.tables import read_table
from app.slam.arrays import F64
from app.slam.errors import HemislamError

LEAST_WIDTH = 0.02
"""Of control points beside the line through them, as a share of their length along it."""


def lay_on_control(control: Path, picks: Path, *, grid: str = "", height: str = ELLIPSOIDAL) -> Alignment:
    """Where a map lies by the least squares of control points, turned about all axes. Its shape does not change.

    Args:
        control: table of name, E, N, H in `grid`, or name, latitude, longitude, height.
        picks: table of name, x, y, z, m in the map. height: what heights are above.

    Raises:
        HemislamError: a table cannot be read, or the points leave the map's place open.
    """
    name, places = read_places(control, grid)
    table = read_table(picks, "name", "x", "y", "z")
    if not table.has("name", "x", "y", "z"):
        raise HemislamError(f"{picks} holds no picked points; its first line must name the columns name, x, y, z.")
    picked = dict(zip(table.columns["name"], table.numbers("x", "y", "z"), strict=True))
    names = [one for one in places if one in picked]
    if len(names) < 3:
        found = f"only {', '.join(names)}" if names else "none"
        raise HemislamError(
            f"At least 3 control points must be picked in the map, but of {control} {found} is in {picks};"
            " with fewer, the map may still turn."
        )
    there, at = np.array([places[one] for one in names]), np.array([picked[one] for one in names])
    if not np.isfinite([there, at]).all():
        raise HemislamError(f"A control point of {control} or {picks} lacks a coordinate; fill it in or remove it.")
    _refuse_line(at, names)
    return _fitted(at, Ground.in_grid(there, name), tuple(names), height)


def read_places(path: Path, grid: str = "") -> tuple[str, dict[str, F64]]:
    """The grid and (3,) easting, northing, height of each control point by name.

    Raises:
        HemislamError: it cannot be read, or lacks columns or the grid.
    """
    table = read_table(path, "name", "east", "north", "height", "latitude", "longitude")
    if table.has("name", "east", "north", "height"):
        if not grid:
            raise HemislamError(f"{path} holds eastings and northings; say of which grid with --crs EPSG:CODE.")
        crs.projected(grid)
        numbers = table.numbers("east", "north", "height")
    elif table.has("name", "latitude", "longitude", "height"):
        degrees = table.numbers("latitude", "longitude", "height")
        every = Fixes.of(np.arange(len(degrees)), degrees).sound(str(path))
        ground = Ground.of(every, grid)
        grid = ground.name
        numbers = np.full(degrees.shape, np.nan)
        numbers[every.stamps_ns] = ground.grid
    else:
        raise HemislamError(
            f"{path} holds no control points; its first line must name the columns name, E, N, H, or name, latitude,"
            " longitude, height."
        )
    return grid, dict(zip(table.columns["name"], numbers, strict=True))


def _refuse_line(points: F64, names: list[str]) -> None:
    """Raises HemislamError if the points lie on one line, about which the map may still turn."""
    along, beside, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if beside <= LEAST_WIDTH * along:
        raise HemislamError(
            f"The control points {', '.join(names)} lie on one line, so the map may still turn about it;"
            " pick one beside it."
        )


def _fitted(points: F64, ground: Ground, names: tuple[str, ...], height: str) -> Alignment:
    """The rigid transform with the least squares of distances (Arun et al. 1987, Umeyama 1991)."""
    middle, there = points.mean(axis=0), ground.places.mean(axis=0)
    u, _, vt = np.linalg.svd((ground.places - there).T @ (points - middle))
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    shift = there - R @ middle
    residuals = ground.places - points @ R.T - shift
    tilt = float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0))))
    notes = [f"The control points tilt the map by {tilt:.3f}° against gravity."]
    if tilt > 2.0:
        notes.append("Gravity knows better: check the heights, the names, and whether x, y, z are of this map.")
    rms = float(np.sqrt((residuals**2).sum() / max(3 * len(points) - 6, 1)))
    return Alignment(
        ground.reference(R, shift, height),
        names,
        ground.grid,
        residuals,
        np.linalg.norm(residuals, axis=1) / max(rms, 1e-9),
        np.ones(len(points), bool),
        notes=tuple(notes),
    )
