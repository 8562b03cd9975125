"""When the next frame is due: replay paced by the recording's own time."""

import math
from collections import deque
from collections.abc import Callable

LONGEST_LAG_S = 0.5
"""A replay that is later than this does not catch up; it goes on from where it is."""


class Pacer:
    """Maps stamps of the recording to the wall clock at a chosen speed.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._speed = 1.0
        self._anchor: tuple[float, int] | None = None
        self._processed: deque[float] = deque(maxlen=100)

    @property
    def speed(self) -> float:
        return self._speed

    @speed.setter
    def speed(self, factor: float) -> None:
        self._speed = factor
        self._anchor = None

    def release(self) -> None:
        """Forget the time kept so far: after a pause or a jump the next frame is due at once."""
        self._anchor = None

    def wait(self, stamp_ns: int) -> float:
        """Seconds until a frame of this stamp is due; 0 if it is."""
        now = self._clock()
        if math.isinf(self._speed):
            return 0.0
        if self._anchor is None:
            self._anchor = (now, stamp_ns)
        started, first_ns = self._anchor
        due = started + (stamp_ns - first_ns) * 1e-9 / self._speed
        if due < now - LONGEST_LAG_S:
            self._anchor = (now, stamp_ns)
        return max(0.0, due - now)

    def tick(self) -> float:
        """Count a processed frame; returns the frames per second over about the last second."""
        now = self._clock()
        self._processed.append(now)
        while len(self._processed) > 2 and self._processed[0] < now - 1.0:
            self._processed.popleft()
        elapsed = now - self._processed[0]
        return (len(self._processed) - 1) / elapsed if 0 < elapsed < 10 else 0.0
