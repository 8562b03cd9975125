"""Arrays that grow at their end, so that a long walk does not put the same rows together again and again.

Once they are large they lie on disk: as with keyframes, memory stays as it is however long the walk.
"""

import math
import mmap
import os
import sys
import tempfile
from collections.abc import Iterable
from typing import Any, Final, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T", bound=np.generic)

ON_DISK: Final = 256 << 10
"""Bytes from which on rows lie on disk."""


class Rows(Generic[T]):
    """Rows of one shape and type. Views handed out are read-only and stay as they are when rows are added.

    Capacity doubles, so that n rows cost O(n) copies in all. Large ones are a temporary file without a name that is
    mapped, so the system may take the memory for something else and read the rows again when they are wanted.

    Args:
        shape: of a row. order: "F" if columns are to be contiguous, which whoever reads one of them wants.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: type[T], rows: Iterable[Any] = (), *, order: Literal["C", "F"] = "C"
    ) -> None:
        given = np.array(list(rows), dtype=dtype).reshape(-1, *shape)
        self._order: Literal["C", "F"] = order
        self._length = 0
        self._table = self._room(max(256, len(given)), shape, dtype)
        self.extend(given)

    def __len__(self) -> int:
        return self._length

    def append(self, row: npt.ArrayLike) -> None:
        self.extend(np.asarray(row, dtype=self._table.dtype)[None])

    def extend(self, rows: npt.NDArray[T]) -> None:
        needed = self._length + len(rows)
        if needed > len(self._table):
            larger = self._room(max(needed, 2 * len(self._table)), self._table.shape[1:], self._table.dtype.type)
            larger[: self._length] = self._table[: self._length]
            self._table = larger
        self._table[self._length : needed] = rows
        self._length = needed

    def go_to(self, length: int) -> None:
        """Go back to so many rows, or forth again to as many as there were. Views handed out may then change."""
        self._length = min(length, len(self._table))

    def rewound(self, length: int) -> "Rows[T]":
        """Others, the first `length`: views handed out of these stay as they are."""
        others: Rows[T] = Rows(self._table.shape[1:], self._table.dtype.type, order=self._order)
        others.extend(self._table[: min(length, self._length)])
        return others

    def view(self) -> npt.NDArray[T]:
        """(n, *shape), read-only."""
        view = self._table[: self._length]
        view.setflags(write=False)
        return view

    def _room(self, length: int, shape: tuple[int, ...], dtype: type[T]) -> npt.NDArray[T]:
        return np.ndarray(
            (length, *shape), dtype, _space(length * math.prod(shape) * np.dtype(dtype).itemsize), order=self._order
        )


def _space(size: int) -> mmap.mmap | None:
    """A file of so many bytes, mapped; None if memory is to be taken, where it is small or there is no disk for it."""
    if size < ON_DISK or sys.platform != "linux":
        return None
    try:
        with tempfile.TemporaryFile(prefix="hemislam-rows-") as file:
            os.posix_fallocate(file.fileno(), 0, size)  # a full disk is said now, not by a signal at some later row
            return mmap.mmap(file.fileno(), size)
    except OSError:
        return None


def table(width: int) -> Rows[np.float64]:
    """Rows of so many numbers, their columns contiguous."""
    return Rows((width,), np.float64, order="F")
