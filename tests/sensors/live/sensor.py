"""An RS-Bpearl built only with `struct` and `math` from the vendor's specification, without the code under test."""

import datetime
import functools
import math
import struct
from itertools import chain

START = datetime.datetime(2026, 3, 1, 12, 0, 0, tzinfo=datetime.UTC)
START_NS = int(START.timestamp()) * 10**9

ELEVATIONS = [
    89.5, 81.0625, 78.25, 72.625, 67.0, 61.375, 55.75, 50.125, 86.6875, 83.875, 75.4375, 69.8125, 64.1875, 58.5625,
    52.9375, 47.3125, 44.5, 38.875, 33.25, 27.625, 22.0, 16.375, 10.75, 5.125, 41.6875, 36.0625, 30.4375, 24.8125,
    19.1875, 13.5625, 7.9375, 2.3125,
]  # fmt: skip
OFFSETS_US = [
    0.00, 2.56, 5.12, 7.68, 10.24, 12.80, 15.36, 17.92, 25.68, 28.24, 30.80, 33.36, 35.92, 38.48, 41.04, 43.60,
    1.28, 3.84, 6.40, 8.96, 11.52, 14.08, 16.64, 19.20, 26.96, 29.52, 32.08, 34.64, 37.20, 39.76, 42.32, 44.88,
]  # fmt: skip

Block = tuple[int, list[tuple[int, int]]]
"""Azimuth in 0.01 deg, and 32 times (distance in steps, intensity)."""
BLOCK = struct.Struct(">2sH" + 32 * "HB")


def msop(stamp_ns: int, blocks: list[Block], *, v4: bool = False, index: int = 0) -> bytes:
    """A packet by the table of its bytes."""
    assert len(blocks) == 12
    us = stamp_ns // 1000
    if v4:
        time = struct.pack(">HI", us // 10**6 >> 32, us // 10**6 & 0xFFFFFFFF) + struct.pack(">I", us % 10**6)
    else:
        when = datetime.datetime.fromtimestamp(us // 10**6, datetime.UTC)
        time = struct.pack(
            ">BBBBBBHH", when.year - 2000, when.month, when.day, when.hour, when.minute, when.second,
            us % 10**6 // 1000, us % 1000,
        )  # fmt: skip
    head = bytes.fromhex("55aa050a5aa550a0") + bytes(12) + time + bytes([0, 3, 4] if v4 else [0, 3, 1]) + bytes(9)
    body = b"".join(BLOCK.pack(b"\xff\xee", azimuth, *chain.from_iterable(channels)) for azimuth, channels in blocks)
    packet = head + body + struct.pack(">IH", index, 0)
    assert len(packet) == 1248
    return packet


def difop(
    *, rpm: int = 600, reverse: bool = False, angles: list[tuple[float, float]] | None = None, mode: int = 1
) -> bytes:
    """A device packet; `angles`: elevation and horizontal correction, deg, by channel."""
    packet = bytearray(1248)
    packet[:8] = bytes.fromhex("a5ff005a11115555")
    struct.pack_into(">H", packet, 8, rpm)
    struct.pack_into(">HH", packet, 32, 0, 36000)
    packet[300], packet[337] = mode, reverse
    packet[468:660] = b"\xff" * 192
    for channel, pair in enumerate(angles or []):
        for at, angle in zip((468, 564), pair, strict=True):
            struct.pack_into(">BH", packet, at + 3 * channel, angle < 0, round(abs(angle) * 100))
    return bytes(packet)


def point(
    azimuth_deg: float, step_deg: float, channel: int, distance: float, *, v4: bool = False,
    angles: list[tuple[float, float]] | None = None,
) -> tuple[float, float, float]:  # fmt: skip
    """Where a firing hit, by the vendor's formula. Azimuths as the sensor turns."""
    elevation, aside = angles[channel] if angles else (ELEVATIONS[channel], 0.0)
    rx, rz = (0.01619, 0.09571) if v4 else (0.01473, 0.09427)
    share = channel * 1.668 / 55.56 if v4 else OFFSETS_US[channel] / 55.52
    e, block = math.radians(elevation), math.radians(azimuth_deg)
    turned = math.radians(azimuth_deg + step_deg * share + aside)
    return (
        distance * math.cos(e) * math.cos(turned) + rx * math.cos(block),
        -distance * math.cos(e) * math.sin(turned) - rx * math.sin(block),
        distance * math.sin(e) + rz,
    )


@functools.lru_cache
def turns(
    count: int, *, rate: int = 10, v4: bool = False, start_ns: int = START_NS, fov: tuple[int, int] = (0, 36000),
    dual: bool = False, distance: int = 1000,
) -> list[bytes]:  # fmt: skip
    """The packets of so many revolutions; the distance tells the revolution (steps), the intensity the channel.

    fov: 0.01 deg; outside of it the sensor is blind and sends nothing. dual: the second return is 7 steps further,
    but equal to the first one on channel 0.
    """
    block_ns = 55_560 if v4 else 55_520
    per_turn = 10**9 // rate // block_ns
    firings: list[tuple[int, Block]] = []
    for turn in range(count):
        first = [(distance + turn, channel) for channel in range(32)]
        second = [(distance + turn + 7 * (channel > 0), channel) for channel in range(32)]
        for number in range(per_turn):
            azimuth = number * 36000 // per_turn
            if not fov[0] <= azimuth < fov[1]:
                continue
            time = start_ns + (turn * per_turn + number) * block_ns
            firings.append((time, (azimuth, first)))
            if dual:
                firings.append((time, (azimuth, second)))
    packets = []
    for index, at in enumerate(range(0, len(firings) - 11, 12)):
        packets.append(msop(firings[at][0], [block for _, block in firings[at : at + 12]], v4=v4, index=index))
    return packets
