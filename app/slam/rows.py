"""Arrays that grow at their end."""

from collections.abc import Iterable
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T", bound=np.generic)


class Rows(Generic[T]):
    """Rows of one shape and type. Capacity doubles, so that appending n rows copies O(n) rows in all.

    Views that were handed out are read-only and stay as they are when rows are added.

    Args:
        shape: of one row.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type[T] | np.dtype[T], rows: Iterable[Any] = ()) -> None:
        self._table: npt.NDArray[T] = np.array(list(rows), dtype=dtype).reshape(-1, *shape)
        self._length = len(self._table)

    def __len__(self) -> int:
        return self._length

    def append(self, row: npt.ArrayLike) -> None:
        self.extend(np.asarray(row, dtype=self._table.dtype)[None])

    def extend(self, rows: npt.NDArray[T]) -> None:
        needed = self._length + len(rows)
        if needed > len(self._table):
            larger = np.empty((max(needed, 2 * len(self._table), 256), *self._table.shape[1:]), self._table.dtype)
            larger[: self._length] = self.view()
            self._table = larger
        self._table[self._length : needed] = rows
        self._length = needed

    def truncate(self, length: int) -> None:
        """Keep the first `length` rows. Views handed out stay as they are."""
        if length < self._length:
            self._table, self._length = self._table[:length].copy(), length

    def view(self) -> npt.NDArray[T]:
        """(n, *shape), read-only."""
        view = self._table[: self._length]
        view.setflags(write=False)
        return view
