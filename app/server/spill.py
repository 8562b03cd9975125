"""Values put aside on disk, so that memory does not grow with them."""

import bisect
import os
import tempfile
from dataclasses import dataclass
from typing import IO

from app.packing import Parts


@dataclass(frozen=True, slots=True, order=True)
class Slot:
    """Where a value lies in the file: its first byte, and how long each of its parts is."""

    begin: int
    lengths: tuple[int, ...]

    @property
    def end(self) -> int:
        return self.begin + sum(self.lengths)


class Spill:
    """An unnamed temporary file of packed values (`app.packing.pack`); space given back is used again."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._used: list[Slot] = []
        self.nbytes = 0

    def put(self, parts: Parts) -> Slot:
        """Write a value. Raises OSError, and changes nothing, if the disk does not take it."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="hemislam-spill-", buffering=0)  # noqa: SIM115 - see close
        lengths = tuple(memoryview(part).nbytes for part in parts)
        slot = Slot(self._gap(sum(lengths)), lengths)
        self._file.seek(slot.begin)
        for part in parts:
            rest = memoryview(part).cast("B")
            while rest:
                rest = rest[self._file.write(rest) :]
        bisect.insort(self._used, slot)
        self.nbytes += sum(lengths)
        return slot

    def get(self, slot: Slot) -> Parts:
        """Read a value's parts. Raises OSError."""
        assert self._file is not None
        parts: Parts = []
        at = slot.begin
        for length in slot.lengths:
            part = os.pread(self._file.fileno(), length, at)
            if len(part) != length:
                raise OSError(f"{length - len(part)} bytes of a temporary file are missing")
            parts.append(part)
            at += length
        return parts

    def release(self, slot: Slot) -> None:
        """Give a value's space back."""
        self._used.remove(slot)
        self.nbytes -= sum(slot.lengths)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _gap(self, size: int) -> int:
        """First byte of the first free space that is large enough."""
        at = 0
        for slot in self._used:
            if slot.begin - at >= size:
                break
            at = slot.end
        return at
