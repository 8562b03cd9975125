"""What is remembered of the keyframes of a walk, those included that were gone back over."""

import numpy as np

from app.slam.loops.messages import LoopState
from app.slam.params import LoopsParams
from app.slam.rows import Rows
from app.slam.types import I64, Keyframe

STATES_BYTES = 128 << 20
"""Of corrections; a walk of a thousand keyframes has 64 MB of them."""


class KnownKeyframes:
    """In their order: which frames they were, with which parameters loops were looked for, what was found.

    Attributes:
        states: by number of keyframes, so that going back waits for nobody: to solve the graph of a thousand
            keyframes anew takes a second.
        states_bytes: of corrections in them, at most; beyond it the first go.
    """

    def __init__(self) -> None:
        self.states: dict[int, LoopState] = {}
        self.states_bytes = STATES_BYTES
        self._nbytes = 0
        self._frames = Rows((), np.int64)
        self._stamps = Rows((), np.int64)
        self._params: list[LoopsParams] = []

    def __len__(self) -> int:
        return len(self._frames)

    def holds(self, index: int, frame: int) -> bool:
        """Whether the keyframe of this index is known and was this frame."""
        return index < len(self) and int(self._frames.view()[index]) == frame

    def until(self, frame: int) -> int:
        """How many are at this frame or before."""
        return int(np.searchsorted(self._frames.view(), frame, side="right"))

    def stamps_ns(self, count: int) -> I64:
        """(count,) of the first ones, read-only; they stay as they are."""
        return self._stamps.view()[:count]

    def params(self, index: int) -> LoopsParams:
        return self._params[index]

    def put(self, keyframe: Keyframe, params: LoopsParams) -> None:
        """In place of the one of its index and of all after it."""
        self.forget(keyframe.index)
        self._frames.append(keyframe.frame)
        self._stamps.append(keyframe.stamp_ns)
        self._params.append(params)

    def forget(self, count: int) -> None:
        """All but the first `count`."""
        if count >= len(self):
            return
        self._frames.truncate(count)
        self._stamps.truncate(count)
        del self._params[count:]
        self._keep({known: state for known, state in self.states.items() if known <= count})

    def remember(self, count: int, state: LoopState) -> None:
        """The state after so many of them."""
        if (before := self.states.pop(count, None)) is not None:
            self._nbytes -= before.corrections.nbytes
        self.states[count] = state
        self._nbytes += state.corrections.nbytes
        while self._nbytes > self.states_bytes:
            self._nbytes -= self.states.pop(next(iter(self.states))).corrections.nbytes

    def forget_states(self) -> None:
        """They are of other commands."""
        self._keep({})

    def _keep(self, states: dict[int, LoopState]) -> None:
        self.states, self._nbytes = states, sum(state.corrections.nbytes for state in states.values())
