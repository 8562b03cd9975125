"""A scan back into the firings that measured it: for packets to be played out, and tests.

A packet has no coordinates, only an azimuth for every block and a distance for every channel; so the
points must lie on the rays of such a sensor. Those of a recording do, once its unit's angles are
known: `fit_angles` reads them off a few scans.
"""

from dataclasses import dataclass

import numpy as np

from app.sensors.live.difop import NOMINAL, Calibration
from app.sensors.live.msop import TURN
from app.sensors.rsbpearl import BPEARL, CHANNELS, Model
from app.slam.errors import HemislamError
from app.slam.types import F64, I64, U8, U16, Scan

_CENTI = 100.0
MISFIT_M = 0.05
"""Points this far from the ray they would have to be on (95 of 100 are closer) are not of this sensor."""
_CUT_DEG = 4.0
"""Scans that begin this near are cut where the azimuth passes 0."""
_LEAST_TURN = 30.0
"""deg; from less of a turn its speed is not read off."""
_FITS, _OUTLYING = 3, 4.0
"""Straight lines through the azimuths, each without points so many times the median beside the one before."""


@dataclass(frozen=True, slots=True)
class Firings:
    """The blocks of one revolution.

    Attributes:
        times_ns: (b,) absolute. azimuth: (b,) 0.01 deg. counts: (b, 32) distance in steps of the
            model, 0 = no return. intensity: (b, 32).
        misfit_m: 95th percentile of the distance between the points and what the packets will say.
    """

    times_ns: I64
    azimuth: U16
    counts: U16
    intensity: U8
    misfit_m: float


def firings_of(scan: Scan, calibration: Calibration = NOMINAL, model: Model = BPEARL, rate_hz: int = 10) -> Firings:
    """The blocks that give this scan, with all of the revolution between its first and its last.

    Raises:
        HemislamError: its points do not lie on the rays of such a sensor.
    """
    channel = np.argsort(calibration.rings)[np.minimum(scan.ring, CHANNELS - 1)]
    block, base_ns = _blocks(scan, channel, model)
    share = model.firing_offsets_ns[channel] / model.block_ns
    blocks = int(block.max()) + 1
    start, per_block = _turning(scan, channel, block + share, 360.0 * rate_hz * model.block_ns * 1e-9, calibration)
    raw = _CENTI * (_wrapped(start) + per_block * np.arange(blocks))
    if abs(raw[0]) < _CENTI * _CUT_DEG:  # keep the cut between the same blocks
        raw = np.clip(raw, 0, TURN - 1)
    azimuth = np.rint(raw).astype(np.int64) % TURN

    points = scan.points.astype(np.float64)
    head = np.radians(azimuth[block] / _CENTI)
    lever = np.column_stack([model.rx * np.cos(head), -model.rx * np.sin(head), np.full(len(head), model.rz)])
    elevation = np.radians(calibration.elevations_deg[channel])
    at = head + np.radians(per_block * share + calibration.horizontal_deg[channel])
    ray = np.column_stack([np.cos(elevation) * np.cos(at), -np.cos(elevation) * np.sin(at), np.sin(elevation)])
    count = np.rint(np.linalg.norm(points - lever, axis=1) / model.range_step)
    misfit = float(
        np.percentile(np.linalg.norm(lever + (count * model.range_step)[:, None] * ray - points, axis=1), 95)
    )

    counts = np.zeros((blocks, CHANNELS), np.uint16)
    intensity = np.zeros((blocks, CHANNELS), np.uint8)
    counts[block, channel] = np.clip(count, 0, 65535)
    intensity[block, channel] = np.clip(np.rint(scan.intensity), 0, 255)
    kept = np.count_nonzero(counts) / max(int(np.count_nonzero(count)), 1)
    if misfit > MISFIT_M or kept < 0.98:
        raise HemislamError(
            f"The recording's points are not those of an RS-Bpearl ({misfit:.2f} m beside its rays, {1 - kept:.0%} of "
            "them in a firing that is taken): play it out as foxglove://127.0.0.1:8765 instead."
        )
    times = base_ns + model.block_ns * np.arange(blocks, dtype=np.int64)
    return Firings(times, azimuth.astype(np.uint16), counts, intensity, misfit)


def rate_of(scans: list[Scan]) -> int:
    """Revolutions a second, 10 or 20, by how the scans follow each other."""
    starts = np.array([scan.stamp_ns for scan in scans])
    return 20 if len(starts) > 1 and np.median(np.diff(starts)) < 75_000_000 else 10


def fit_angles(scans: list[Scan], model: Model = BPEARL, rate_hz: int = 10) -> Calibration:
    """The unit's angles from a few of its scans; the nominal ones, if they explain the points."""
    elevations: list[list[F64]] = [[] for _ in range(CHANNELS)]
    sideways: list[list[F64]] = [[] for _ in range(CHANNELS)]
    late = []
    channel_of = np.argsort(NOMINAL.rings)
    for scan in scans:
        channel = channel_of[np.minimum(scan.ring, CHANNELS - 1)]
        block, _ = _blocks(scan, channel, model)
        fired = block + model.firing_offsets_ns[channel] / model.block_ns
        start, per_block = _turning(scan, channel, fired, 360.0 * rate_hz * model.block_ns * 1e-9, NOMINAL)
        head = np.radians(start + per_block * block)
        late.append(float(_wrapped(start) - np.clip(_wrapped(start), 0.0, per_block)))
        x = scan.points[:, 0] - model.rx * np.cos(head)
        y = scan.points[:, 1] + model.rx * np.sin(head)
        z = scan.points[:, 2] - model.rz
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        aside = _wrapped(np.degrees(np.arctan2(-y, x)) - start - per_block * fired)
        far = np.linalg.norm(scan.points, axis=1) > 1.0
        for c in range(CHANNELS):
            mine = far & (channel == c)
            elevations[c].append(elevation[mine])
            sideways[c].append(aside[mine])
    found = np.array([np.median(all_) if len(all_ := np.concatenate(parts)) else np.nan for parts in elevations])
    aside_deg = np.array([np.median(all_) if len(all_ := np.concatenate(parts)) else 0.0 for parts in sideways])
    found = np.where(np.isnan(found), NOMINAL.elevations_deg, found)
    # All channels' corrections and the head's azimuth together are free by a constant. Where scans are cut at 0,
    # the one that lets the first block be there is right; others would put it into the revolution before.
    if abs(begin := float(np.median(late))) < _CUT_DEG:
        aside_deg += begin
    # Near the pole a coordinate's last digit turns the azimuth by degrees: judged by its effect.
    off = np.hypot(found - NOMINAL.elevations_deg, aside_deg * np.cos(np.radians(NOMINAL.elevations_deg)))
    if off.max() < 0.03:
        return NOMINAL
    return Calibration(np.round(found, 2), np.round(aside_deg, 2))


def _blocks(scan: Scan, channel: I64, model: Model) -> tuple[I64, int]:
    """(n,) block of each point from 0, and the time of block 0."""
    since = scan.offsets_ns.astype(np.int64) - model.firing_offsets_ns[channel]
    phase = np.angle(np.exp(2j * np.pi * (since / model.block_ns)).mean()) / (2 * np.pi) * model.block_ns
    block = np.rint((since - phase) / model.block_ns).astype(np.int64)
    first = int(block.min())
    return block - first, scan.stamp_ns + round(phase + first * model.block_ns)


def _turning(scan: Scan, channel: I64, fired: F64, nominal: float, calibration: Calibration) -> tuple[float, float]:
    """Azimuth of block 0 and from block to block, degrees: what the points' azimuths agree on.

    Args:
        fired: (n,) when each point was, in blocks. nominal: degrees from block to block, about.
    """
    x, y = scan.points[:, 0].astype(np.float64), scan.points[:, 1].astype(np.float64)
    # High up the azimuth says little, and the lever much.
    good = (calibration.elevations_deg[channel] < 60.0) & (np.hypot(x, y) > 0.5)
    if not good.any():
        good = np.ones(len(x), bool)
    fired = fired[good]
    start = np.degrees(np.arctan2(-y, x))[good] - nominal * fired - calibration.horizontal_deg[channel][good]
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(start)).mean())))
    off = _wrapped(start - middle)
    # No motor turns at just its nominal speed, and 2 in 10,000 are a degree's tenth at the end of a turn.
    line = np.array([0.0, np.median(off)])
    if np.ptp(fired) > _LEAST_TURN / nominal:
        for _ in range(_FITS):
            beside = np.abs(off - np.polyval(line, fired))
            kept = beside <= _OUTLYING * np.median(beside)
            line = np.polyfit(fired[kept], off[kept], 1)
    return middle + float(line[1]), nominal + float(line[0])


def _wrapped(degrees: F64 | float) -> F64:
    """To [-180, 180)."""
    wrapped: F64 = np.mod(np.asarray(degrees) + 180.0, 360.0) - 180.0
    return wrapped
