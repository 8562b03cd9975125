"""The time of a point from its azimuth, for clouds without times: the sensor turns at a steady rate."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, F64, I64, U16

_SLACK = np.radians(10.0)
"""The azimuth may step back by this much (noise, horizontal calibration) without counting as a full turn."""

_SMALL_STEP = np.radians(60.0)
"""A step below this leads from one firing to the next; a larger one skips firings without a return."""

_FIXED = np.radians(0.7)
"""If clouds begin within this angle of each other, the driver cuts them at a fixed azimuth."""


@dataclass(frozen=True, slots=True)
class Spin:
    """How the sensor turns about its z axis.

    Attributes:
        period_s: of one revolution. clockwise: seen from +z (RoboSense) or not.
        ordered: whether the points of one ring come in firing order in the message.
        start: (rings,) rad, azimuth at which each ring's revolution begins, in the sense of rotation
            (rings differ by the channels' horizontal calibration); None: each cloud begins at an
            azimuth of its own, that of its first point.
    """

    period_s: float
    clockwise: bool
    ordered: bool
    start: tuple[float, ...] | None

    def times_ns(self, points: F32, ring: U16) -> I64:
        """(n,) int64 ns after the revolution's start, of (n, 3) points on rings (n,)."""
        azimuth = turned_azimuth(points, self.clockwise)
        if self.start is None:
            from_start = _centred(azimuth - azimuth[0])
        else:
            starts = np.asarray(self.start)
            from_start = _forward(azimuth - starts[np.minimum(ring, len(starts) - 1)])
        if self.ordered:
            order, begins, turned_by = _along_rings(azimuth, ring)
            lengths = np.diff(begins, append=len(order))
            turned_by += np.repeat(from_start[order[begins]] - turned_by[begins], lengths)
            turned = np.empty_like(turned_by)
            turned[order] = turned_by
        else:
            turned = np.maximum(from_start, 0.0)
        times: I64 = np.rint(turned / (2 * np.pi) * self.period_s * 1e9).astype(np.int64)
        return times


def settle_spin(clouds: list[tuple[F32, U16]], period_s: float) -> Spin:
    """How the sensor turns, from a few clouds ((n, 3) points, (n,) ring) in the order of the message."""
    points, ring = clouds[0]
    clockwise, turns = sense_of_rotation(points, ring)
    if not turns < 1.2:  # the order shows nothing; almost every sensor turns clockwise seen from above
        return Spin(period_s, clockwise=True, ordered=False, start=(0.0,))
    rings = 1 + max(int(ring.max()) for _, ring in clouds)
    begins: list[list[float]] = [[] for _ in range(rings)]
    for points, ring in clouds:
        azimuth = turned_azimuth(points, clockwise)
        lines, first = np.unique(ring, return_index=True)
        for line, at in zip(lines, first, strict=True):
            begins[line].append(float(azimuth[at]))
    firsts = np.array([turned_azimuth(points[:1], clockwise)[0] for points, _ in clouds])
    if np.median(np.abs(_centred(firsts - _circular_median(firsts)))) > _FIXED:
        return Spin(period_s, clockwise, ordered=True, start=None)
    common = _circular_median(np.array([value for values in begins for value in values]))
    # A ring whose first firings had no return begins late in that cloud, so the earliest begin counts.
    start = [min(_centred(np.array(values) - common), default=0.0) + common for values in begins]
    return Spin(period_s, clockwise, ordered=True, start=tuple(map(float, start)))


def turned_azimuth(points: F32, clockwise: bool) -> F64:
    """(n,) rad, azimuth of (n, 3) points, growing in the sense of rotation."""
    azimuth: F64 = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return -azimuth if clockwise else azimuth


def sense_of_rotation(points: F32, ring: U16) -> tuple[bool, float]:
    """Whether points (n, 3) in firing order turn clockwise (seen from +z), and how many turns they make.

    About one turn is a scan of a rotating sensor; many, or inf, is no rotation at all.
    """
    # Outdoors a ring may see only part of a turn, so its ends show little; the small steps show the sense.
    order = np.argsort(ring, kind="stable")
    step = _centred(np.diff(turned_azimuth(points, True)[order]))
    same = (np.diff(ring[order].astype(np.int32)) == 0) & (np.abs(step) < _SMALL_STEP) & (step != 0)
    if not same.any():
        return True, np.inf
    clockwise = bool(np.median(step[same]) > 0)
    return clockwise, _laps(points, ring, clockwise)


def share_of_turn(firsts: F32, clockwise: bool, turns: float) -> float:
    """Share of a turn that each message holds; 1 unless each begins where the previous one ends.

    Args:
        firsts: (n, 3) first point of each of n successive messages. turns: number of turns in one message.
    """
    steps = np.mod(np.diff(turned_azimuth(firsts, clockwise)), 2 * np.pi) / (2 * np.pi)
    share = float(np.median(steps)) if len(steps) else 1.0
    return share if share < 0.6 and abs(turns - share) < 0.3 * share else 1.0


def _laps(points: F32, ring: U16, clockwise: bool) -> float:
    """Turns that a typical ring makes in this order and sense."""
    _, begins, turned_by = _along_rings(turned_azimuth(points, clockwise), ring)
    ends = np.append(begins[1:], len(turned_by)) - 1
    full = ends - begins >= 8
    if not full.any():
        return np.inf
    return float(np.median((turned_by[ends] - turned_by[begins])[full])) / (2 * np.pi)


def _along_rings(azimuth: F64, ring: U16) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], F64]:
    """The angle by which the sensor has turned, summed along each ring in the order of the message, only forward.

    So a ring that sees nothing for half a turn is still placed correctly, and the last points of a revolution do not
    become its first. Returns the points' order by ring, the index in it at which each ring begins, and the angle at
    each of these ordered points (the sum continues from ring to ring).
    """
    order = np.argsort(ring, kind="stable")
    lines, sorted_azimuth = ring[order], azimuth[order]
    step = _forward(np.diff(sorted_azimuth, prepend=sorted_azimuth[:1]))
    begins = np.flatnonzero(np.append(True, lines[1:] != lines[:-1]))
    step[begins] = 0.0
    return order, begins, np.cumsum(step)


def _forward(angle: F64) -> F64:
    """Wrapped to [-slack, 360 deg - slack): a forward angle, except for noise."""
    wrapped: F64 = np.mod(angle + _SLACK, 2 * np.pi) - _SLACK
    return wrapped


def _centred(angle: F64) -> F64:
    """Wrapped to [-180 deg, 180 deg)."""
    wrapped: F64 = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return wrapped


def _circular_median(angles: F64) -> float:
    mean = float(np.angle(np.exp(1j * angles).sum()))
    return mean + float(np.median(_centred(angles - mean)))
