"""The keyframes of a session as loop back ends follow them, with a cursor (version, length)."""

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from app.slam.keyframes import KeyframeStore
from app.slam.log import Cursor, Log
from app.slam.loops.messages import AddKeyframe, Target
from app.slam.sections import LoopsParams
from app.slam.types import I64, Keyframe


@dataclass(frozen=True, slots=True)
class KeyframeEntry:
    """The frame of a keyframe, its stamp, the parameters to look for loops with, and its `resumed_ns`."""

    frame: int
    stamp_ns: int
    params: LoopsParams
    resumed_ns: int = 0


class KeyframeLog(Log[KeyframeEntry]):
    """All keyframes in order, including those beyond the present frame after going back.

    Attributes:
        store: holds them with their clouds.
        stored: how many were in the store before this log, from an engine whose session goes on here.
    """

    def __init__(self, store: KeyframeStore) -> None:
        super().__init__()
        self.store, self.stored = store, 0

    @property
    def count(self) -> int:
        """Keyframes up to the present frame."""
        return min(len(self.store), len(self))

    def holds(self, keyframe: Keyframe) -> bool:
        """Whether the keyframe at this index is the same frame."""
        return keyframe.index < len(self) and self[keyframe.index].frame == keyframe.frame

    def until(self, frame: int) -> int:
        """How many are at this frame or before."""
        return bisect_right(self, frame, key=lambda entry: entry.frame)

    def stamps_ns(self, count: int) -> I64:
        """(count,) of the first ones."""
        return np.array([entry.stamp_ns for entry in self[:count]], np.int64)

    def pauses_ns(self, count: int) -> I64:
        """(m,) when each pause among the first ones ended."""
        return np.array([entry.resumed_ns for entry in self[:count] if entry.resumed_ns], np.int64)

    def take_stored(self, params: LoopsParams) -> None:
        """Add what the store holds and this log does not: keyframes of an engine whose session this one continues."""
        for index in range(len(self), len(self.store)):
            frame, stamp_ns, resumed_ns = self.store.when(index)
            self.append(KeyframeEntry(frame, stamp_ns, params, resumed_ns))
            self.stored = len(self)


class Follower:
    """Sends one back end the keyframes of a log that it does not have yet; a new back end has none."""

    def __init__(self, log: KeyframeLog) -> None:
        self._log, self._cursor = log, Cursor()

    @property
    def length(self) -> int:
        """Keyframes of the log that the back end has been sent."""
        return self._cursor.length

    def next(self, target: Target) -> AddKeyframe | None:
        """The next keyframe that it lacks for this target; it counts as sent."""
        index, log = self._log.keep(self._cursor), self._log
        if index >= min(target.count, log.count):
            self._cursor = replace(log.cursor, length=index)
            return None
        self._cursor = replace(log.cursor, length=index + 1)
        return AddKeyframe(log.store[index], log[index].params)
