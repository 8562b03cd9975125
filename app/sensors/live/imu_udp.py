'''IMU samples as UDP datagrams: `imu-udp://:PORT`, for an IMU beside raw LiDAR packets.

A datagram holds one sample or several, each of 64 bytes, little-endian:

    offset  type    what
    0       4 s     "HIMU"
    4       u32     sequence number, one more with each sample, wrapping to 0
    8       i64     time of the measurement, ns since 1970
    16      3 f64   angular velocity x, y, z, rad/s, IMU frame
    40      3 f64   specific force x, y, z, m/s^2, IMU frame (+9.81 upwards at rest)

A sender, complete:

    import socket, struct, time

    def read_imu():
        """Replace me: rad/s and m/s^2."""
        return (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)

    peer = ("127.0.0.1", 6700)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    number = 0
    while True:
        gyro, accel = read_imu()
        sample = struct.pack("<4sIq6d", b"HIMU", number % 2**32, time.time_ns(), *gyro, *accel)
        sock.sendto(sample, peer)
        number += 1
        time.sleep(0.005)

Stamp each sample when it is measured, not when it is sent, and by the LiDAR's clock if you can.
'''

import struct
from dataclasses import dataclass, field

from app.sensors.live.status import Counters
from app.sensors.ros import Vector

IMU_PORT = 6700
IMU_MAGIC = b"HIMU"
_SAMPLE = struct.Struct("<4sIq6d")
SAMPLE_BYTES = _SAMPLE.size
_FAR_NS = 1 << 62
"""The year 2116; later times would overflow."""


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Attributes:
    number: of the datagram. stamp_ns: as sent. gyro: rad/s. accel: m/s^2, IMU frame.
    """

    number: int
    stamp_ns: int
    gyro: Vector
    accel: Vector


def write_imu(sample: ImuSample) -> bytes:
    return _SAMPLE.pack(IMU_MAGIC, sample.number & 0xFFFFFFFF, sample.stamp_ns, *sample.gyro, *sample.accel)


def read_imu(datagram: bytes) -> list[ImuSample]:
    """The samples of a datagram; none if it is of another kind."""
    if not datagram or len(datagram) % SAMPLE_BYTES:
        return []
    samples = []
    for magic, number, stamp, gx, gy, gz, ax, ay, az in _SAMPLE.iter_unpack(datagram):
        if magic != IMU_MAGIC or abs(stamp) >= _FAR_NS:
            return []
        samples.append(ImuSample(number, stamp, (gx, gy, gz), (ax, ay, az)))
    return samples


_HOLD = 4
"""Samples to wait for one that is missing: 20 ms at 200 Hz."""
_FAR = 1_000
"""Numbers this far apart are another run of the sender."""


@dataclass(slots=True)
class ImuOrder:
    """Puts samples back in order by their numbers; counts what is lost, late or repeated."""

    counters: Counters = field(default_factory=Counters)
    _next: int | None = None
    _ahead: dict[int, ImuSample] = field(default_factory=dict)

    def add(self, datagram: bytes) -> list[ImuSample]:
        """The samples that can go on, in order."""
        samples = read_imu(datagram)
        if not samples:
            self.counters.imu_foreign += 1
        return [ready for sample in samples for ready in self._one(sample)]

    def flush(self) -> list[ImuSample]:
        """The samples that wait for a missing one, which is given up."""
        ready = []
        while self._ahead:
            self._skip_missing()
            ready += self._take()
        return ready

    def _one(self, sample: ImuSample) -> list[ImuSample]:
        ready: list[ImuSample] = []
        ahead = 0 if self._next is None else (sample.number - self._next + (1 << 31)) % (1 << 32) - (1 << 31)
        if self._next is None or abs(ahead) > _FAR:
            ready, self._next, ahead = self.flush(), sample.number, 0
        if ahead < 0 or sample.number in self._ahead:
            self.counters.imu_late += 1
            return ready
        self.counters.imu += 1
        self._ahead[sample.number] = sample
        if len(self._ahead) > _HOLD:
            self._skip_missing()
        return ready + self._take()

    def _skip_missing(self) -> None:
        """Go on with the first sample that is there."""
        assert self._next is not None
        missing, first = min(((number - self._next) % (1 << 32), number) for number in self._ahead)
        self.counters.imu_lost += missing
        self._next = first

    def _take(self) -> list[ImuSample]:
        ready = []
        while self._next in self._ahead:
            ready.append(self._ahead.pop(self._next))
            self._next = (self._next + 1) % (1 << 32)
        return ready
