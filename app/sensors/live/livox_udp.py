"""The datagrams of a Livox Mid-360, read and written. Little-endian throughout.

A header of 36 bytes, then points (int32 in mm, or int16 in cm, with reflectivity and tag), or one IMU sample (six
float32, rad/s and g). The points of a datagram are evenly spaced in time [Livox-SDK2, livox_lidar_def.h].
"""

import struct
import zlib
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from app.sensors.imu_units import STANDARD_GRAVITY
from app.sensors.livox import CustomMsg
from app.sensors.log_times import LATEST_NS
from app.slam.errors import HemislamError
from app.slam.types import I64, U8, Scan, Vector

POINTS_PORT, IMU_PORT = 56301, 56401
SCAN_NS = 100_000_000
"""Duration of a scan; scans are counted from whole seconds."""
SLOT_NS, SLOTS = 5_000, 96
"""Time between two firings, 200,000 a second, and firings in a packet."""
_MOST_LOST = 0.1
"""Share of points that may coincide with another point's firing: stamps are rounded."""
FARTHEST_M = 100.0
"""m: a point farther out on any axis is not a return."""
_HEADER = struct.Struct("<B4H3B12xIQ")
"""Version, length, duration (0.1 us), points, number, frame, kind of content, of clock, CRC-32, time (ns)."""
HEADER_BYTES: Final = _HEADER.size
_CHECKED_AT = 28
_SAMPLE = struct.Struct("<6f")
_IMU_KIND = 0
_MEASURED: dict[int, tuple[np.dtype[Any], float]] = {
    1: (np.dtype([("at", "<i4", 3), ("reflectivity", "u1"), ("tag", "u1")]), 0.001),
    2: (np.dtype([("at", "<i2", 3), ("reflectivity", "u1"), ("tag", "u1")]), 0.01),
}
"""Layout of a point and m of its unit, by the kind of content."""


@dataclass(frozen=True, slots=True, eq=False)
class Livox:
    """A sensor whose scans are intervals of time. blocks: of a packet, between which a scan may end."""

    name: str
    blocks: int = 1


MID360 = Livox("Mid-360")


@dataclass(frozen=True, slots=True)
class LivoxHeader:
    """number: of the packet, wraps at 65536. of_imu: whether it holds a sample of the IMU, not points."""

    number: int
    of_imu: bool
    stamp_ns: int


def read_header(packet: bytes) -> LivoxHeader | None:
    """The header of a datagram; None if it is from another sensor. It has no mark, but its lengths must agree."""
    if len(packet) < HEADER_BYTES:
        return None
    version, length, _, count, number, _, kind, _, _, stamp = _HEADER.unpack_from(packet)
    size = _SAMPLE.size if kind == _IMU_KIND else _MEASURED[kind][0].itemsize if kind in _MEASURED else -1
    if version or length != len(packet) or not count or HEADER_BYTES + count * size != length or stamp >= LATEST_NS:
        return None
    return LivoxHeader(number, kind == _IMU_KIND, stamp)


def read_imu(packet: bytes) -> tuple[int, Vector, Vector] | None:
    """Time ns, rad/s and m/s^2 of an IMU sample; None if the packet is not one."""
    header = read_header(packet)
    if header is None or not header.of_imu:
        return None
    values = _SAMPLE.unpack_from(packet, HEADER_BYTES)
    gx, gy, gz = values[:3]
    ax, ay, az = (STANDARD_GRAVITY * value for value in values[3:])
    return header.stamp_ns, (gx, gy, gz), (ax, ay, az)


def read_points(packets: U8, shift_ns: int = 0) -> CustomMsg:
    """The points of a scan's packets (n, bytes), each padded at its end, as Livox's ROS driver would send them.

    shift_ns: added to their times.
    """
    parts, times = [], []
    for row in packets:
        _, _, duration, count, _, _, kind, _, _, stamp_ns = _HEADER.unpack_from(row)
        layout, unit = _MEASURED[kind]
        raw = row[HEADER_BYTES : HEADER_BYTES + count * layout.itemsize].view(layout)
        parts.append((raw["at"] * np.float32(unit), raw["reflectivity"], raw["tag"]))
        times.append(stamp_ns + duration * 100 // count * np.arange(count, dtype=np.int64))
    xyz, reflectivity, tag = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    xyz[(np.abs(xyz) > FARTHEST_M).any(axis=1)] = 0.0
    return CustomMsg.made(np.concatenate(times) + shift_ns, xyz, reflectivity, tag)


class LivoxWriter:
    """Packs scans and samples into datagrams, as the sensor does: one may hold points of two scans."""

    def __init__(self) -> None:
        self._number = self._samples = 0
        self._base_ns: int | None = None
        self._slots: I64 = np.empty(0, np.int64)
        self._rows: npt.NDArray[Any] = np.empty(0, _MEASURED[1][0])

    def add(self, scan: Scan) -> list[tuple[int, bytes]]:
        """Packets that this scan completes, each with the time at which the sensor would send it.

        Raises:
            HemislamError: the scan is denser than such a sensor measures, so that points would be lost.
        """
        self._base_ns = scan.stamp_ns if self._base_ns is None else self._base_ns
        rows = np.zeros(len(scan), self._rows.dtype)
        rows["at"] = np.rint(scan.points.astype(np.float64) * 1000.0)
        rows["reflectivity"], rows["tag"] = np.clip(np.rint(scan.intensity), 0, 255), 0x10
        slots = (scan.stamp_ns - self._base_ns + scan.offsets_ns.astype(np.int64) + SLOT_NS // 2) // SLOT_NS
        lost = len(slots) - len(np.unique(slots))
        if lost > _MOST_LOST * len(slots):
            raise HemislamError(
                f"{lost} of a scan's {len(slots)} points were measured at once with others: "
                "they are not those of a Mid-360; play the recording out to foxglove://."
            )
        self._slots, self._rows = np.append(self._slots, slots), np.append(self._rows, rows)
        return self._sent(int(slots.max()) // SLOTS)

    def flush(self) -> list[tuple[int, bytes]]:
        """The packet of the remaining points."""
        return self._sent(int(self._slots.max()) // SLOTS + 1) if len(self._slots) else []

    def settings(self, stamp_ns: int) -> bytes | None:
        """The packet in which the sensor states its settings; a Mid-360 sends none."""
        return None

    def imu(self, stamp_ns: int, gyro: Vector, accel: Vector) -> bytes:
        """A sample. gyro: rad/s. accel: m/s^2."""
        body = _SAMPLE.pack(*gyro, *(value / STANDARD_GRAVITY for value in accel))
        self._samples += 1
        return _packet(body, stamp_ns, 0, 1, self._samples - 1, 0)

    def _sent(self, stop: int) -> list[tuple[int, bytes]]:
        """All packets before this one."""
        assert self._base_ns is not None
        which, made = self._slots // SLOTS, []
        for packet in np.unique(which[which < stop]).tolist():
            mine = which == packet
            points = np.zeros(SLOTS, self._rows.dtype)
            points[self._slots[mine] % SLOTS] = self._rows[mine]
            stamp_ns = self._base_ns + packet * SLOTS * SLOT_NS
            data = _packet(points.tobytes(), stamp_ns, SLOTS * SLOT_NS // 100, SLOTS, self._number, 1)
            made.append((stamp_ns + SLOTS * SLOT_NS, data))
            self._number += 1
        rest = which >= stop
        self._slots, self._rows = self._slots[rest], self._rows[rest]
        return made


def _packet(body: bytes, stamp_ns: int, duration: int, count: int, number: int, kind: int) -> bytes:
    length = HEADER_BYTES + len(body)
    head = _HEADER.pack(0, length, duration, count, number % (1 << 16), 0, kind, 0, 0, stamp_ns)
    check = zlib.crc32(head[_CHECKED_AT:] + body)
    return head[: _CHECKED_AT - 4] + struct.pack("<I", check) + head[_CHECKED_AT:] + body
