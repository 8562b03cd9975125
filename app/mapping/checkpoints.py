"""States of a session to go back to: dense near the present frame, sparse far from it, within a budget of memory.

Which states are kept follows from frame numbers and sizes alone, never from the clock.
"""

import logging
import pickle
import sqlite3
from dataclasses import dataclass
from typing import Any

from app.slam.engine import EngineState
from app.slam.errors import HemislamError

log = logging.getLogger(__name__)

DEFAULT_BYTES = 1 << 30
EVERY = 10
"""Frames between two checkpoints. Taking one costs a tenth to a half of a frame's time."""
NEAR = 24
"""Each of this many frames before the target of a seek gets a checkpoint, so that stepping back is immediate."""
DENSE = 16_000
"""Up to this many frames from the present, checkpoints are `EVERY` frames apart; at twice the distance, twice that."""
DISK_SHARE = 4
"""Disk space for checkpoints, in multiples of the memory; beyond it they become sparser."""
START = -1


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The state of a session after a frame, without the frames themselves. place: its place in the feed."""

    frame: int
    engine: EngineState
    place: Any


class Checkpoints:
    """States by the frame after which they were taken, in an unnamed temporary database. That of -1 is always kept.

    Args:
        budget: bytes in memory; the rest is on disk.
    """

    def __init__(self, budget: int = DEFAULT_BYTES) -> None:
        self._most = DISK_SHARE * budget
        self._dense = DENSE
        self._sizes: dict[int, int] = {}
        self._states = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        self._states.executescript(
            f"PRAGMA page_size = 65536; PRAGMA cache_size = {-(budget >> 10)}; PRAGMA journal_mode = MEMORY;"
            "PRAGMA synchronous = OFF; CREATE TABLE states (frame INTEGER PRIMARY KEY, state BLOB)"
        )

    @property
    def frames(self) -> list[int]:
        return sorted(self._sizes)

    @property
    def nbytes(self) -> int:
        """Bytes in memory and on disk."""
        return sum(self._sizes.values())

    def wanted(self, frame: int, *, near: bool = False) -> bool:
        """Whether to take a checkpoint after this frame. near: the frame is just before the target of a seek."""
        return frame not in self._sizes and (near or frame == START or frame % EVERY == 0)

    def add(self, frame: int, state: object) -> None:
        """Keep a state. Others may be dropped; if the disk is full, this one is."""
        value = pickle.dumps(state, protocol=5)
        try:
            self._states.execute("REPLACE INTO states VALUES (?, ?)", (frame, value))
        except sqlite3.Error as error:
            log.warning("The checkpoint of frame %d cannot be kept: %s", frame, error)
            return
        self._sizes[frame] = len(value)
        self._thin(frame)
        while self.nbytes > self._most and self._dense > 1:
            self._dense //= 2
            self._thin(frame)

    def before(self, frame: int) -> int | None:
        """The last frame before this one that has a state."""
        return max((other for other in self._sizes if other < frame), default=None)

    def get(self, frame: int) -> Any:
        """The state after a frame of `frames`. Raises HemislamError: it cannot be read."""
        try:
            ((value,),) = self._states.execute("SELECT state FROM states WHERE frame = ?", (frame,))
        except sqlite3.Error as error:
            raise HemislamError(f"A checkpoint cannot be read: {error}.") from error
        return pickle.loads(value)

    def drop(self, frames: list[int]) -> None:
        """Drop the states of these frames."""
        self._states.executemany("DELETE FROM states WHERE frame = ?", [(frame,) for frame in frames])
        for frame in frames:
            del self._sizes[frame]

    def close(self) -> None:
        """Release memory and disk space."""
        self._states.close()

    def _thin(self, present: int) -> None:
        self.drop([frame for frame in self.frames if frame != START and frame % self._spacing(abs(present - frame))])

    def _spacing(self, distance: int) -> int:
        """Frames between two checkpoints at a distance from the present."""
        return 1 if distance <= NEAR else EVERY << (distance // self._dense).bit_length()
