"""What is remembered of the keyframes of a walk, those included that were gone back over."""

from bisect import bisect_right

import numpy as np

from app.slam.loops.messages import LoopState
from app.slam.params import Loops
from app.slam.types import I64, Keyframe

STATES_KEPT = 64


class KnownKeyframes:
    """In their order: which frames they were, with which parameters loops were looked for, what was found.

    Attributes:
        states: the last ones, by number of keyframes, so that a step back waits for nobody.
        states_kept: most of them; each holds a pose for every keyframe.
    """

    def __init__(self) -> None:
        self.states: dict[int, LoopState] = {}
        self.states_kept = STATES_KEPT
        self._frames: list[int] = []
        self._stamps: list[int] = []
        self._params: list[Loops] = []

    def __len__(self) -> int:
        return len(self._frames)

    def holds(self, index: int, frame: int) -> bool:
        """Whether the keyframe of this index is known and was this frame."""
        return index < len(self) and self._frames[index] == frame

    def until(self, frame: int) -> int:
        """How many are at this frame or before."""
        return bisect_right(self._frames, frame)

    def stamps_ns(self, count: int) -> I64:
        """(count,) of the first ones."""
        return np.array(self._stamps[:count], dtype=np.int64)

    def params(self, index: int) -> Loops:
        return self._params[index]

    def put(self, keyframe: Keyframe, params: Loops) -> None:
        """In place of the one of its index and of all after it."""
        self.forget(keyframe.index)
        self._frames.append(keyframe.frame)
        self._stamps.append(keyframe.stamp_ns)
        self._params.append(params)

    def forget(self, count: int) -> None:
        """All but the first `count`."""
        del self._frames[count:], self._stamps[count:], self._params[count:]
        self.states = {known: state for known, state in self.states.items() if known <= count}

    def remember(self, count: int, state: LoopState) -> None:
        """The state after so many of them."""
        self.states[count] = state
        while len(self.states) > self.states_kept:
            del self.states[next(iter(self.states))]
