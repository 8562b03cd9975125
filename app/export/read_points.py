"""Reads the points of maps written by this or other programs, piece by piece and thinned: PLY, LAS and LAZ."""

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np

from app.export.points import Voxels
from app.slam.errors import HemislamError
from app.slam.types import F64

CLOUDS = (".ply", ".las", ".laz")
"""Suffixes of files that can be read."""
PIECE = 1_000_000
"""Points read at once."""
_FARTHEST_M = 1e9
"""No grid on Earth has larger coordinates."""
_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def read_points(path: Path, thin: float, progress: Callable[[float], None] = lambda share: None) -> F64:
    """(n, 3) float64, the first point in each voxel of `thin` m, in the file's coordinates.

    Args:
        progress: called with the share read so far, 0-1.

    Raises:
        HemislamError: the file cannot be read, has none of these formats, or holds no points.
    """
    read = {".ply": _ply, ".las": _las, ".laz": _las}.get(path.suffix.lower())
    if read is None:
        raise HemislamError(f"{path.name} is no map that can be read; choose a file of {', '.join(CLOUDS)}.")
    voxels, taken = Voxels(thin), [np.empty((0, 3))]
    try:
        for share, points in read(path):
            points = points[(np.abs(points) < _FARTHEST_M).all(axis=1)]  # also drops NaN
            taken.append(points[voxels.new(points)])
            progress(share)
    except OSError as error:
        raise HemislamError(f"The map {path} cannot be read: {error.strerror or error}; check the path.") from None
    except (ValueError, KeyError, IndexError, laspy.LaspyException, lazrs.LazrsError) as error:
        raise HemislamError(f"The map {path.name} is damaged or of an unknown kind ({error}).") from None
    if not (found := np.concatenate(taken)).size:
        raise HemislamError(f"The map {path.name} holds no points.")
    return found


def _las(path: Path) -> Iterator[tuple[float, F64]]:
    with laspy.open(path) as file:
        done, total = 0, max(file.header.point_count, 1)
        for piece in file.chunk_iterator(PIECE):
            done += len(piece)
            yield done / total, np.column_stack([piece.x, piece.y, piece.z]).astype(np.float64)


def _ply(path: Path) -> Iterator[tuple[float, F64]]:
    with path.open("rb") as file:
        order, vertex, count = _header(file)
        for begin in range(0, count, PIECE):
            size = min(PIECE, count - begin)
            if order:
                rows = np.fromfile(file, vertex, size)
            else:
                lines = list(islice(filter(bytes.strip, file), size))
                rows = np.loadtxt(lines, vertex, comments=None, ndmin=1) if lines else np.empty(0, vertex)
            if len(rows) < size:
                raise ValueError("it ends too early")
            yield (begin + size) / count, np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64)


def _header(file: BinaryIO) -> tuple[str, np.dtype, int]:
    """Byte order ("" for text), type and number of the vertices, which must come first."""
    order, fields, count, elements = "", list[tuple[str, str]](), 0, 0
    for number, line in enumerate(iter(file.readline, b"")):
        match line.decode("ascii", "replace").split():  # a comment may hold anything
            case ["ply"] if number == 0:
                pass
            case ["format", kind, _]:
                order = _ORDERS[kind]
            case ["element", name, text]:
                elements += 1
                if elements == 1:
                    if name != "vertex":
                        raise ValueError(f"it begins with {name}, not with vertices")
                    count = int(text)
            case ["property", kind, name] if elements == 1:
                fields.append((name, order + _KINDS[kind]))
            case ["property", "list", *_] if elements == 1:
                raise ValueError("its vertices hold lists")
            case ["end_header"]:
                return order, np.dtype(fields), count
            case _ if number == 0 or number > 1000:
                raise ValueError("it is no PLY file")
    raise ValueError("its header has no end")
