"""A capture of an Ouster's packets, with its metadata (.json) beside it, as a recording. Little-endian throughout.

Source: Ouster's sensor documentation, "Lidar data packet format" and "Coordinate frames". Points are in the LiDAR's own
frame, as the ROS driver's `os_lidar`; topics and units are that driver's.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from app.sensors import ros
from app.sensors.findings import Finding
from app.sensors.imu_units import STANDARD_GRAVITY
from app.sensors.live.capture import PacketStream
from app.sensors.live.devices import mount_finding
from app.sensors.live.pcap import Datagram
from app.sensors.log_times import LATEST_NS
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import F64, I64

LIDAR_TOPIC, IMU_TOPIC = "/ouster/points", "/ouster/imu"
_IMU = np.dtype([("system", "<u8"), ("accel_ns", "<u8"), ("gyro_ns", "<u8"), ("accel", "<f4", 3), ("gyro", "<f4", 3)])
"""The legacy IMU packet: g and deg/s."""
_POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), ("t", "<u4"), ("reflectivity", "<u2"), ("ring", "<u2")])
MOST_COLUMNS = 4096
"""Most columns of a turn, in the finest mode of any Ouster."""
LATE = 4
"""After this many packets of the next turn, the present turn is given out even if packets are missing."""


@dataclass(frozen=True, slots=True)
class _Return:
    """Layout of a return in a pixel: place, bits and unit (mm) of its range; place of its reflectivity."""

    at: int
    layout: str
    bits: int
    unit_mm: int
    reflectivity_at: int


@dataclass(frozen=True, slots=True)
class _Profile:
    """A packet format: bytes before and after the columns, of a column's header and end, of a pixel; its returns."""

    header: int
    column_header: int
    column_end: int
    footer: int
    pixel: int
    returns: tuple[_Return, ...]

    def packet(self, columns: int, rows: int) -> np.dtype[Any]:
        """A packet: columns with their time, place in the turn, status and a pixel in each row."""
        size = self.column_header + rows * self.pixel + self.column_end
        status_at, status = (size - 4, "<u4") if self.column_end else (10, "<u2")
        pixels = (f"V{self.pixel}", (rows,)), self.column_header
        column = ros.structure(size, time=("<u8", 0), place=("<u2", 8), status=(status, status_at), pixels=pixels)
        return ros.structure(self.header + columns * size + self.footer, columns=((column, (columns,)), self.header))


_PROFILES = {
    "LEGACY": _Profile(0, 16, 4, 0, 12, (_Return(0, "<u4", 0xFFFFF, 1, 4),)),
    "RNG19_RFL8_SIG16_NIR16": _Profile(32, 12, 0, 32, 12, (_Return(0, "<u4", 0x7FFFF, 1, 4),)),
    "RNG19_RFL8_SIG16_NIR16_DUAL": _Profile(
        32, 12, 0, 32, 16, (_Return(0, "<u4", 0x7FFFF, 1, 3), _Return(4, "<u4", 0x7FFFF, 1, 7))
    ),
    "RNG15_RFL8_NIR8": _Profile(32, 12, 0, 32, 4, (_Return(0, "<u2", 0x7FFF, 8, 2),)),
}
"""Packet formats by their names in the metadata."""


@dataclass(frozen=True)
class Metadata:
    """What an Ouster states about itself.

    Attributes:
        name: of the product. profile: of its packets. columns: number in a packet. width: columns of a turn.
        elevations, azimuths: (rows,) rad of each beam. origin_mm: of the beams, from the axis.
        T_imu_lidar: (4, 4), m.
    """

    name: str
    profile: _Profile
    columns: int
    width: int
    elevations: F64
    azimuths: F64
    origin_mm: float
    T_imu_lidar: F64

    @classmethod
    def read(cls, path: Path) -> "Metadata | None":
        """None if the file is no metadata of an Ouster. Raises HemislamError: its packets cannot be read."""
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            flat = dict(said)
            for part in said.values():  # later firmware puts them into groups
                flat |= part if isinstance(part, dict) else {}
            profile = str(flat.get("udp_profile_lidar", "LEGACY"))
            T_lidar, T_imu = (
                np.array(flat[f"{name}_to_sensor_transform"], np.float64).reshape(4, 4) for name in ("lidar", "imu")
            )
            T_imu_lidar = lie.inverse(T_imu) @ T_lidar
            T_imu_lidar[:3, 3] /= 1000.0
            elevations, azimuths = (
                np.radians(np.array(flat[f"beam_{name}_angles"], np.float64)) for name in ("altitude", "azimuth")
            )
            found = cls(
                str(flat.get("prod_line", "Ouster")), _PROFILES.get(profile, _PROFILES["LEGACY"]),
                int(flat["columns_per_packet"]), int(flat["columns_per_frame"]), elevations, azimuths,
                float(flat["lidar_origin_to_beam_origin_mm"]), T_imu_lidar,
            )  # fmt: skip
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            return None
        if not 0 < found.columns <= found.width <= MOST_COLUMNS:
            raise HemislamError(
                f"{path.name} states {found.columns} columns a packet and {found.width} a turn, which no sensor sends; "
                "copy the metadata from the sensor again."
            )
        if profile not in _PROFILES or found.elevations.shape != found.azimuths.shape or found.elevations.ndim != 1:
            raise HemislamError(
                f"The packets of {path.name} are of a kind that is not read ({profile}); set the sensor to one of "
                f"{', '.join(_PROFILES)}, or record its ROS topics."
            )
        return found

    @cached_property
    def packet(self) -> np.dtype[Any]:
        return self.profile.packet(self.columns, len(self.elevations))

    @cached_property
    def rays(self) -> tuple[F64, F64]:
        """(width, rows, 3) directions and (width, 1, 3) origins in mm: a point lies on its ray at range - origin."""
        head = 2 * np.pi * (1.0 - np.arange(self.width) / self.width)[:, None]
        along, level = head - self.azimuths, np.cos(self.elevations)
        up = np.broadcast_to(np.sin(self.elevations), along.shape)
        origins = np.stack([np.cos(head), np.sin(head), np.zeros_like(head)], axis=2) * self.origin_mm
        return np.stack([level * np.cos(along), level * np.sin(along), up], axis=2), origins


def metadata_beside(capture: Path) -> Metadata | None:
    """The metadata in the .json with the capture's name, or NAME_0; else in that whose name is its longest prefix."""
    named = (capture.stem, f"{capture.stem}_0")
    beside = [
        path for path in capture.parent.glob("*.json") if path.stem in named or capture.stem.startswith(path.stem)
    ]
    found = (Metadata.read(path) for path in sorted(beside, key=lambda path: -len(path.stem)))
    return next((one for one in found if one is not None), None)


class Turns:
    """Packets gathered into turns, though UDP swaps, repeats and loses some.

    Turns are numbered by the sensor, with 16 bits; a packet is known by its turn and its first column.
    """

    def __init__(self, whole: int) -> None:
        """whole: packets of a full turn."""
        self._whole = whole
        self._open: dict[int, dict[int, bytes]] = {}
        self._ended: int | None = None

    def add(self, turn: int, column: int, packet: bytes) -> Iterator[list[bytes]]:
        """The turns that this packet shows to be over, each in order of its columns."""
        if turn not in self._open:
            if self._ended is not None and _ahead(turn, self._ended) in (-1, 0):
                return  # it comes too late
            if any(abs(_ahead(turn, other)) > 1 for other in self._open):  # turns were lost, or the sensor restarted
                yield from self.rest()
        there = self._open.get(turn, {}).get(column)
        if there == packet:
            return  # it came twice
        if there is not None:  # the turn's number does not advance
            yield self._end(turn)
        self._open.setdefault(turn, {})[column] = packet
        first = min(self._open, key=lambda other: _ahead(other, turn))
        later = sum(len(packets) for other, packets in self._open.items() if other != first)
        if later > LATE or (later and len(self._open[first]) == self._whole):
            yield self._end(first)

    def rest(self) -> Iterator[list[bytes]]:
        """The turns that remain when no more packets come."""
        while self._open:
            some = next(iter(self._open))
            yield self._end(min(self._open, key=lambda other: _ahead(other, some)))

    def _end(self, turn: int) -> list[bytes]:
        self._ended = turn
        return [packet for _, packet in sorted(self._open.pop(turn).items())]


class OusterStream(PacketStream):
    """A capture of an Ouster. An entry is an IMU packet (bytes), or all packets of a scan (a list)."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        """Raises CaptureError: the file is no capture."""
        super().__init__(path, lambda packet: len(packet) == metadata.packet.itemsize)
        self._metadata, self._topics = metadata, {list: LIDAR_TOPIC, bytes: IMU_TOPIC}
        scans = samples = missing = 0
        for _, content in self._index(list):
            if isinstance(content, list):
                scans += 1
                missing += max(metadata.width // metadata.columns - len(content), 0)
            else:
                samples += 1
        topics = ((LIDAR_TOPIC, ros.CLOUD, scans), (IMU_TOPIC, ros.IMU, samples))
        self.counts = {topic: (kind, count) for topic, kind, count in topics if count}
        end = "" if self.complete else "; the file is cut off there"
        text = f"{scans} scans, {samples} IMU samples, {missing} packets missing{end}"
        rows = f"{metadata.name}, {len(metadata.elevations)} x {metadata.width}, by the .json beside the file"
        found = [
            Finding("packets", "corrected" if missing or not self.complete else "fine", text),
            Finding("sensor", "fine", rows),
            *self._senders_finding(),
        ]
        R = metadata.T_imu_lidar[:3, :3]
        if np.isfinite(metadata.T_imu_lidar).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            found.append(mount_finding(metadata.T_imu_lidar))
        if not samples:
            missed = f"no IMU packet of {_IMU.itemsize} bytes is in the file; set the sensor's IMU profile to LEGACY"
            found.append(Finding("IMU", "needs you", missed))
        self.findings = tuple(found)

    def _contents(self, datagrams: Iterator[tuple[int, Datagram | None]]) -> Iterator[bytes | list[bytes]]:
        meta = self._metadata
        turns = Turns(meta.width // meta.columns)
        for _, datagram in datagrams:
            if datagram is None:
                yield from turns.rest()
                continue
            payload = datagram.payload
            if self._is_of_another(datagram):
                continue
            if len(payload) == _IMU.itemsize:
                yield payload
            elif self._is_measured(payload):
                column = int.from_bytes(payload[(first := meta.profile.header + 8) : first + 2], "little")
                yield from turns.add(self._frame_of(payload), column, payload)
        yield from turns.rest()

    def _message(self, content: bytes | list[bytes], log_ns: int) -> Any:
        return self._cloud(content) if isinstance(content, list) else _imu_message(content)

    def _frame_of(self, packet: bytes) -> int:
        at = 2 if self._metadata.profile.header else 10
        return int.from_bytes(packet[at : at + 2], "little")

    def _cloud(self, packets: list[bytes]) -> Any:
        """The message of a scan, stamped at its first column."""
        meta = self._metadata
        columns = np.frombuffer(b"".join(packets), meta.packet)["columns"].ravel()
        times = columns["time"].astype(np.int64)
        fits = ((columns["status"] & 1) == 1) & (columns["place"] < meta.width) & (times > 0)
        columns, times = columns[fits], times[fits]
        if not len(times):
            return ros.points_message(np.empty(0, _POINT), 0, "os_lidar")
        parts = [self._points(columns, times, one) for one in meta.profile.returns]
        return ros.points_message(np.concatenate(parts), int(times.min()), "os_lidar")

    def _points(self, columns: Any, times: I64, echo: _Return) -> Any:
        """(n,) points of one return."""
        meta = self._metadata
        range_, reflectivity = (echo.layout, echo.at), ("u1", echo.reflectivity_at)
        parts = ros.structure(meta.profile.pixel, range=range_, reflectivity=reflectivity)
        pixels = columns["pixels"].view(parts)
        ranges = (pixels["range"] & echo.bits).astype(np.float64) * echo.unit_mm
        column, row = np.nonzero(ranges)
        directions, origins = meta.rays
        where = columns["place"][column]
        xyz = directions[where, row] * (ranges[column, row] - meta.origin_mm)[:, None] + origins[where, 0]
        points = np.zeros(len(row), _POINT)
        points["x"], points["y"], points["z"] = (xyz * 0.001).T
        points["t"] = np.minimum(times[column] - times.min(), np.iinfo(np.uint32).max)
        points["reflectivity"] = pixels["reflectivity"][column, row]
        points["ring"] = row
        return points


def _imu_message(packet: bytes) -> Any:
    (sample,) = np.frombuffer(packet, _IMU)
    with np.errstate(invalid="ignore"):
        gyro, accel = np.radians(sample["gyro"].astype(np.float64)), sample["accel"].astype(np.float64)
    stamp_ns = min(int(sample["gyro_ns"]), LATEST_NS)
    return ros.imu_message(stamp_ns, tuple(gyro.tolist()), tuple((accel * STANDARD_GRAVITY).tolist()))


def _ahead(turn: int, of: int) -> int:
    """By how many turns one number is ahead of the other, allowing for the counter's overflow."""
    return (turn - of + 0x8000) % 0x10000 - 0x8000
