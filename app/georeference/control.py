"""Aligns a map with control points: known places, each picked in the map."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from app.georeference import crs
from app.georeference.align import Alignment
from app.georeference.fixes import Fixes, require_degrees, without_jumps
from app.georeference.ground import Ground
from app.georeference.reference import ELLIPSOIDAL
from app.georeference.tables import NamedColumns, table_of
from app.slam.arrays import F64, Mask
from app.slam.errors import HemislamError
from app.slam.metrics import umeyama

_EASTINGS, _DEGREES = ("east", "north", "height"), ("latitude", "longitude", "height")
CONTROL = ("name", "east", "north", "height", "latitude", "longitude")
PICKS = ("name", "x", "y", "z")
"""Columns of the two tables."""
LEAST_WIDTH = 0.02
"""Least spread of control points beside the line through them, as a share of their spread along it."""


def control_table(text: str) -> NamedColumns:
    """A table of control points. Raises HemislamError: it has no heading, or a row is cut."""
    return table_of(text.splitlines(), "The table of control points", *CONTROL)


def align_with_points(
    control: NamedColumns,
    picked: Mapping[str, F64],
    *,
    grid: str = "",
    height: str = ELLIPSOIDAL,
    overridden: Mapping[str, bool] = MappingProxyType({}),
) -> Alignment:
    """Align a map by least squares over control points, with rotations about all axes. Its shape does not change.

    Args:
        control: name, E, N, H in `grid`, or name, latitude, longitude, height. picked: (3,) m in the map, by name.
        height: what heights are above. overridden: False for points that do not count.

    Raises:
        HemislamError: a table cannot be used, or the points do not determine the map's place.
    """
    name, places = read_places(control, grid)
    names = [one for one in places if one in picked]
    used = np.array([overridden.get(one, True) for one in names], bool)
    count = [one for one, uses in zip(names, used, strict=True) if uses]
    if len(count) < 3:
        raise HemislamError(_left_open(count))
    there, at = np.array([places[one] for one in names]), np.array([picked[one] for one in names])
    if lost := next((one for one, place in zip(names, at, strict=True) if not np.isfinite(place).all()), None):
        raise HemislamError(f"Control point {lost} was picked at no place of the map; pick it again.")
    _refuse_line(at[used], count)
    ground = Ground.in_grid(there, name)
    _refuse_line(ground.places[used], count)
    found = _fitted(at, ground, tuple(names), used, height)
    if found.reference.rotation[2][2] <= 0:
        cause = "easting and northing" if control.has("east") else "latitude and longitude"
        raise HemislamError(
            f"The control points fit only a map that is upside down: {cause} seem to be swapped, or names exchanged;"
            " check both tables."
        )
    return found


def read_picks(table: NamedColumns) -> dict[str, F64]:
    """(3,) m in the map by name. Raises HemislamError: it lacks columns, a name or a coordinate, or names one twice."""
    if not table.has(*PICKS):
        raise HemislamError(
            f"{table.source} holds no picked points; its first line must name the columns name, x, y, z."
        )
    names = _names(table)
    return dict(zip(names, _complete(table, "x", "y", "z"), strict=True))


def _left_open(names: list[str]) -> str:
    """What fewer than three points leave open, in a sentence."""
    found = f"only {' and '.join(names)} {'is' if len(names) == 1 else 'are'}" if names else "none is"
    rest = ("the map's place", "the map's rotation", "the map's rotation about the line through both")
    return f"At least 3 control points must be picked and accepted, but {found}: {rest[len(names)]} is undetermined."


def read_places(table: NamedColumns, grid: str = "") -> tuple[str, dict[str, F64]]:
    """The grid and (3,) easting, northing, height of each control point by name.

    Raises:
        HemislamError: it lacks the grid, or as `sound_places`.
    """
    columns, names, numbers = sound_places(table)
    if columns == _EASTINGS:
        if not grid:
            raise HemislamError(f"{table.source} holds eastings and northings; say of which grid: EPSG:CODE.")
        crs.projected(grid)
    else:
        ground = Ground.of(Fixes.of(np.zeros(len(numbers)), without_jumps(numbers)), grid)
        grid, numbers = ground.centre.crs, ground.grid
    return grid, dict(zip(names, numbers, strict=True))


def sound_places(table: NamedColumns) -> tuple[tuple[str, str, str], list[str], F64]:
    """The columns of the coordinates, the names of the control points, and their coordinates (n, 3).

    Raises:
        HemislamError: a row is not a control point on Earth with a name of its own and all coordinates.
    """
    columns, names = _coordinates(table), _names(table)
    numbers = _complete(table, *columns)
    if columns == _DEGREES:
        require_degrees(numbers, table.source, "row")
    return columns, names, numbers


def _complete(table: NamedColumns, *columns: str) -> F64:
    """(n, k) numbers in these columns. Raises HemislamError: a row lacks one."""
    numbers = table.numbers(*columns)
    for row, place in enumerate(numbers, 1):
        for column, number in zip(columns, place.tolist(), strict=True):
            if not np.isfinite(number):
                raise HemislamError(
                    f"{table.source}, row {row}: the {column} is missing; fill it in or remove the row."
                )
    return numbers


def _coordinates(table: NamedColumns) -> tuple[str, str, str]:
    """The columns of the places. Raises HemislamError: the table lacks them, or any row."""
    for columns in (_EASTINGS, _DEGREES):
        if len(table) and table.has("name", *columns):
            return columns
    raise HemislamError(
        f"{table.source} holds no control points; its first line must name the columns name, E, N, H, or name,"
        " latitude, longitude, height."
    )


def _names(table: NamedColumns) -> list[str]:
    """The names of the control points. Raises HemislamError: a name is empty or occurs twice."""
    names = list(table.columns["name"])
    if "" in names:
        raise HemislamError(f"{table.source}, row {names.index('') + 1}: the name is missing; give the point one.")
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise HemislamError(
            f"{table.source} holds control point {twice} more than once; keep one, or rename the other."
        )
    return names


def _refuse_line(points: F64, names: list[str]) -> None:
    """Raises HemislamError if the points lie on one line, about which the map could still rotate."""
    along, beside, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if beside <= LEAST_WIDTH * along:
        raise HemislamError(
            f"The control points {', '.join(names)} lie on one line, so the map can still rotate about it;"
            " pick another one off this line."
        )


def _fitted(points: F64, ground: Ground, names: tuple[str, ...], used: Mask, height: str) -> Alignment:
    """The alignment by the rigid transform with the least squared distances."""
    T = umeyama(points[used], ground.places[used])
    R, shift = T[:3, :3], T[:3, 3]
    residuals = ground.places - points @ R.T - shift
    tilt = float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0))))
    notes = [f"The control points tilt the map by {tilt:.3f}° against gravity."]
    if tilt > 2.0:
        notes.append(
            "Gravity is more accurate than that: check the heights, the names, and whether x, y, z are of this map."
        )
    rms = float(np.sqrt((residuals[used] ** 2).sum() / max(3 * used.sum() - 6, 1)))
    return Alignment(
        ground.reference(R, shift, height),
        names,
        ground.grid,
        residuals,
        np.linalg.norm(residuals, axis=1) / max(rms, 1e-9),
        used,
        notes=tuple(notes),
    )
