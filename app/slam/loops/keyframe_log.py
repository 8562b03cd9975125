"""The keyframes of a session as loop back ends follow them, with a cursor (version, length)."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from app.slam.keyframes import KeyframeStore
from app.slam.loops.messages import AddKeyframe, Target
from app.slam.sections import LoopsParams
from app.slam.types import I64, Keyframe


@dataclass(frozen=True, slots=True)
class Entry:
    """The frame of a keyframe, its stamp, and the parameters to look for loops with."""

    frame: int
    stamp_ns: int
    params: LoopsParams


class KeyframeLog:
    """All keyframes in order, including those beyond the present frame after going back.

    Args:
        store: holds them with their clouds.

    Attributes:
        stored: how many were in the store before this log, from an engine whose session goes on here.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self._store, self.stored = store, 0
        self._entries: list[Entry] = []
        self._cuts: list[int] = []  # the length after each truncation

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def count(self) -> int:
        """Keyframes up to the present frame."""
        return min(len(self._store), len(self))

    @property
    def version(self) -> int:
        return len(self._cuts)

    def keep(self, version: int, length: int) -> int:
        """How many of the first `length` keyframes of an older version are still the same."""
        return min(length, len(self), *self._cuts[version:])

    def holds(self, keyframe: Keyframe) -> bool:
        """Whether the keyframe of this index was the same frame."""
        return keyframe.index < len(self) and self._entries[keyframe.index].frame == keyframe.frame

    def until(self, frame: int) -> int:
        """How many are at this frame or before."""
        return bisect_right(self._entries, frame, key=lambda entry: entry.frame)

    def stamps_ns(self, count: int) -> I64:
        """(count,) of the first ones."""
        return np.array([entry.stamp_ns for entry in self._entries[:count]], np.int64)

    def append(self, frame: int, stamp_ns: int, params: LoopsParams) -> None:
        self._entries.append(Entry(frame, stamp_ns, params))

    def truncate(self, count: int) -> None:
        """Keep the first `count`, or all if there are fewer."""
        if count < len(self):
            del self._entries[count:]
            self._cuts.append(count)

    def take_stored(self, params: LoopsParams) -> None:
        """Add what the store holds and this log does not: keyframes of an engine whose session this one continues."""
        for index in range(len(self), len(self._store)):
            self.append(*self._store.when(index), params)
            self.stored = len(self)

    def request(self, index: int, target: Target) -> AddKeyframe:
        return AddKeyframe(self._store[index], self._entries[index].params, target.edits)


class Follower:
    """Sends one back end the keyframes of a log that it lacks. A new back end lacks all.

    Attributes:
        length: keyframes of the log that the back end has been sent.
    """

    def __init__(self, log: KeyframeLog) -> None:
        self._log, self._version, self.length = log, 0, 0

    def lacking(self, target: Target) -> int:
        """How many keyframes the back end lacks for this target."""
        self.length, self._version = self._log.keep(self._version, self.length), self._log.version
        return max(0, min(target.count, self._log.count) - self.length)

    def next(self, target: Target) -> AddKeyframe | None:
        """The next keyframe that it lacks for this target; it counts as sent."""
        if not self.lacking(target):
            return None
        self.length += 1
        return self._log.request(self.length - 1, target)
