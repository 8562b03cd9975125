"""Values put aside on disk, so that memory does not grow with them."""

import bisect
import os
import tempfile
from dataclasses import dataclass
from typing import IO


@dataclass(frozen=True, slots=True, order=True)
class Slot:
    """Where a value is in the file: its first byte and its length."""

    begin: int
    length: int

    @property
    def end(self) -> int:
        return self.begin + self.length


class Spill:
    """An unnamed temporary file of values. Released space is used again."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None
        self._used: list[Slot] = []
        self.nbytes = 0

    def put(self, value: bytes) -> Slot:
        """Write a value. Raises OSError, and changes nothing, if the disk does not take it."""
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="hemislam-spill-", buffering=0)  # noqa: SIM115 - see close
        slot = Slot(self._gap(len(value)), len(value))
        self._file.seek(slot.begin)
        rest = memoryview(value)
        while rest:
            rest = rest[self._file.write(rest) :]
        bisect.insort(self._used, slot)
        self.nbytes += slot.length
        return slot

    def get(self, slot: Slot) -> bytes:
        """Read a value. Raises OSError."""
        assert self._file is not None
        value = os.pread(self._file.fileno(), slot.length, slot.begin)
        if len(value) != slot.length:
            raise OSError(f"{slot.length - len(value)} bytes of a temporary file are missing")
        return value

    def release(self, slot: Slot) -> None:
        """Release the space of a value."""
        self._used.remove(slot)
        self.nbytes -= slot.length

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
