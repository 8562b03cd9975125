"""A versioned, append-only store, and cursors by which readers follow it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar, overload

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Cursor:
    """How far a reader has read. `version` counts the truncations that it knows of."""

    version: int = 0
    length: int = 0


class Change(NamedTuple, Generic[T]):
    """What brings a reader up to date: it keeps its first `keep` rows and appends `rows`."""

    keep: int
    rows: tuple[T, ...]
    cursor: Cursor


class Log(Generic[T]):
    """Rows that are appended at the end, and taken away only by `truncate`.

    A reader, in any process, holds a copy of the rows and a cursor. It asks `since` what has changed and never has
    to know why.
    """

    def __init__(self, rows: Iterable[T] = ()) -> None:
        self._rows = list(rows)
        self._cuts: list[int] = []  # the length after each truncation

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[T]:
        return iter(self._rows)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        return self._rows[index]

    @property
    def cursor(self) -> Cursor:
        """The cursor of a reader that has everything."""
        return Cursor(len(self._cuts), len(self._rows))

    def append(self, row: T) -> None:
        self._rows.append(row)

    def extend(self, rows: Iterable[T]) -> None:
        self._rows.extend(rows)

    def truncate(self, length: int) -> None:
        """Keep the first `length` rows, or all if there are fewer."""
        length = max(length, 0)
        if length < len(self._rows):
            del self._rows[length:]
            self._cuts.append(length)

    def keep(self, cursor: Cursor) -> int:
        """How many of the first rows are still the same since this cursor was given."""
        return min(cursor.length, len(self._rows), *self._cuts[cursor.version :])

    def since(self, cursor: Cursor) -> Change[T]:
        """What has changed since this cursor was given."""
        keep = self.keep(cursor)
        return Change(keep, tuple(self._rows[keep:]), self.cursor)
