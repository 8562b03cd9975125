"""From a scan back to the firings that measured it, so that a recording can be played as packets.

A packet has no coordinates, only an azimuth for every block and a distance for every channel. So the points must lie on
the rays of such a sensor. The points of a recording do, once the angles of its unit are known, which `fit_angles`
estimates from a few scans.
"""

from dataclasses import dataclass

import numpy as np

from app.sensors.live.difop import NOMINAL, ChannelAngles
from app.sensors.live.msop import TURN, Firings
from app.sensors.robosense import BPEARL, Model, levers, rays
from app.slam.errors import HemislamError
from app.slam.types import F64, I64, Scan

_CENTI = 100.0
MISFIT_M = 0.05
"""If 5 of 100 points are farther than this from their rays, the scan is from another sensor."""
_CUT_DEG = 4.0
"""If scans seem to begin at most this much before azimuth 0, they begin at 0, and the angles are off by as much."""
_CUT_BLOCKS = 2
"""Ends of a scan at most this far beyond azimuth 0 are moved into the revolution."""
_LEAST_TURN_DEG = 30.0
"""A shorter part of a turn does not determine its speed."""


def firings_of(scan: Scan, calibration: ChannelAngles = NOMINAL, model: Model = BPEARL, rate_hz: int = 10) -> Firings:
    """The blocks of this scan: all from its first to its last, including those without a return.

    Raises:
        HemislamError: its points do not lie on the rays of such a sensor.
    """
    turn = _turn(scan, calibration, model, rate_hz)
    channel, block = turn.channel, turn.block
    order = np.arange(int(block.max()) + 1)
    raw = _CENTI * (_wrapped(turn.start_deg) + turn.step_deg * order)
    slack = _CUT_BLOCKS * _CENTI * turn.step_deg
    if -slack < raw[0]:
        raw = np.maximum(raw, order)  # one count each: equal ones would be two returns of one firing
    if raw[-1] < TURN + slack:
        raw = np.minimum(raw, TURN - 1 - order[::-1])
    azimuth = np.rint(raw).astype(np.int64) % TURN

    points = scan.points.astype(np.float64)
    head = np.radians(azimuth[block] / _CENTI)
    lever = levers(head, model.rx, model.rz)
    elevation = np.radians(calibration.elevations_deg[channel])
    at = head + np.radians(turn.step_deg * turn.share + calibration.horizontal_deg[channel])
    ray = rays(elevation, at)
    count = np.rint(np.linalg.norm(points - lever, axis=1) / model.range_step)
    misfit = float(
        np.percentile(np.linalg.norm(lever + (count * model.range_step)[:, None] * ray - points, axis=1), 95)
    )

    counts = np.zeros((len(order), model.channels), np.uint16)
    intensity = np.zeros((len(order), model.channels), np.uint8)
    counts[block, channel] = np.clip(count, 0, model.counted)
    intensity[block, channel] = np.clip(np.rint(scan.intensity), 0, 255)
    kept = np.count_nonzero(counts) / max(int(np.count_nonzero(count)), 1)
    if misfit > MISFIT_M or kept < 0.98:
        raise HemislamError(
            f"The recording's points are not those of an {model.name} ({misfit:.2f} m beside its rays, {1 - kept:.0%} "
            "of them in a firing that has a point already): play it out as foxglove://127.0.0.1:8765 instead."
        )
    times = turn.base_ns + model.block_ns * order.astype(np.int64)
    return Firings(times, azimuth.astype(np.uint16), counts, intensity)


def rate_of(scans: list[Scan]) -> int:
    """Revolutions a second, 10 or 20, by the interval of the scans."""
    starts = np.array([scan.stamp_ns for scan in scans])
    return 20 if len(starts) > 1 and np.median(np.diff(starts)) < 75_000_000 else 10


def fit_angles(scans: list[Scan], model: Model = BPEARL, rate_hz: int = 10) -> ChannelAngles:
    """The unit's angles from a few of its scans; the nominal ones if they explain the points.

    Its channels must be in the nominal order: points have a ring, but no channel.
    """
    nominal = ChannelAngles.nominal(model)
    seen, starts = [], []
    for scan in scans:
        turn = _turn(scan, nominal, model, rate_hz)
        head = np.radians(turn.start_deg + turn.step_deg * turn.block)
        starts.append(float(_wrapped(turn.start_deg)))
        x, y, z = (scan.points - levers(head, model.rx, model.rz)).T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        aside = _wrapped(np.degrees(np.arctan2(-y, x) - head) - turn.step_deg * turn.share)
        far = np.linalg.norm(scan.points, axis=1) > 1.0
        seen.append(np.array([turn.channel, elevation, aside])[:, far])
    channel, elevation, aside = np.concatenate(seen, axis=1)
    elevations, sideways = nominal.elevations_deg.copy(), nominal.horizontal_deg.copy()
    for c in np.unique(channel).astype(int):
        elevations[c], sideways[c] = np.median(elevation[channel == c]), np.median(aside[channel == c])
    # Near the pole a coordinate's last digit changes the azimuth by degrees, so its effect is judged.
    off = np.hypot(elevations - nominal.elevations_deg, sideways * np.cos(np.radians(nominal.elevations_deg)))
    if off.max() < 0.03:
        return nominal
    # The head's azimuth and the corrections are only known up to a common constant. Where revolutions are cut at 0, it
    # is such that none begins before; a scan that begins later may have had no return until then.
    if -_CUT_DEG < (start := min(starts)) < 0.0:
        sideways += start
    return ChannelAngles(np.round(elevations, 2), np.round(sideways, 2))


@dataclass(frozen=True, slots=True)
class _Turn:
    """How the head turned while a scan was taken.

    Attributes:
        channel: (n,) of each point. block: (n,) from 0. share: (n,) of the block's duration at which it fired.
        base_ns: time of block 0. start_deg: its azimuth. step_deg: azimuth from block to block.
    """

    channel: I64
    block: I64
    share: F64
    base_ns: int
    start_deg: float
    step_deg: float


def _turn(scan: Scan, calibration: ChannelAngles, model: Model, rate_hz: int) -> _Turn:
    """The turn that fits the points' times and azimuths."""
    channel = np.argsort(calibration.rings)[np.minimum(scan.ring, model.channels - 1)]
    block, base_ns = _blocks(scan, channel, model)
    share = model.firing_offsets_ns[channel] / model.block_ns
    step = 360.0 * rate_hz * model.block_ns * 1e-9
    x, y = scan.points[:, 0].astype(np.float64), scan.points[:, 1].astype(np.float64)
    flat = np.hypot(x, y)
    # Near the zenith the azimuth is uncertain, and the lever matters.
    good = (calibration.elevations_deg[channel] < 60.0) & (flat > 0.5)
    if not good.any():
        good = np.ones(len(x), bool)
    fired, which = (block + share)[good], channel[good]
    start = np.degrees(np.arctan2(-y, x))[good] - step * fired - calibration.horizontal_deg[which]
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(start)).mean())))
    off = _wrapped(start - middle)
    # No motor turns at exactly its nominal speed, and 2 in 10,000 make a tenth of a degree at the end of a turn.
    # Each channel is fitted with an intercept of its own, so that unknown corrections do not matter.
    faster = _slope(fired, off, which, _LEAST_TURN_DEG / step)
    return _Turn(channel, block, share, base_ns, middle + float(np.median(off - faster * fired)), step + faster)


def _blocks(scan: Scan, channel: I64, model: Model) -> tuple[I64, int]:
    """(n,) block of each point from 0, and the time of block 0."""
    since = scan.offsets_ns.astype(np.int64) - model.firing_offsets_ns[channel]
    phase = np.angle(np.exp(2j * np.pi * (since / model.block_ns)).mean()) / (2 * np.pi) * model.block_ns
    block = np.rint((since - phase) / model.block_ns).astype(np.int64)
    first = int(block.min())
    return block - first, scan.stamp_ns + round(phase + first * model.block_ns)


def _slope(x: F64, y: F64, group: I64, least: float) -> float:
    """Slope of y over x (n,) by least squares, an intercept for each group; 0 if x spreads over less than `least`."""
    count = np.maximum(np.bincount(group), 1)
    x, y = (v - (np.bincount(group, v) / count)[group] for v in (x, y))
    spread = float(x @ x)
    return float(x @ y) / spread if spread > len(x) * least**2 / 12.0 else 0.0  # the variance of a uniform spread


def _wrapped(degrees: F64 | float) -> F64:
    """To [-180, 180)."""
    wrapped: F64 = np.mod(np.asarray(degrees) + 180.0, 360.0) - 180.0
    return wrapped
