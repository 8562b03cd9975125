"""The clocks of live sensors, mapped onto one time that stays continuous even when a clock is set."""

from collections import deque
from dataclasses import dataclass, field

JUMP_NS = 500_000_000
"""If a stamp steps back by this much, or runs ahead of its arrival by this much, the clock was set."""
_WINDOW_NS = 10_000_000_000
_SLEW = 1e-3
"""Largest change of the shift per host time; clocks drift a hundred times more slowly."""


@dataclass(slots=True)
class ClockMap:
    """Maps one sensor's stamps onto the time that the engine gets.

    Attributes:
        host: map onto the host's clock (for sensors that have no date, or drift), not onto the sensor's own clock.
        shift_ns: added to stamps at present. jump_ns: by how much the clock was last set, and jumped_at_ns:
            when, by the host's clock.
    """

    host: bool = False
    shift_ns: int = 0
    jump_ns: int = 0
    jumped_at_ns: int = 0
    _last: tuple[int, int] | None = None
    _delays: deque[tuple[int, int]] = field(default_factory=deque)
    _started_ns: int = 0

    def jumps(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Whether the clock was set since the last stamp; a late or silent sensor does not count."""
        if self._last is None:
            return False
        stamp, arrival = stamp_ns - self._last[0], arrival_ns - self._last[1]
        return stamp < -JUMP_NS or (stamp > JUMP_NS and stamp - arrival > JUMP_NS)

    def map(self, stamp_ns: int, arrival_ns: int, other: "ClockMap | None" = None) -> int:
        """The stamp in the engine's time, in which jumps are removed.

        Args:
            other: the map of another sensor; if its clock jumped at the same time by as much, they share a clock.
        """
        if self._last is not None and self.jumps(stamp_ns, arrival_ns):
            jump = stamp_ns - self._last[0] - max(arrival_ns - self._last[1], 0)
            if other is not None and abs(other.jump_ns - jump) < 150_000_000 and other.jumped_at_ns:
                near = abs(arrival_ns - other.jumped_at_ns) < 5_000_000_000
                jump = other.jump_ns if near else jump
            self.jump_ns, self.jumped_at_ns = jump, arrival_ns
            self.shift_ns -= jump
            self._delays.clear()
        self._last = (stamp_ns, arrival_ns)
        if self.host:
            self._follow(stamp_ns, arrival_ns)
        return stamp_ns + self.shift_ns

    def _follow(self, stamp_ns: int, arrival_ns: int) -> None:
        """Follow the host's clock by the smallest delay of the last seconds, which is due to transport alone."""
        delay = arrival_ns - stamp_ns
        delays = self._delays
        if not delays:
            self._started_ns = arrival_ns
            if not self.jumped_at_ns:
                self.shift_ns = delay
        elapsed = arrival_ns - delays[-1][0] if delays else 0
        while delays and delays[-1][1] >= delay:
            delays.pop()
        delays.append((arrival_ns, delay))
        while delays[0][0] < arrival_ns - _WINDOW_NS:
            delays.popleft()
        step = delays[0][1] - self.shift_ns
        if arrival_ns - self._started_ns > 1_000_000_000 or self.jumped_at_ns:
            limit = round(_SLEW * max(elapsed, 0))
            step = max(-limit, min(limit, step))
        self.shift_ns += step


@dataclass(slots=True)
class OffsetEstimate:
    """How far the IMU's stamps lag behind the LiDAR's, estimated from data that arrived at the same moment.

    The estimate does not depend on the speed at which a recording is played. Its error is the drivers' delays.
    """

    _imu: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=2_000))
    _lags: deque[int] = field(default_factory=lambda: deque(maxlen=50))

    def add_imu(self, stamp_ns: int, arrival_ns: int) -> None:
        self._imu.append((arrival_ns, stamp_ns))

    def add_scan(self, end_ns: int, arrival_ns: int) -> None:
        for arrived, stamp in reversed(self._imu):
            if arrived <= arrival_ns:
                if arrival_ns - arrived < JUMP_NS:
                    self._lags.append(end_ns - stamp)
                return

    def clear(self) -> None:
        self._imu.clear()
        self._lags.clear()

    def seconds(self) -> float | None:
        """Median over the last scans; None before the third."""
        if len(self._lags) < 3:
            return None
        return sorted(self._lags)[len(self._lags) // 2] / 1e9
