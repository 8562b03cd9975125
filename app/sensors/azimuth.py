"""The time of a point from its azimuth, for clouds that carry none: the sensor turns at a steady rate."""

from dataclasses import dataclass

import numpy as np

from app.slam.types import F32, I64, U16

_SLACK = np.radians(10.0)
"""Azimuth may run back by this much (noise, horizontal calibration) without counting as a full turn."""


@dataclass(frozen=True, slots=True)
class Spin:
    """How the sensor turns about its z axis.

    Attributes:
        period_s: of one revolution. clockwise: seen from +z (RoboSense) or not.
        ordered: whether the points of one ring come in firing order in the message.
        start: (rings,) rad, azimuth at which each ring's revolution begins (channels differ by
            their horizontal calibration).
    """

    period_s: float
    clockwise: bool
    ordered: bool
    start: tuple[float, ...]

    def times_ns(self, points: F32, ring: U16) -> I64:
        """(n,) int64 ns after the revolution's begin, of (n, 3) points on rings (n,)."""
        sense = -1.0 if self.clockwise else 1.0
        starts = np.asarray(self.start)
        azimuth = sense * np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        from_start = np.mod(azimuth - sense * starts[np.minimum(ring, len(starts) - 1)] + _SLACK, 2 * np.pi) - _SLACK
        if not self.ordered:
            turned = np.maximum(from_start, 0.0)
        else:
            # Walk along each ring and only ever forward: a ring that sees nothing for half a turn is
            # still placed rightly, and the last points do not become the first.
            order = np.argsort(ring, kind="stable")
            sorted_ring, sorted_azimuth = ring[order], azimuth[order]
            step = np.mod(np.diff(sorted_azimuth, prepend=sorted_azimuth[0]) + _SLACK, 2 * np.pi) - _SLACK
            begins = np.flatnonzero(np.diff(sorted_ring, prepend=sorted_ring[0] + np.uint16(1)))
            step[begins] = 0.0
            walked = np.cumsum(step)
            lengths = np.diff(begins, append=len(order))
            walked += np.repeat(from_start[order[begins]] - walked[begins], lengths)
            turned = np.empty_like(walked)
            turned[order] = walked
        return np.rint(turned / (2 * np.pi) * self.period_s * 1e9).astype(np.int64)
