"""The scanners that can be simulated. Each has one entry in `SCANNERS` and one function that makes its firings."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app.sensors import robosense, ros
from app.sensors.presets import PRESETS
from app.sensors.robosense import AIRY
from app.sensors.simulator.lidar import Lidar, Pattern, firing_pattern, turning
from app.sensors.simulator.trajectory import GRAVITY, R_BODY_IMU
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import F64

PatternOfTurn = Callable[[int], Pattern]
"""The firings of the k-th scan."""

_RATE_HZ = 10
_RING_DEG = 2.0
_MID360_RATE_HZ = 200_000
_MID360_BLOCK = 20
"""Number of firings within which the motion counts as straight: 0.1 ms."""
_MID360_LASERS = 4


@dataclass(frozen=True, slots=True)
class Scanner:
    """A LiDAR with its IMU, and how its driver writes both.

    Attributes:
        patterns: (rate in Hz, fire every k-th block, folder with the maker's tables) -> firings of its scans.
        upright: held with the LiDAR's z up and its x forward; otherwise with its z forward and its x down.
        lidar: its mounting, range and noise. rates_hz: its possible scan rates.
        layout: of its recordings. accel_unit: m/s² per unit of acceleration in its driver's output.
    """

    patterns: Callable[[int, int, Path | None], PatternOfTurn]
    lidar: Lidar
    upright: bool = False
    rates_hz: tuple[int, ...] = (_RATE_HZ,)
    layout: ros.Layout = field(default_factory=ros.Layout)
    accel_unit: float = 1.0

    @property
    def R_body_imu(self) -> F64:
        """Rotation of the IMU in the walker's frame: x forward, y left, z up."""
        R_body_lidar = np.eye(3) if self.upright else R_BODY_IMU
        return np.asarray(R_body_lidar @ self.lidar.R_imu_lidar.T)


def _bpearl(rate_hz: int, every_block: int, _: Path | None) -> PatternOfTurn:
    pattern = firing_pattern(robosense.BPEARL, rate_hz, every_block)
    return lambda turn: pattern


def _airy(rate_hz: int, every_block: int, _: Path | None) -> PatternOfTurn:
    """A RoboSense Airy: 96 channels that fire eight at a time over a hemisphere."""
    elevation, still = np.radians(AIRY.elevations_deg), np.zeros(AIRY.channels)
    pattern = turning(elevation, still, AIRY.firing_offsets_ns, AIRY.block_ns, rate_hz, every_block, AIRY.rx, AIRY.rz)
    return lambda turn: pattern


def _jt128(rate_hz: int, every_block: int, tables: Path | None) -> PatternOfTurn:
    """A Hesai JT128: 128 channels with large azimuth steps [HesaiLidar_SDK_2.0, angles and firing times]."""
    folder = _tables(tables, "jt128_angles.csv", "jt128_firetimes.csv")
    _, firing_us = _table(folder / "jt128_firetimes.csv", 128, 2).T
    firing_ns = np.rint(firing_us * 1000).astype(np.int64)
    _, elevation, azimuth = np.radians(_table(folder / "jt128_angles.csv", 128, 3)).T
    pattern = turning(elevation, azimuth, firing_ns, round(1e9 / _RATE_HZ / 900), rate_hz, every_block)
    return lambda turn: pattern


def _mid360(rate_hz: int, every_block: int, tables: Path | None) -> PatternOfTurn:
    """A Livox Mid-360: its pattern of 4 s, which does not repeat from scan to scan."""
    pattern = _table(_tables(tables, "mid360_pattern.npy") / "mid360_pattern.npy", 1, 2)
    firings = _MID360_RATE_HZ // rate_hz
    starts = np.arange(0, firings // _MID360_BLOCK, every_block, dtype=np.int64) * _MID360_BLOCK
    fired = (starts[:, None] + np.arange(_MID360_BLOCK)).ravel()
    ns = 1_000_000_000 // _MID360_RATE_HZ

    def scan(turn: int) -> Pattern:
        azimuth, elevation = pattern[(turn * firings + fired) % len(pattern)].T
        level = np.cos(elevation)
        directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        rings = np.maximum((np.degrees(elevation) + 7.5) / _RING_DEG, 0).astype(np.uint16)
        levers = np.zeros_like(directions)
        return Pattern(fired * ns, directions, levers, rings, starts * ns, _MID360_BLOCK * ns, _MID360_LASERS)

    return scan


def _tables(folder: Path | None, *names: str) -> Path:
    """The folder, if it holds these files. Raises HemislamError otherwise."""
    missing = [name for name in names if folder is None or not (folder / name).is_file()]
    if folder is None or missing:
        raise HemislamError(
            f"This scanner is simulated from its maker's tables ({', '.join(missing)}); "
            "name the folder that holds them: --tables FOLDER."
        )
    return folder


def _table(path: Path, rows: int, columns: int) -> F64:
    """The numbers in a file: a .csv of this shape below its heading, or an .npy with at least this many rows.

    Raises HemislamError: the file holds no such table.
    """
    try:
        if path.suffix == ".csv":
            table = np.genfromtxt(path, delimiter=",", skip_header=1, max_rows=rows)
        else:
            table = np.load(path).astype(np.float64)
    except (OSError, EOFError, ValueError, TypeError, AttributeError):
        table = np.empty((0, 0))
    if table.ndim != 2 or len(table) < rows or table.shape[1] != columns or not np.isfinite(table).all():
        raise HemislamError(f"{path} is not the maker's table; copy it again.")
    return np.asarray(table)


def _hesai(scan: Any) -> bytes:
    return ros.serialised(ros.cloud_message(scan, stamp_ns=scan.stamp_ns, frame="hesai_lidar"))


SCANNERS: dict[str, Scanner] = {
    "bpearl": Scanner(_bpearl, Lidar(), rates_hz=robosense.ROTATION_RATES_HZ),
    "airy": Scanner(
        _airy,
        Lidar(lie.from_rpy_degrees(PRESETS["airy"]["sensor"]["rotation"]), np.zeros(3)),
        layout=ros.AIRY_LAYOUT,
        accel_unit=GRAVITY,
    ),
    "jt128": Scanner(
        _jt128,
        Lidar(p_imu_lidar=np.zeros(3), farthest=60.0),
        layout=ros.Layout("/lidar_points", "/lidar_imu", encode=_hesai),
    ),
    "mid360": Scanner(
        _mid360,
        Lidar(
            p_imu_lidar=np.array(PRESETS["mid360"]["sensor"]["translation"]),
            farthest=70.0,
            rated=(40.0, 0.1),
            range_noise=0.01,
            coordinate_step=0.001,
        ),
        upright=True,
        layout=ros.MID360_LAYOUT,
        accel_unit=GRAVITY,
    ),
}
"""Scanners by name. `bpearl` is an RS-Bpearl on H2LID's IMU. The others have their own IMU; an Airy and a JT128 are
held like the RS-Bpearl, a Mid-360 upright. Rated ranges and noise are from the data sheets."""
