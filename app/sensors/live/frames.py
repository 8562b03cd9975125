"""Revolutions from packets, which a network may lose, repeat or reorder.

Packets are put in order of their own time and split by azimuth. A revolution is given out once a few packets of the
next one are there, so that a late packet still finds its place.
"""

import bisect
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from app.sensors.live.msop import BLOCKS, MSOP_ID, PACKET_BYTES, TURN, azimuths_of, index_of, model_of, stamp_of
from app.sensors.live.status import Counters
from app.sensors.rsbpearl import Model
from app.slam.types import I64, U8

HOLD = 3
"""Packets of the next revolution to wait for, 2 ms: networks seldom reorder more widely."""
JUMP_NS = 500_000_000
"""A packet this far from the one before means another time, not disorder; the next packet must confirm it."""
MAX_PACKETS = 1024
"""In a revolution; twice what two returns at 10 Hz need. A longer one is cut here."""

Pending = tuple[int, int, bytes]
"""Time of the first block, arrival, packet."""


@dataclass(frozen=True, slots=True)
class Revolution:
    """The packets of one revolution, in order of time.

    Attributes:
        packets: (n, 1248). stamps_ns: (n,) of each packet's first block.
        first, stop: the revolution begins with this block of the first packet and ends before this
            block of the last. arrival_ns: when its last packet came, by the host's clock.
    """

    model: Model
    packets: U8
    stamps_ns: I64
    first: int
    stop: int
    arrival_ns: int


class Assembler:
    """Takes packets as they arrive, and gives revolutions.

    Attributes:
        counters: of what happened. turn_ns: duration of a revolution, as the device states it.
    """

    def __init__(self, counters: Counters | None = None) -> None:
        self.counters = counters if counters is not None else Counters()
        self.turn_ns = 100_000_000
        self._pending: list[Pending] = []
        self._model: Model | None = None
        self._first = 0
        self._checked = 0
        self._given_ns: int | None = None
        self._suspect: Pending | None = None
        self._sense = 0
        self._index: int | None = None

    def add(self, packet: bytes, arrival_ns: int) -> list[Revolution]:
        """Revolutions that this packet completes, mostly none. arrival_ns: by the host's clock."""
        if not self._is_msop(packet):
            return []
        model = model_of(packet)
        stamp = stamp_of(packet)
        if stamp is None:
            self.counters.undated += 1
            stamp = arrival_ns
        entry = (stamp, arrival_ns, packet)
        newest = self._pending[-1][0] if self._pending else self._given_ns
        frames: list[Revolution] = []
        if newest is not None and (abs(stamp - newest) > JUMP_NS or model is not self._model):
            suspect, self._suspect = self._suspect, entry
            if suspect is None or abs(stamp - suspect[0]) > JUMP_NS or model is not model_of(suspect[2]):
                self.counters.strays += suspect is not None
                return []
            frames = list(self.flush())  # it is another time now
            self._given_ns, self._index = None, None
            self._model = model
            self._insert(suspect)
        elif self._suspect is not None:
            self.counters.strays += 1
        self._suspect = None
        self._model = model
        self._insert(entry)
        while len(self._pending) - HOLD > self._checked:
            frames += self._check()
        return frames

    def flush(self) -> Iterator[Revolution]:
        """The revolutions so far, complete or not: the input is over, or silent."""
        while self._checked < len(self._pending):
            yield from self._check()
        if self._pending:
            yield self._take(len(self._pending), BLOCKS)
            self._pending, self._first, self._checked = [], 0, 0

    def pending_since(self) -> int | None:
        """When the newest waiting packet arrived, by the host's clock; None if no packet waits."""
        return self._pending[-1][1] if self._pending else None

    def _is_msop(self, packet: bytes) -> bool:
        if len(packet) == PACKET_BYTES and packet[:8] == MSOP_ID:
            return True
        if packet[:8] == MSOP_ID:
            self.counters.truncated += 1
        else:
            self.counters.foreign += 1
        return False

    def _insert(self, entry: Pending) -> None:
        stamp, _, packet = entry
        pending = self._pending
        if self._given_ns is not None and stamp <= self._given_ns:
            self.counters.late += 1
            return
        if not pending or stamp > pending[-1][0]:
            pending.append(entry)
        else:
            at = bisect.bisect_left(pending, stamp, key=lambda other: other[0])
            if pending[at][0] == stamp:
                self.counters.duplicates += 1
                return
            if at == 0 and self._given_ns is not None:  # before the packet in which the revolution begins
                self.counters.late += 1
                return
            self.counters.reordered += 1
            pending.insert(at, entry)
            self._checked = min(self._checked, at)
        self.counters.packets += 1
        self._count_lost(index_of(packet))

    def _count_lost(self, index: int) -> None:
        """Count by the packets' numbers; one that arrives late after all no longer counts."""
        if self._index is None or not 0 < abs(index - self._index) < 100_000:
            self._index = index
        elif index > self._index:
            self.counters.lost += index - self._index - 1
            self._index = index
        else:
            self.counters.lost = max(self.counters.lost - 1, 0)

    def _check(self) -> list[Revolution]:
        """Look for the end of a revolution in the next packet."""
        at = self._checked
        self._checked += 1
        stamp, _, packet = self._pending[at]
        begin = self._first if at == 0 else 0
        azimuth = azimuths_of(packet)
        moved = (azimuth[-1] - azimuth[begin] + TURN // 2) % TURN - TURN // 2
        if moved:
            self._sense = max(-8, min(8, self._sense + (1 if moved > 0 else -1)))
        sense = 1 if self._sense >= 0 else -1
        if at and (stamp - self._pending[at - 1][0] > 0.97 * self.turn_ns or at >= MAX_PACKETS):
            return [self._split(at, 0)]
        before = azimuths_of(self._pending[at - 1][2])[-1] if at else azimuth[begin]
        for block in range(begin, BLOCKS):
            if (azimuth[block] - before) * sense < 0:
                return [self._split(at, block)]
            before = azimuth[block]
        return []

    def _split(self, at: int, block: int) -> Revolution:
        """End the revolution before this block of the packet `at`; the next one begins there."""
        frame = self._take(at + 1, block) if block else self._take(at, BLOCKS)
        self._pending = self._pending[at:]
        self._first = block
        self._checked = 0
        return frame

    def _take(self, packets: int, stop: int) -> Revolution:
        taken = self._pending[:packets]
        assert self._model is not None
        self.counters.frames += 1
        self._given_ns = taken[-1][0] if stop == BLOCKS else taken[-2][0] if len(taken) > 1 else self._given_ns
        data = np.frombuffer(b"".join(packet for _, _, packet in taken), np.uint8)
        return Revolution(
            model=self._model,
            packets=data.reshape(len(taken), PACKET_BYTES),
            stamps_ns=np.array([stamp for stamp, _, _ in taken], np.int64),
            first=self._first,
            stop=stop,
            arrival_ns=max(arrival for _, arrival, _ in taken),
        )
