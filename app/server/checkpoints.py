"""States of a run to go back to: dense near the present, sparse far from it, within a budget of memory.

Which ones are kept follows from frame numbers and sizes alone, never from the clock.
"""

import logging
from dataclasses import dataclass

from app.packing import Parts, pack, unpack
from app.server.spill import Slot, Spill

log = logging.getLogger(__name__)

DEFAULT_BYTES = 1 << 30
EVERY = 10
"""Frames between two checkpoints while a run goes on. One takes a tenth to a half of a frame's time."""
NEAR = 24
"""Frames before a sought one after each of which there is a checkpoint, so that stepping back is at once."""
SPACING = ((NEAR, 1), (8_000, EVERY), (25_600, 2 * EVERY))
"""(distance from the present, frames between checkpoints up to there)."""
FARTHEST = 4 * EVERY
DISK_SHARE = 4
"""Times the memory's budget that may lie on disk; beyond it, checkpoints become sparser."""
START = -1


@dataclass(slots=True)
class _Entry:
    """A packed state: its parts in memory, or where they are on disk."""

    parts: Parts | None
    nbytes: int
    slot: Slot | None = None


class Checkpoints:
    """States by the frame they were taken after; that of the start, frame -1, is always kept.

    Args:
        budget: bytes in memory.
    """

    def __init__(self, budget: int = DEFAULT_BYTES) -> None:
        self._budget = budget
        self._entries: dict[int, _Entry] = {}
        self._spill = Spill()
        self._coarseness = 1
        self.memory = 0

    @property
    def frames(self) -> list[int]:
        return sorted(self._entries)

    @property
    def disk(self) -> int:
        """Bytes on disk."""
        return self._spill.nbytes

    def wanted(self, frame: int, *, near: bool = False) -> bool:
        """Whether to take one now, after this frame; `near`: it is just before a sought one."""
        return frame not in self._entries and (near or frame == START or frame % EVERY == 0)

    def add(self, frame: int, state: object) -> None:
        """Keep a state; what is in it must never change. Others may be put on disk or let go of."""
        parts = pack(state)
        self._entries[frame] = _Entry(parts, sum(memoryview(part).nbytes for part in parts))
        self.memory += self._entries[frame].nbytes
        self._thin(frame)
        self._fit(frame)

    def before(self, frame: int) -> int | None:
        """The last frame before this one that there is a state of."""
        return max((other for other in self._entries if other < frame), default=None)

    def get(self, frame: int) -> object:
        """The state after a frame of `frames`. Raises OSError if it is on a disk that fails."""
        entry = self._entries[frame]
        if entry.parts is not None:
            return unpack(entry.parts)
        assert entry.slot is not None
        return unpack(self._spill.get(entry.slot))

    def forget_after(self, frame: int) -> None:
        """Let go of all states of later frames."""
        for other in [other for other in self._entries if other > frame]:
            self._drop(other)

    def close(self) -> None:
        """Give memory and disk space back."""
        self._entries.clear()
        self.memory = 0
        self._spill.close()

    def _spacing(self, distance: int) -> int:
        spacing = next((spacing for limit, spacing in SPACING if distance <= limit), FARTHEST)
        return spacing if spacing == 1 else spacing * self._coarseness

    def _thin(self, present: int) -> None:
        for frame in self.frames:
            if frame != START and frame % self._spacing(abs(present - frame)):
                self._drop(frame)

    def _fit(self, present: int) -> None:
        """First those between the regular ones go, then the farthest go to disk."""
        if self.memory > self._budget:
            held = [frame for frame, entry in self._entries.items() if entry.parts is not None]
            held.sort(key=lambda frame: (frame % EVERY != 0 and frame != START, abs(present - frame)))
            while self.memory > self._budget and held:
                frame = held.pop()
                if frame % EVERY and frame != START:
                    self._drop(frame)
                else:
                    self._put_aside(frame)
        while self.disk > DISK_SHARE * self._budget and len(self._entries) > 1:
            self._coarseness *= 2
            self._thin(present)
            if self._coarseness > max(self._entries, default=0):  # nothing is left but the newest
                self.forget_after(START)

    def _put_aside(self, frame: int) -> None:
        entry = self._entries[frame]
        assert entry.parts is not None
        try:
            entry.slot = self._spill.put(entry.parts)
        except OSError as error:
            if frame == START:
                return
            log.warning("The checkpoint of frame %d can not be put on disk (%s) and is let go of", frame, error)
            self._drop(frame)
            return
        entry.parts = None
        self.memory -= entry.nbytes

    def _drop(self, frame: int) -> None:
        entry = self._entries.pop(frame)
        if entry.parts is not None:
            self.memory -= entry.nbytes
        if entry.slot is not None:
            self._spill.release(entry.slot)
