"""States of a session to go back to: dense near the present, sparse far from it, within a memory budget.

Which ones are kept follows from frame numbers and sizes alone, never from the clock.
"""

import logging
import pickle
from dataclasses import dataclass
from typing import Any

from app.mapping.spill import Slot, Spill

log = logging.getLogger(__name__)

DEFAULT_BYTES = 1 << 30
EVERY = 10
"""Frames between two checkpoints while a session goes on. One takes a tenth to a half of a frame's time."""
NEAR = 24
"""Each of so many frames before a sought one gets a checkpoint, so that stepping back is immediate."""
SPACING = ((NEAR, 1), (8_000, EVERY), (25_600, 2 * EVERY))
"""(distance from the present, frames between checkpoints up to there)."""
FARTHEST = 4 * EVERY
DISK_SHARE = 4
"""Disk space that checkpoints may take, in multiples of the memory budget; beyond it they become sparser."""
START = -1


@dataclass(slots=True)
class _Entry:
    """A pickled state, in memory or on disk."""

    value: bytes | None
    slot: Slot | None = None


class Checkpoints:
    """States by the frame they were taken after. The one of the start, frame -1, is always kept.

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
        """Whether to take one now, after this frame. near: the frame is just before a sought one."""
        return frame not in self._entries and (near or frame == START or frame % EVERY == 0)

    def add(self, frame: int, state: object) -> None:
        """Keep a state. Others may be moved to disk or dropped."""
        value = pickle.dumps(state, protocol=5)
        self._entries[frame] = _Entry(value)
        self.memory += len(value)
        self._thin(frame)
        self._fit(frame)

    def before(self, frame: int) -> int | None:
        """The last frame before this one that has a state."""
        return max((other for other in self._entries if other < frame), default=None)

    def get(self, frame: int) -> Any:
        """The state after a frame of `frames`. Raises OSError if it is on a disk that fails."""
        entry = self._entries[frame]
        if entry.value is not None:
            return pickle.loads(entry.value)
        assert entry.slot is not None
        return pickle.loads(self._spill.get(entry.slot))

    def forget_after(self, frame: int) -> None:
        """Drop the states of all later frames."""
        for other in [other for other in self._entries if other > frame]:
            self._drop(other)

    def close(self) -> None:
        """Release memory and disk space."""
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
        """Drop those between the regular ones first, then move the farthest to disk."""
        if self.memory > self._budget:
            held = [frame for frame, entry in self._entries.items() if entry.value is not None]
            held.sort(key=lambda frame: (frame % EVERY != 0 and frame != START, abs(present - frame)))
            while self.memory > self._budget and held:
                frame = held.pop()
                if frame % EVERY and frame != START:
                    self._drop(frame)
                else:
                    self._move_to_disk(frame)
        while self.disk > DISK_SHARE * self._budget and len(self._entries) > 1:
            self._coarseness *= 2
            self._thin(present)
            if self._coarseness > max(self._entries, default=0):  # only the newest is left
                self.forget_after(START)

    def _move_to_disk(self, frame: int) -> None:
        entry = self._entries[frame]
        assert entry.value is not None
        try:
            entry.slot = self._spill.put(entry.value)
        except OSError as error:
            if frame == START:
                return
            log.warning("The checkpoint of frame %d cannot be written to disk (%s) and is dropped", frame, error)
            self._drop(frame)
            return
        self.memory -= len(entry.value)
        entry.value = None

    def _drop(self, frame: int) -> None:
        entry = self._entries.pop(frame)
        if entry.value is not None:
            self.memory -= len(entry.value)
        if entry.slot is not None:
            self._spill.release(entry.slot)
