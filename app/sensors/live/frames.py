"""Revolutions from packets, which a network may lose, repeat or reorder.

Packets are put in order of their own time and split by azimuth. A revolution is given out once a few packets of the
next one are there, so that a late packet still finds its place.
"""

import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from app.sensors.live import msop
from app.sensors.live.livox_udp import MID360, SCAN_NS, Livox, read_header
from app.sensors.live.msop import TURN
from app.sensors.live.status import Counters
from app.sensors.robosense import Model
from app.slam.types import I64, U8

HOLD = 3
"""Number of packets of the next revolution to wait for, 2 ms: networks seldom reorder over longer times."""
JUMP_NS = 500_000_000
"""A packet this far in time from the previous one means that the time was set; the next packet must confirm it."""
MAX_PACKETS = 1024
"""Most packets of a revolution; twice the number for two returns at 10 Hz. A longer revolution is cut here."""

_LATE = 64
"""If a packet's number is this far back, the count has begun anew."""


class _Packet(NamedTuple):
    """A measurement packet.

    Attributes:
        stamp_ns: time of the first block; of a packet without a date, its arrival. arrival_ns: by the host's clock.
        number: which the sensor gave it. azimuths: of each block, 0.01 deg; if the sensor does not turn, by time, as if
            one scan were a turn.
    """

    stamp_ns: int
    arrival_ns: int
    data: bytes
    sensor: Model | Livox
    number: int
    azimuths: tuple[int, ...]


def sensor_of(packet: bytes) -> Model | Livox | None:
    """The sensor that sent this measurement packet; None if it holds no measurements."""
    if (model := msop.model_of(packet)) is not None:
        return model
    header = read_header(packet)
    return MID360 if header is not None and not header.of_imu else None


@dataclass(frozen=True, slots=True)
class Revolution:
    """The packets of one revolution, in order of time.

    Attributes:
        packets: (n, bytes of the longest), padded. stamps_ns: (n,) of each packet's first block.
        first, stop: the revolution begins with this block of the first packet and ends before this
            block of the last. arrival_ns: when its last packet came, by the host's clock.
    """

    model: Model | Livox
    packets: U8
    stamps_ns: I64
    first: int
    stop: int
    arrival_ns: int


class Assembler:
    """Takes packets as they arrive, and gives revolutions.

    Attributes:
        counters: of what happened. turn_ns: duration of a revolution, as the device states it.

    Args:
        models: whose packets are used; (): of every sensor.
    """

    def __init__(self, counters: Counters | None = None, models: tuple[Model | Livox, ...] = ()) -> None:
        self.counters = counters if counters is not None else Counters()
        self.turn_ns = 100_000_000
        self._models = models
        self._pending: list[_Packet] = []
        self._model: Model | Livox | None = None
        self._first = 0
        self._checked = 0
        self._given_ns: int | None = None
        self._suspect: _Packet | None = None
        self._sense = 0
        self._number: int | None = None

    def add(self, packet: bytes, arrival_ns: int) -> list[Revolution]:
        """Revolutions that this packet completes, mostly none. arrival_ns: by the host's clock."""
        sensor = sensor_of(packet)
        if sensor is None or (self._models and sensor not in self._models):
            if msop.is_cut(packet):
                self.counters.truncated += 1
            else:
                self.counters.foreign += 1
            return []
        entry = self._read(packet, sensor, arrival_ns)
        newest_ns = self._pending[-1].stamp_ns if self._pending else self._given_ns
        frames: list[Revolution] = []
        if newest_ns is not None and (abs(entry.stamp_ns - newest_ns) > JUMP_NS or sensor is not self._model):
            suspect, self._suspect = self._suspect, entry
            if suspect is None or abs(entry.stamp_ns - suspect.stamp_ns) > JUMP_NS or sensor is not suspect.sensor:
                self.counters.strays += suspect is not None
                return []
            frames = list(self.flush())  # it is another time now
            self._given_ns, self._number = None, None
            self._insert(suspect)
        elif self._suspect is not None:
            self.counters.strays += 1
        self._suspect = None
        self._model = sensor
        self._insert(entry)
        while len(self._pending) - HOLD > self._checked:
            frames += self._check()
        return frames

    def flush(self) -> Iterator[Revolution]:
        """The revolutions so far, complete or not, as the input has ended or is silent."""
        while self._checked < len(self._pending):
            yield from self._check()
        if self._pending:
            yield self._take(len(self._pending), None)
            self._pending, self._first, self._checked = [], 0, 0

    def pending_since(self) -> int | None:
        """When the newest waiting packet arrived, by the host's clock; None if no packet waits."""
        return self._pending[-1].arrival_ns if self._pending else None

    def _read(self, data: bytes, sensor: Model | Livox, arrival_ns: int) -> _Packet:
        """A packet of this sensor."""
        if isinstance(sensor, Livox):
            header = read_header(data)
            assert header is not None
            turned = header.stamp_ns % SCAN_NS * TURN // SCAN_NS
            return _Packet(header.stamp_ns, arrival_ns, data, sensor, header.number, (turned,))
        stamp_ns = msop.stamp_of(data, sensor)
        if stamp_ns is None:
            self.counters.undated += 1
            stamp_ns = arrival_ns
        number, azimuths = msop.index_of(data, sensor), msop.azimuths_of(data, sensor)
        return _Packet(stamp_ns, arrival_ns, data, sensor, number, azimuths)

    def _insert(self, entry: _Packet) -> None:
        stamp, pending = entry.stamp_ns, self._pending
        if self._given_ns is not None and stamp <= self._given_ns:
            self.counters.late += 1
            return
        if not pending or stamp > pending[-1].stamp_ns:
            pending.append(entry)
        else:
            at = bisect.bisect_left(pending, stamp, key=attrgetter("stamp_ns"))
            if pending[at].stamp_ns == stamp:
                self.counters.duplicates += 1
                return
            if at == 0 and self._given_ns is not None:  # before the packet in which the revolution begins
                self.counters.late += 1
                return
            self.counters.reordered += 1
            pending.insert(at, entry)
            self._checked = min(self._checked, at)
        self.counters.packets += 1
        self._count_lost(entry.number)

    def _count_lost(self, number: int) -> None:
        """Count lost packets by their numbers; a packet that arrives late is no longer counted as lost."""
        ahead = 0 if self._number is None else (number - self._number + (1 << 15)) % (1 << 16) - (1 << 15)
        if -_LATE < ahead < 0:
            self.counters.lost = max(self.counters.lost - 1, 0)
            return
        self.counters.lost += max(ahead - 1, 0)
        self._number = number

    def _check(self) -> list[Revolution]:
        """Look for the end of a revolution in the next packet."""
        at = self._checked
        self._checked += 1
        stamp, azimuth = self._pending[at].stamp_ns, self._pending[at].azimuths
        begin = self._first if at == 0 else 0
        moved = (azimuth[-1] - azimuth[begin] + TURN // 2) % TURN - TURN // 2
        if moved:
            self._sense = max(-8, min(8, self._sense + (1 if moved > 0 else -1)))
        sense = 1 if self._sense >= 0 else -1
        if at and (stamp - self._pending[at - 1].stamp_ns > 0.97 * self.turn_ns or at >= MAX_PACKETS):
            return [self._split(at, 0)]
        before = self._pending[at - 1].azimuths[-1] if at else azimuth[begin]
        for block in range(begin, len(azimuth)):
            if (azimuth[block] - before) * sense < 0:
                return [self._split(at, block)]
            before = azimuth[block]
        return []

    def _split(self, at: int, block: int) -> Revolution:
        """End the revolution before this block of the packet `at`; the next one begins there."""
        frame = self._take(at + 1, block) if block else self._take(at, None)
        self._pending = self._pending[at:]
        self._first = block
        self._checked = 0
        return frame

    def _take(self, packets: int, stop: int | None) -> Revolution:
        """stop: block of the last packet at which the revolution ends; None: with that packet."""
        taken = self._pending[:packets]
        assert self._model is not None
        self.counters.frames += 1
        whole = taken if stop is None else taken[:-1]
        self._given_ns = whole[-1].stamp_ns if whole else self._given_ns
        longest = max(len(packet.data) for packet in taken)
        data = np.frombuffer(b"".join(packet.data.ljust(longest, b"\0") for packet in taken), np.uint8)
        return Revolution(
            model=self._model,
            packets=data.reshape(len(taken), longest),
            stamps_ns=np.array([packet.stamp_ns for packet in taken], np.int64),
            first=self._first,
            stop=self._model.blocks if stop is None else stop,
            arrival_ns=max(packet.arrival_ns for packet in taken),
        )
