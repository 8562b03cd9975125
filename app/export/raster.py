"""The map from above: counts in the cells of a grid. The points are read three times, so that none must be stored."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.export.points import Block
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.types import F64, U8, Mask, is_ground

CELL = 0.05
"""m, edge of a cell; larger for huge maps."""
COARSE_CELL = 0.25
"""m, edge of a cell of terrain, density and the picture for Google Earth."""
MOST_CELLS = 16_000_000
COARSE = 10
"""Cells along the edge of a square with a single ground height."""
WALL_FROM, WALL_TO = 0.2, 1.8
"""m above the ground: heights at which a robot or a person would hit an obstacle."""
SLICE_FROM, SLICE_TO = 1.0, 1.5
"""m above the ground: heights of a floor plan's slice, above tables and below lamps."""


@dataclass(frozen=True)
class Raster:
    """Counts in cells, row 0 in the south.

    Attributes:
        origin: (3,) m, x and y of the outer corner of cell (0, 0), and the offset subtracted from heights.
        cell: m. points, ground, walls, cut: (rows, columns) int32, numbers of all points, of ground points, and of
            points in the two ranges of height above ground. height_sum: (rows, columns) of ground points, m.
    """

    origin: F64
    cell: float
    points: npt.NDArray[np.int32]
    ground: npt.NDArray[np.int32]
    walls: npt.NDArray[np.int32]
    cut: npt.NDArray[np.int32]
    height_sum: F64

    @property
    def height(self) -> npt.NDArray[np.float32]:
        """(rows, columns) m, mean height of the ground points; NaN without ground points."""
        with np.errstate(invalid="ignore"):
            mean = self.height_sum / self.ground + self.origin[2]
        return np.where(self.ground > 0, mean, np.nan).astype(np.float32)


def rasterise(read: Callable[[], Iterable[Block]], where: GeoReference | None, cell: float) -> Raster:
    """Count the chosen points of a map.

    Args:
        read: returns all points anew on each call. where: georeference of the raster; None: the map's frame.
        cell: m.

    Raises:
        HemislamError: there are no points, or none is ground.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points, _ in _points(read, where):
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if not np.isfinite(low).all():
        raise HemislamError("The map has no points to draw a plan of.")
    while np.prod((high - low)[:2] / cell + COARSE) > MOST_CELLS:
        cell *= 2
    origin = np.append(np.floor(low[:2] / (cell * COARSE)) * cell * COARSE, math.floor(low[2]))
    size = np.ceil((high - origin)[:2] / (cell * COARSE) + 1e-9).astype(int) * COARSE
    shape = (int(size[1]), int(size[0]))
    floor = _floor(read, where, origin, cell, shape)
    counts = {name: np.zeros(shape, np.int32) for name in ("points", "ground", "walls", "cut")}
    height_sum = np.zeros(shape)
    for points, labels in _points(read, where):
        rows, columns = _cells(points, origin, cell)
        above = points[:, 2] - floor[rows // COARSE, columns // COARSE]
        on_ground = is_ground(labels)
        kinds: tuple[slice | Mask, ...] = (
            slice(None),
            on_ground,
            ~on_ground & (above > WALL_FROM) & (above < WALL_TO),
            ~on_ground & (above > SLICE_FROM) & (above < SLICE_TO),
        )
        for count, which in zip(counts.values(), kinds, strict=True):
            np.add.at(count, (rows[which], columns[which]), 1)
        np.add.at(height_sum, (rows[on_ground], columns[on_ground]), points[on_ground, 2] - origin[2])
    return Raster(origin, cell, height_sum=height_sum, **counts)


def _floor(
    read: Callable[[], Iterable[Block]], where: GeoReference | None, origin: F64, cell: float, shape: tuple[int, int]
) -> F64:
    """(rows, columns) of coarse squares: mean height of the ground, m; without ground, that of the nearest square."""
    total, count = np.zeros((2, shape[0] // COARSE, shape[1] // COARSE))
    for points, labels in _points(read, where):
        points = points[is_ground(labels)]
        place = _cells(points, origin, cell * COARSE)
        np.add.at(total, place, points[:, 2])
        np.add.at(count, place, 1)
    if not count.any():
        raise HemislamError("No point of the map is ground, and a plan starts from the ground; tune the ground first.")
    unseen = count == 0
    from scipy import ndimage  # imported here: every run loads this module, but few draw a plan

    nearest = ndimage.distance_transform_edt(unseen, return_distances=False, return_indices=True)  # type: ignore[attr-defined]  # no types
    mean = total / np.maximum(count, 1)
    return np.asarray(mean[tuple(nearest)])


def _points(read: Callable[[], Iterable[Block]], where: GeoReference | None) -> Iterator[tuple[F64, U8]]:
    for block in read():
        if len(block):
            yield (block.points if where is None else where.to_crs(block.points)), block.labels


def _cells(points: F64, origin: F64, cell: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    columns, rows = ((points[:, :2] - origin[:2]) / cell).astype(np.int64).T
    return rows, columns
