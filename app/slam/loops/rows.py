"""Arrays that grow by a row at a time, so that a long walk does not put the same rows together again and again."""

from collections.abc import Iterable
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T", bound=np.generic)


class Rows(Generic[T]):
    """Rows of one shape and type; what was seen of them never changes.

    Attributes:
        array: (n, *shape), read-only; stays as it is when rows are added.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type[T], rows: Iterable[Any] = ()) -> None:
        given = np.array(list(rows), dtype=dtype).reshape(-1, *shape)
        self._buffer, self._count = given, len(given)
        self._look()

    def append(self, row: Any) -> None:
        if self._count == len(self._buffer):
            larger = np.empty((max(2 * self._count, 16), *self._buffer.shape[1:]), self._buffer.dtype)
            larger[: self._count] = self._buffer
            self._buffer = larger
        self._buffer[self._count] = row
        self._count += 1
        self._look()

    def _look(self) -> None:
        self.array: npt.NDArray[T] = self._buffer[: self._count]
        self.array.setflags(write=False)
