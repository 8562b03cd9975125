"""Facts about RoboSense's hemispherical scanners: their firing patterns, geometry, units and packets.

Source: the vendor's open driver (rs_driver: decoder_RSBP.hpp, decoder_RSAIRY.hpp, chan_angles.hpp), data sheets and the
Airy's manual. The simulator and the decoder of packets both use them. Constants without a model are the RS-Bpearl's.

Frame of the sensor: x, y in the base plane, +z the pole of the hemisphere; azimuth turns from +x towards -y. A block is
one firing of all 32 channels, which fire one after the other while the head turns, so every firing has its own time and
azimuth.
"""

from dataclasses import dataclass, field

import numpy as np

from app.slam.types import F64, I64

CHANNELS = 32

ELEVATIONS_DEG: F64 = np.array(
    [
        89.5, 81.0625, 78.25, 72.625, 67.0, 61.375, 55.75, 50.125, 86.6875, 83.875, 75.4375, 69.8125, 64.1875,
        58.5625, 52.9375, 47.3125, 44.5, 38.875, 33.25, 27.625, 22.0, 16.375, 10.75, 5.125, 41.6875, 36.0625,
        30.4375, 24.8125, 19.1875, 13.5625, 7.9375, 2.3125,
    ]
)  # fmt: skip
"""(32,) nominal elevation above the base plane by channel; those of each unit are in its DIFOP packet."""

MIN_RANGE_M, MAX_RANGE_M = 0.1, 100.0
RATED_RANGE_M, RATED_REFLECTIVITY = 30.0, 0.1
"""By the data sheet: 30 m on a target that reflects 10 %."""

ROTATION_RATES_HZ = (10, 20)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The constants of one model.

    Attributes:
        range_step: m per count of a packet's distance. block_ns: duration of a block.
        firing_offsets_ns: (c,) firing time of each channel inside its block.
        rx, rz: m, lever of the laser: a point is d * direction + (rx cos a, -rx sin a, rz) with
            the BLOCK's azimuth a.
        elevations_deg: (c,) nominal, by channel. mark: the bytes that its packets begin with. blocks: of a packet.
        part: channels that follow one azimuth in a packet. counted: bits of a distance; others are a flag.
        index_at: where the four bytes of a packet's number are.
    """

    name: str
    range_step: float
    block_ns: int
    firing_offsets_ns: I64
    rx: float
    rz: float
    elevations_deg: F64 = field(default_factory=lambda: ELEVATIONS_DEG)
    mark: bytes = bytes.fromhex("55aa050a5aa550a0")
    blocks: int = 12
    part: int = CHANNELS
    counted: int = 0xFFFF
    index_at: int = 1242

    @property
    def channels(self) -> int:
        return len(self.elevations_deg)

    @property
    def parts(self) -> int:
        """Number of parts into which a packet divides a block."""
        return self.channels // self.part

    @property
    def part_bytes(self) -> int:
        return 4 + 3 * self.part


def _offsets_us(*values: float) -> I64:
    return np.rint(np.array(values) * 1000.0).astype(np.int64)


BPEARL = Model(
    name="RS-Bpearl",
    range_step=0.005,
    block_ns=55_520,
    firing_offsets_ns=_offsets_us(
        0.00, 2.56, 5.12, 7.68, 10.24, 12.80, 15.36, 17.92, 25.68, 28.24, 30.80, 33.36, 35.92, 38.48, 41.04, 43.60,
        1.28, 3.84, 6.40, 8.96, 11.52, 14.08, 16.64, 19.20, 26.96, 29.52, 32.08, 34.64, 37.20, 39.76, 42.32, 44.88,
    ),
    rx=0.01473,
    rz=0.09427,
)  # fmt: skip

BPV4 = Model(
    name="BPv4",
    range_step=0.0025,
    block_ns=55_560,
    firing_offsets_ns=_offsets_us(*(1.668 * channel for channel in range(CHANNELS))),
    rx=0.01619,
    rz=0.09571,
)

AIRY = Model(
    name="Airy",
    range_step=0.005,
    block_ns=111_080,
    firing_offsets_ns=np.repeat(
        _offsets_us(0.0, 7.616, 16.184, 24.752, 33.32, 42.84, 52.36, 61.88, 71.4, 79.968, 88.536, 97.104), 8
    ),
    rx=float(np.hypot(0.0108, 0.00375)),
    rz=0.06056,
    elevations_deg=(np.arange(96) + 0.5) * 90.0 / 96,
    mark=bytes.fromhex("55aa055a"),
    blocks=4,
    part=48,
    counted=0x3FFF,
    index_at=12,
)
"""The Airy. Its nominal elevations are evenly spaced; each unit states its own."""


def rays(elevation: F64, azimuth: F64) -> F64:
    """(n, 3) unit vectors at these elevations above the base plane and azimuths (n,), rad."""
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), -level * np.sin(azimuth), np.sin(elevation)])


def levers(azimuth: F64, radial: float, height: float) -> F64:
    """(n, 3) m, positions of the lasers at these azimuths (n,) of the head, rad."""
    return np.column_stack([radial * np.cos(azimuth), -radial * np.sin(azimuth), np.full(len(azimuth), height)])
