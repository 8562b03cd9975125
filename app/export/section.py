"""A slab of the map from its side: a section through a box, or a profile along the walked path."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from app.export.box import Box
from app.export.points import Block
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.kernels.clouds import passages
from app.slam.types import F64, U8, is_ground

CELL: Final = 0.02
"""m, edge of a cell; larger for huge sections."""
MOST_CELLS: Final = 8_000_000
MOST_COLUMNS: Final = 20_000
"""Many programs cannot open wider pictures."""
STRIDE: Final = 0.5
"""m, least length of a step along the path: shorter steps would follow the walker's sway."""

Placed = Callable[[Block], tuple[F64, U8]]
"""Returns (n, 2) chainage and height (m) of the points in the slab, and their labels."""


@dataclass(frozen=True)
class Slab:
    """Points of a slab of the map in cells, row 0 at the bottom.

    Attributes:
        origin: (2,) chainage and height of the lower left corner of cell (0, 0), m. cell: m.
        points, ground: (rows, columns) int32, numbers of all points, and of ground points.
        sums: (rows, columns, 2) float32 m, sums of the points' positions in their cell.
    """

    origin: F64
    cell: float
    points: npt.NDArray[np.int32]
    ground: npt.NDArray[np.int32]
    sums: npt.NDArray[np.float32]

    @property
    def size(self) -> F64:
        """(2,) m, length and height of the slab."""
        return self.cell * np.array(self.points.shape[::-1], np.float64)

    def means(self) -> tuple[F64, npt.NDArray[np.bool_]]:
        """(n, 2) m, mean of the points in each non-empty cell, and (n,) whether most of them are ground."""
        rows, columns = np.nonzero(self.points)
        count = self.points[rows, columns]
        at = self.origin + np.column_stack([columns, rows]) * self.cell + self.sums[rows, columns] / count[:, None]
        return at, 2 * self.ground[rows, columns] > count


def of_box(read: Callable[[], Iterable[Block]], box: Box | None, where: GeoReference | None) -> Slab:
    """The content of the box, seen from its front; chainage begins at its left side.

    Args:
        read: returns all points anew on each call. where: georeference, for heights; None: heights in the map.

    Raises:
        HemislamError: no box is chosen, or it contains no points.
    """
    if box is None:
        raise HemislamError("A section shows what lies in a box; choose a box first.")

    def placed(block: Block) -> tuple[F64, U8]:
        chainage = box.own(block.points)[:, 0] + box.size[0] / 2
        return np.column_stack([chainage, heights(block.points, where)]), block.labels

    return _counted(read, placed)


def of_path(read: Callable[[], Iterable[Block]], positions: F64, half: float, where: GeoReference | None) -> Slab:
    """The points within `half` m beside a walked path, (n, 3) m; chainage is the horizontal path length. As `of_box`.

    Raises:
        HemislamError: the path has no length, or no points lie beside it.
    """
    path = strides(positions[:, :2])

    def placed(block: Block) -> tuple[F64, U8]:
        which, along, _ = along_path(block.points[:, :2], path, half)
        return np.column_stack([along, heights(block.points, where)[which]]), block.labels[which]

    return _counted(read, placed)


def strides(positions: F64) -> F64:
    """(m, 2) of (n, 2) positions, m: the first, each at least a stride from the one before, and the last.

    Raises:
        HemislamError: all of them are within a stride.
    """
    chosen = [positions[0]] if len(positions) else []
    for place in positions:
        if math.hypot(*(place - chosen[-1])) >= STRIDE:
            chosen.append(place)
    if len(chosen) < 2:
        raise HemislamError(f"A profile follows the walked path, and that is shorter than {STRIDE:g} m.")
    if math.hypot(*(positions[-1] - chosen[-1])) > 0.1 * STRIDE:
        chosen.append(positions[-1])
    return np.array(chosen)


def along_path(points: F64, path: F64, half: float) -> tuple[npt.NDArray[np.int64], F64, F64]:
    """Project (n, 2) points within `half` of a path (m, 2) onto it, once for each passage of the path, all in m.

    Returns:
        (k,) indices of the points, (k,) m along the path and (k,) m to the left of it.
    """
    flat, count = np.ascontiguousarray(points, np.float64), len(points)
    while True:
        out = np.empty(count, np.int64), np.empty(count), np.empty(count)
        count = passages(flat, path, half, *out)
        if count <= len(out[0]):
            return out[0][:count], out[1][:count], out[2][:count]


def heights(points: F64, where: GeoReference | None) -> F64:
    """(n,) m, heights of points of the map: on Earth if georeferenced, else z."""
    return points[:, 2] if where is None else where.to_crs(points)[:, 2]


def _counted(read: Callable[[], Iterable[Block]], placed: Placed) -> Slab:
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for at, _ in _parts(read, placed):
        low, high = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
    if not np.isfinite(low).all():
        raise HemislamError("There are no points in the slab; choose a wider one, or another box.")
    cell = CELL
    while ((size := (high - low) // cell + 2).prod()) > MOST_CELLS or size[0] > MOST_COLUMNS:
        cell *= 2
    origin = np.floor(low / cell) * cell
    shape = (int(size[1]), int(size[0]))
    points, ground, sums = np.zeros(shape, np.int32), np.zeros(shape, np.int32), np.zeros((*shape, 2), np.float32)
    for at, labels in _parts(read, placed):
        columns, rows = ((at - origin) / cell).astype(np.int64).T
        np.add.at(points, (rows, columns), 1)
        np.add.at(ground, (rows, columns), is_ground(labels))
        np.add.at(sums, (rows, columns), (at - origin - np.column_stack([columns, rows]) * cell).astype(np.float32))
    return Slab(origin, cell, points, ground, sums)


def _parts(read: Callable[[], Iterable[Block]], placed: Placed) -> Iterator[tuple[F64, U8]]:
    for block in read():
        at, labels = placed(block)
        if len(at):
            yield at, labels
