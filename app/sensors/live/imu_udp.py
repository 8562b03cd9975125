"""IMU samples as UDP datagrams: `imu-udp://:PORT`, for an IMU beside raw LiDAR packets.

A datagram holds one sample or several, each of 64 bytes, little-endian:

    offset  type    what
    0       4 s     "HIMU"
    4       u32     sequence number, one more with each sample, wrapping to 0
    8       i64     time of the measurement, ns since 1970
    16      3 f64   angular velocity x, y, z, rad/s, IMU frame
    40      3 f64   specific force x, y, z, m/s^2, IMU frame (+9.81 upwards at rest)

docs/guide/live.md has a complete sender.

The samples of an Airy's own IMU (51 bytes, big-endian, counts of its full range) and of a Mid-360's are read as well.
"""

import math
import struct
from dataclasses import dataclass, field

from app.sensors.imu_units import STANDARD_GRAVITY
from app.sensors.live import livox_udp
from app.sensors.live.msop import read_utc, utc_bytes
from app.sensors.live.status import Counters
from app.sensors.log_times import LATEST_NS
from app.slam.types import Vector

IMU_PORT = 6700
IMU_MAGIC = b"HIMU"
_SAMPLE = struct.Struct("<4sIq6d")
SAMPLE_BYTES = _SAMPLE.size
AIRY_IMU_PORT = 6688
_AIRY_MAGIC = bytes.fromhex("aa555a05")
_AIRY_SAMPLE = struct.Struct(">4s10s6i4xBBBI2s")
"""Mark, time, counts of acceleration and turning, temperature, rate, their ranges, number, end."""
_COUNTS = 32_768


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Attributes:
    number: of the datagram; None if it has no usable number. stamp_ns: as sent. gyro: rad/s. accel: m/s^2, IMU frame.
    """

    number: int | None
    stamp_ns: int
    gyro: Vector
    accel: Vector


def write_imu(sample: ImuSample) -> bytes:
    number = (sample.number or 0) & 0xFFFFFFFF
    return _SAMPLE.pack(IMU_MAGIC, number, sample.stamp_ns, *sample.gyro, *sample.accel)


def write_airy_imu(sample: ImuSample) -> bytes:
    """As an Airy sends it: ranges of 4 g and 500 deg/s."""
    accel, gyro = _airy_units(1, 1)
    counts = [round(value / accel) for value in sample.accel] + [round(value / gyro) for value in sample.gyro]
    number = ((sample.number or 0) + 1) & 0xFFFFFFFF
    return _AIRY_SAMPLE.pack(_AIRY_MAGIC, utc_bytes(sample.stamp_ns), *counts, 3, 1, 1, number, b"\xf0\x0f")


def is_imu(datagram: bytes) -> bool:
    """Whether a datagram holds IMU samples."""
    if datagram.startswith((IMU_MAGIC, _AIRY_MAGIC)):
        return True
    header = livox_udp.read_header(datagram)
    return header is not None and header.of_imu


def read_imu(datagram: bytes) -> list[ImuSample]:
    """The samples of a datagram; none if it is of another kind."""
    if datagram.startswith(_AIRY_MAGIC):
        return _read_airy(datagram)
    if not datagram.startswith(IMU_MAGIC):
        read = livox_udp.read_imu(datagram)
        return [ImuSample(None, *read)] if read and all(map(math.isfinite, read[1] + read[2])) else []
    if len(datagram) % SAMPLE_BYTES:
        return []
    samples = []
    for magic, number, stamp, gx, gy, gz, ax, ay, az in _SAMPLE.iter_unpack(datagram):
        if magic != IMU_MAGIC or abs(stamp) >= LATEST_NS:
            return []
        samples.append(ImuSample(number, stamp, (gx, gy, gz), (ax, ay, az)))
    return samples


def _read_airy(datagram: bytes) -> list[ImuSample]:
    if len(datagram) != _AIRY_SAMPLE.size:
        return []
    _, time, ax, ay, az, gx, gy, gz, _, accel_range, gyro_range, number, _ = _AIRY_SAMPLE.unpack(datagram)
    stamp_ns = read_utc(time)
    if stamp_ns is None or stamp_ns >= LATEST_NS or max(accel_range, gyro_range) > 3:
        return []
    accel, gyro = _airy_units(accel_range, gyro_range)
    return [ImuSample(number, stamp_ns, (gx * gyro, gy * gyro, gz * gyro), (ax * accel, ay * accel, az * accel))]


def _airy_units(accel_range: int, gyro_range: int) -> tuple[float, float]:
    """m/s^2 and rad/s of a count. A range of k stands for 2 g, or 250 deg/s, doubled k times."""
    accel, gyro = 2 * STANDARD_GRAVITY * 2**accel_range, math.radians(250.0) * 2**gyro_range
    return accel / _COUNTS, gyro / _COUNTS


_HOLD = 4
"""Number of samples for which to wait for a missing one: 20 ms at 200 Hz."""
_FAR = 1_000
"""If numbers are this far apart, the sender was restarted."""


@dataclass(slots=True)
class ImuOrder:
    """Puts samples back in order by their numbers; counts lost, late and repeated ones."""

    counters: Counters = field(default_factory=Counters)
    _next: int | None = None
    _ahead: dict[int, ImuSample] = field(default_factory=dict)

    def add(self, datagram: bytes) -> list[ImuSample]:
        """The samples that can be passed on, in order."""
        samples = read_imu(datagram)
        if not samples:
            self.counters.imu_foreign += 1
        return [ready for sample in samples for ready in self._one(sample)]

    def flush(self) -> list[ImuSample]:
        """The samples that wait for a missing one, which is no longer awaited."""
        return self._released(0)

    def _one(self, sample: ImuSample) -> list[ImuSample]:
        ready: list[ImuSample] = []
        if sample.number is None:
            self.counters.imu += 1
            return [sample]
        ahead = 0 if self._next is None else (sample.number - self._next + (1 << 31)) % (1 << 32) - (1 << 31)
        if self._next is None or abs(ahead) > _FAR:
            ready, self._next, ahead = self.flush(), sample.number, 0
        if ahead < 0 or sample.number in self._ahead:
            self.counters.imu_late += 1
            return ready
        self.counters.imu += 1
        self._ahead[sample.number] = sample
        return ready + self._released(_HOLD)

    def _released(self, most: int) -> list[ImuSample]:
        """The samples that follow in order; if more than `most` wait for missing ones, without these."""
        ready = []
        while self._next is not None and (self._next in self._ahead or len(self._ahead) > most):
            missing, first = min(((number - self._next) % (1 << 32), number) for number in self._ahead)
            self.counters.imu_lost += missing
            ready.append(self._ahead.pop(first))
            self._next = (first + 1) % (1 << 32)
        return ready
