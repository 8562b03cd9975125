"""MSOP, the RS-Bpearl's measurement packets, read and written. Big-endian throughout.

A packet has 1,248 bytes: a header of 42, twelve blocks of 100 (FF EE, azimuth in 0.01 deg, then 32
times distance u16 and intensity u8 in channel order), packet index and tail.
"""

import calendar
import struct
from datetime import UTC, datetime
from functools import lru_cache

import numpy as np

from app.sensors.rsbpearl import BPEARL, BPV4, CHANNELS, Model
from app.slam.types import I64, U8, U16

MSOP_PORT = 6699
MSOP_ID = bytes.fromhex("55aa050a5aa550a0")
PACKET_BYTES = 1248
BLOCKS = 12
BLOCK_BYTES = 100
HEADER_BYTES = 42
INDEX_AT = 1242
TURN = 36_000
"""A revolution in the packets' unit of azimuth, 0.01 deg."""

_AZIMUTHS = struct.Struct(">" + "2xH96x" * BLOCKS)
_LEGACY = struct.Struct(">6BHH")
_INDEX = struct.Struct(">I")
_TYPE_BPV4 = b"\x03\x04"


def model_of(packet: bytes) -> Model:
    """The generation of the sensor that sent it."""
    return BPV4 if packet[31:33] == _TYPE_BPV4 else BPEARL


def stamp_of(packet: bytes) -> int | None:
    """Time of the first block, ns since 1970 by the sensor's clock; None if it shows no date."""
    if packet[31:33] == _TYPE_BPV4:
        seconds = int.from_bytes(packet[20:26], "big")
        microseconds = int.from_bytes(packet[26:30], "big")
        if seconds >= 1 << 33 or microseconds >= 1_000_000:
            return None
        return seconds * 1_000_000_000 + microseconds * 1_000
    base = _date_ns(packet[20:26])
    if base is None:
        return None
    *_, milliseconds, micros = _LEGACY.unpack_from(packet, 20)
    return base + int(milliseconds) * 1_000_000 + int(micros) * 1_000


def azimuths_of(packet: bytes) -> tuple[int, ...]:
    """Azimuth of each of the 12 blocks, 0.01 deg."""
    return _AZIMUTHS.unpack_from(packet, HEADER_BYTES)


def index_of(packet: bytes) -> int:
    return int(_INDEX.unpack_from(packet, INDEX_AT)[0])


def write_packet(
    stamp_ns: int, azimuth: U16, counts: U16, intensity: U8, model: Model = BPEARL, index: int = 0
) -> bytes:
    """A packet as the sensor sends it.

    Args:
        stamp_ns: time of the first block; the packet keeps whole microseconds.
        azimuth: (12,) 0.01 deg. counts: (12, 32) distance in steps of the model, 0 = no return.
        intensity: (12, 32).
    """
    packet = np.zeros(PACKET_BYTES, np.uint8)
    packet[:8] = np.frombuffer(MSOP_ID, np.uint8)
    packet[20:33] = np.frombuffer(_stamp_bytes(stamp_ns, model), np.uint8)
    blocks = packet[HEADER_BYTES : HEADER_BYTES + BLOCKS * BLOCK_BYTES].reshape(BLOCKS, BLOCK_BYTES)
    blocks[:, 0], blocks[:, 1] = 0xFF, 0xEE
    blocks[:, 2:4] = azimuth.astype(">u2").view(np.uint8).reshape(BLOCKS, 2)
    channels = blocks[:, 4:].reshape(BLOCKS, CHANNELS, 3)
    channels[:, :, :2] = counts.astype(">u2").view(np.uint8).reshape(BLOCKS, CHANNELS, 2)
    channels[:, :, 2] = intensity
    packet[INDEX_AT : INDEX_AT + 4] = np.frombuffer(_INDEX.pack(index & 0xFFFFFFFF), np.uint8)
    return packet.tobytes()


def date_bytes(stamp_ns: int) -> bytes:
    """The ten bytes of a time in packets of the first generation."""
    microseconds = stamp_ns // 1_000
    when = datetime.fromtimestamp(microseconds // 1_000_000, UTC)
    milliseconds, rest = divmod(microseconds % 1_000_000, 1_000)
    return _LEGACY.pack(
        max(when.year - 2000, 0), when.month, when.day, when.hour, when.minute, when.second, milliseconds, rest
    )


def _stamp_bytes(stamp_ns: int, model: Model) -> bytes:
    """Bytes 20 to 33: time, and which sensor it is."""
    if model is not BPV4:
        return date_bytes(stamp_ns) + b"\x00\x03\x01"
    seconds, rest = divmod(stamp_ns // 1_000, 1_000_000)
    return seconds.to_bytes(6, "big") + rest.to_bytes(4, "big") + b"\x00" + _TYPE_BPV4


@lru_cache(maxsize=64)
def _date_ns(date: bytes) -> int | None:
    year, month, day, hour, minute, second = date
    try:
        when = datetime(2000 + year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return calendar.timegm(when.timetuple()) * 1_000_000_000


class PacketWriter:
    """Packs blocks into packets of twelve, as the sensor does: a packet may span two revolutions."""

    def __init__(self, model: Model = BPEARL) -> None:
        self._model = model
        self._index = 0
        self._blocks: list[tuple[int, int, U16, U8]] = []

    def add(self, times_ns: I64, azimuth: U16, counts: U16, intensity: U8) -> list[tuple[int, bytes]]:
        """Packets that these blocks complete, each with the time at which the sensor would send it.

        Args:
            times_ns: (b,) of each block; two returns of one firing are two blocks of one time.
            azimuth: (b,) 0.01 deg. counts, intensity: (b, 32).
        """
        made = []
        for block in zip(times_ns.tolist(), azimuth.tolist(), counts, intensity, strict=True):
            if self._blocks and block[0] - self._blocks[-1][0] > 1.5 * self._model.block_ns:
                made += self.flush()
            self._blocks.append(block)
            if len(self._blocks) == BLOCKS:
                made += self.flush()
        return made

    def flush(self) -> list[tuple[int, bytes]]:
        """The packet of the remaining blocks, filled up with blocks that saw nothing."""
        if not self._blocks:
            return []
        time, angle, *_ = self._blocks[-1]
        empty = (time, angle, np.zeros(CHANNELS, np.uint16), np.zeros(CHANNELS, np.uint8))
        times, azimuth, counts, intensity = zip(*(self._blocks + [empty] * BLOCKS)[:BLOCKS], strict=True)
        packet = write_packet(
            times[0], np.array(azimuth, np.uint16), np.array(counts), np.array(intensity), self._model, self._index
        )
        self._index += 1
        self._blocks.clear()
        return [(time + self._model.block_ns, packet)]
