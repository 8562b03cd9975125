"""MSOP, RoboSense's measurement packets, read and written. Big-endian throughout.

A packet has 1,248 bytes: a header of 42, then blocks (FF EE, azimuth in 0.01 deg, then for each channel distance u16
and intensity u8) and a tail. An RS-Bpearl's has twelve blocks of 32 channels; an Airy's has four of 96 channels, each
divided into two parts with a mark and azimuth of their own.
"""

import struct
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from app.sensors.robosense import AIRY, BPEARL, BPV4, Model
from app.slam.types import I64, U8, U16

MSOP_PORT = 6699
PACKET_BYTES = 1248
HEADER_BYTES = 42
TURN = 36_000
"""A revolution in the packets' unit of azimuth, 0.01 deg."""

_LEGACY = struct.Struct(">6BHH")
_AZIMUTHS = {
    model.name: struct.Struct(">" + f"2xH{model.part_bytes * model.parts - 4}x" * model.blocks)
    for model in (BPEARL, BPV4, AIRY)
}
_TYPE_BPV4 = b"\x03\x04"
_TYPE_AIRY = 0x31
_TYPE_BPEARL = 3
_LIKE_BPEARL = {1: "an RS-LiDAR-16", 2: "an RS-LiDAR-32"}
"""Other sensors whose packets have the RS-Bpearl's mark and blocks, by type."""
_LIKE_AIRY = {1: 48, 3: 192}
"""Number of channels of Airys that do not have 96, by model."""


def is_cut(packet: bytes) -> bool:
    """Whether it begins like a measurement packet, but has another length."""
    return packet.startswith((BPEARL.mark, AIRY.mark)) and len(packet) != PACKET_BYTES


def other_sensor(packet: bytes) -> str:
    """The RoboSense that sent this measurement packet, if its packets cannot be read; "" if they can, or for another
    packet.

    The type is in byte 31, for the first generation in byte 30. If it is unknown or zero, the packet is accepted if the
    blocks are where they should be.
    """
    if len(packet) != PACKET_BYTES:
        return ""
    if packet.startswith(BPEARL.mark):
        stated = packet[30:32]
        return "" if _TYPE_BPEARL in stated else next((_LIKE_BPEARL[one] for one in stated if one in _LIKE_BPEARL), "")
    if not packet.startswith(AIRY.mark):
        return ""
    if packet[31] == _TYPE_AIRY:
        return f"an Airy of {_LIKE_AIRY[packet[32]]} channels" if packet[32] in _LIKE_AIRY else ""
    begins = range(HEADER_BYTES, HEADER_BYTES + AIRY.blocks * AIRY.parts * AIRY.part_bytes, AIRY.part_bytes)
    fits = all(packet[at : at + 2] == b"\xff\xee" for at in begins)
    return "" if fits else f"another RoboSense, of type {packet[31]:#04x}"


def model_of(packet: bytes) -> Model | None:
    """The sensor that sent a packet; None if it is not a complete measurement packet of a sensor that can be read."""
    if len(packet) != PACKET_BYTES or not packet.startswith((BPEARL.mark, AIRY.mark)) or other_sensor(packet):
        return None
    if packet.startswith(AIRY.mark):
        return AIRY
    return BPV4 if packet[31:33] == _TYPE_BPV4 else BPEARL


def stamp_of(packet: bytes, model: Model) -> int | None:
    """Time of the first block, ns since 1970 by the sensor's clock; None if it shows no date."""
    if model is not BPEARL:
        return read_utc(packet[20:30])
    base = _date_ns(packet[20:26])
    if base is None:
        return None
    *_, milliseconds, micros = _LEGACY.unpack_from(packet, 20)
    return base + int(milliseconds) * 1_000_000 + int(micros) * 1_000


def azimuths_of(packet: bytes, model: Model) -> tuple[int, ...]:
    """Azimuth of each block, 0.01 deg."""
    return _AZIMUTHS[model.name].unpack_from(packet, HEADER_BYTES)


def index_of(packet: bytes, model: Model) -> int:
    return int.from_bytes(packet[model.index_at : model.index_at + 4], "big")


def write_packet(
    stamp_ns: int, azimuth: U16, counts: U16, intensity: U8, model: Model = BPEARL, index: int = 0
) -> bytes:
    """A packet as the sensor sends it.

    Args:
        stamp_ns: time of the first block; the packet keeps whole microseconds.
        azimuth: (blocks,) 0.01 deg. counts: (blocks, channels) distance in steps of the model, 0 = no return.
        intensity: (blocks, channels).
    """
    packet = np.zeros(PACKET_BYTES, np.uint8)
    packet[: len(model.mark)] = np.frombuffer(model.mark, np.uint8)
    packet[20:33] = np.frombuffer(_stamp_bytes(stamp_ns, model), np.uint8)
    rows, size = model.blocks * model.parts, model.part_bytes
    parts = packet[HEADER_BYTES : HEADER_BYTES + rows * size].reshape(rows, size)
    parts[:, 0], parts[:, 1] = 0xFF, 0xEE
    parts[:, 2:4] = np.repeat(azimuth, model.parts).astype(">u2").view(np.uint8).reshape(rows, 2)
    channels = parts[:, 4:].reshape(rows, model.part, 3)
    channels[:, :, :2] = counts.astype(">u2").view(np.uint8).reshape(rows, model.part, 2)
    channels[:, :, 2] = intensity.reshape(rows, model.part)
    number = (index % (1 << 16 if model is AIRY else 1 << 32)).to_bytes(4, "big")
    packet[model.index_at : model.index_at + 4] = np.frombuffer(number, np.uint8)
    return packet.tobytes()


def date_bytes(stamp_ns: int) -> bytes:
    """The ten bytes of a time in packets of the first generation."""
    microseconds = stamp_ns // 1_000
    when = datetime.fromtimestamp(microseconds // 1_000_000, UTC)
    milliseconds, rest = divmod(microseconds % 1_000_000, 1_000)
    return _LEGACY.pack(
        max(when.year - 2000, 0), when.month, when.day, when.hour, when.minute, when.second, milliseconds, rest
    )


def utc_bytes(stamp_ns: int) -> bytes:
    """The ten bytes of a time in later packets: seconds and microseconds."""
    seconds, rest = divmod(stamp_ns // 1_000, 1_000_000)
    return seconds.to_bytes(6, "big") + rest.to_bytes(4, "big")


def read_utc(data: bytes) -> int | None:
    """ns since 1970 of such ten bytes; None if they show no date."""
    seconds, microseconds = int.from_bytes(data[:6], "big"), int.from_bytes(data[6:], "big")
    return None if seconds >= 1 << 33 or microseconds >= 1_000_000 else seconds * 1_000_000_000 + microseconds * 1_000


def _stamp_bytes(stamp_ns: int, model: Model) -> bytes:
    """Bytes 20 to 33: time, and which sensor it is."""
    if model is BPEARL:
        return date_bytes(stamp_ns) + b"\x00\x03\x01"
    return utc_bytes(stamp_ns) + b"\x00" + (_TYPE_BPV4 if model is BPV4 else bytes([_TYPE_AIRY, 2]))


def _date_ns(date: bytes) -> int | None:
    year, month, day, hour, minute, second = date
    try:
        when = datetime(2000 + year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return int(when.timestamp()) * 1_000_000_000


@dataclass(frozen=True, slots=True)
class Firings:
    """Blocks of a sensor, two for two returns of one firing.

    Attributes:
        times_ns: (b,) absolute. azimuth: (b,) 0.01 deg. counts: (b, channels) distance in steps of the model, 0 = no
            return. intensity: (b, channels).
    """

    times_ns: I64
    azimuth: U16
    counts: U16
    intensity: U8


class PacketWriter:
    """Packs blocks into packets, as the sensor does: a packet may span two revolutions."""

    def __init__(self, model: Model = BPEARL) -> None:
        self._model = model
        self._index = 0
        self._blocks: list[tuple[int, int, U16, U8]] = []

    def add(self, firings: Firings) -> list[tuple[int, bytes]]:
        """Packets that these blocks complete, each with the time at which the sensor would send it."""
        made, times_ns, azimuth = [], firings.times_ns.tolist(), firings.azimuth.tolist()
        for block in zip(times_ns, azimuth, firings.counts, firings.intensity, strict=True):
            if self._blocks and block[0] - self._blocks[-1][0] > 1.5 * self._model.block_ns:
                made += self.flush()
            self._blocks.append(block)
            if len(self._blocks) == self._model.blocks:
                made += self.flush()
        return made

    def flush(self) -> list[tuple[int, bytes]]:
        """The packet of the remaining blocks, filled up with blocks that saw nothing."""
        if not self._blocks:
            return []
        time, angle, *_ = self._blocks[-1]
        count, channels = self._model.blocks, self._model.channels
        empty = (time, angle, np.zeros(channels, np.uint16), np.zeros(channels, np.uint8))
        times, azimuth, counts, intensity = zip(*(self._blocks + [empty] * count)[:count], strict=True)
        packet = write_packet(
            times[0], np.array(azimuth, np.uint16), np.array(counts), np.array(intensity), self._model, self._index
        )
        self._index += 1
        self._blocks.clear()
        return [(time + self._model.block_ns, packet)]
