"""Edge and planar points of a scan, by the curvature of its scan lines (LOAM's section V.A).

Zhang and Singh, "LOAM: Lidar Odometry and Mapping in Real-time", RSS 2014.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d  # type: ignore[attr-defined]  # scipy ships no types

from app.slam import lie
from app.slam.types import F64, I64, Mask, Scan

REACH = 5
"""Number of neighbours on each side of a point from which its curvature is computed."""
SECTORS = 6
"""Number of equal sectors of each scan line, so that features come from all directions."""
EDGES, PLANES = 2, 4
"""Number of the sharpest and of the flattest points in each sector to match with the previous scan."""
MORE_EDGES = 12
"""Number of edge points in each sector to add to the map."""
SHARP, FLAT = 0.4, 0.2
"""Curvature, without unit, above which a point may be an edge, and below which it may lie on a plane. A right angle
seen along its bisector has 0.7."""
NOISE_M = 0.04
"""Distance between a point and the mean of its neighbours that noise alone may cause."""
OCCLUSION = 0.1
"""Relative difference of two neighbours' ranges above which the nearer surface hides the farther one."""
GRAZING = 8.0
"""Ratio of the neighbours' distance to that on a surface seen head-on, above which the beam grazes the surface."""
GAP = 3.5
"""Ratio of the angle between neighbours to the usual angle, above which returns are missing in between."""


@dataclass(frozen=True, slots=True)
class FeaturePoints:
    """Points of a scan, with the data needed for matching.

    Attributes:
        points: (n, 3) m, LiDAR frame at each point's own time. lines: (n,) scan line. shares: (n,) 0-1, time of each
            point as a share of the time from the scan's first point to its last.
    """

    points: F64
    lines: I64
    shares: F64

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: Mask | I64) -> "FeaturePoints":
        return FeaturePoints(self.points[which], self.lines[which], self.shares[which])

    def seen_at_end(self, motion: F64) -> "FeaturePoints":
        """As `Features.seen_at_end`."""
        return FeaturePoints(undistorted(self.points, self.shares, motion), self.lines, self.shares)


@dataclass(frozen=True, slots=True)
class Features:
    """`edges` and `planes` hold the few best points; `edge_map` and `plane_map` hold these and many more."""

    edges: FeaturePoints
    planes: FeaturePoints
    edge_map: FeaturePoints
    plane_map: FeaturePoints

    def seen_at_end(self, motion: F64) -> "Features":
        """All points in the LiDAR frame at the scan's end, if it moved by T_begin_end (4, 4) at constant velocity."""
        return Features(*(getattr(self, name).seen_at_end(motion) for name in Features.__slots__))


def undistorted(points: F64, shares: F64, motion: F64) -> F64:
    """(n, 3) points in the frame at the scan's end, each measured at a share (n,) of the motion T_begin_end."""
    R = lie.exp((shares - 1)[:, None] * lie.log(motion[:3, :3]))
    back = np.asarray(motion[:3, :3].T @ motion[:3, 3])
    return np.asarray(np.einsum("nij,nj->ni", R, points) + (shares - 1)[:, None] * back)


def extract(scan: Scan, near: float, far: float) -> Features:
    """The features of a scan within `near` to `far` m. A scan without lines is divided into rings by elevation."""
    ranges = np.linalg.norm(scan.points, axis=1)
    kept = np.flatnonzero((ranges >= near) & (ranges <= far))
    points = scan.points[kept].astype(np.float64)
    around = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((around, scan.ring[kept]))
    offsets = scan.offsets_ns[kept[order]]
    lines = scan.ring[kept[order]].astype(np.int64)
    whole = FeaturePoints(points[order], lines, offsets / max(float(scan.offsets_ns.max(initial=0)), 1.0))
    if len(whole) <= 2 * REACH:
        nothing = whole.chosen(np.zeros(0, np.int64))
        return Features(nothing, nothing, nothing, nothing)

    curvature, bend, measured = curvatures(whole)
    hidden = unreliable(whole)
    sectors = _sectors(lines)
    sharp = measured & ~hidden & (curvature > SHARP) & (bend > NOISE_M)
    sharp &= curvature >= maximum_filter1d(np.where(sharp, curvature, 0.0), REACH)
    flat = measured & ~hidden & ((curvature < FLAT) | (bend < NOISE_M))
    flattest = flat & (curvature <= minimum_filter1d(np.where(flat, curvature, np.inf), REACH))
    edge_rank = _ranks(sectors, -curvature, sharp)
    return Features(
        whole.chosen(edge_rank < EDGES),
        whole.chosen(_ranks(sectors, curvature, flattest) < PLANES),
        whole.chosen(edge_rank < MORE_EDGES),
        whole.chosen(flat),
    )


def curvatures(cloud: FeaturePoints) -> tuple[F64, F64, Mask]:
    """Curvature of points sorted by line and azimuth.

    c = |sum over neighbours j of (X_i - X_j)| / sum of |X_i - X_j|. Eq. 1 divides by the range instead, which mistakes
    an oblique wall for an edge if the scanner's azimuth steps are large.

    Returns:
        (n,) curvature, 0-1. (n,) m, distance to the mean of the neighbours. (n,) mask of the points that have both.
    """
    n = len(cloud)
    difference, reach = np.zeros((n, 3)), np.zeros(n)
    for shift in (*range(-REACH, 0), *range(1, REACH + 1)):
        apart = cloud.points - np.roll(cloud.points, shift, axis=0)
        difference += apart
        reach += np.linalg.norm(apart, axis=1)
    measured = np.zeros(n, np.bool_)
    measured[REACH : n - REACH] = cloud.lines[2 * REACH :] == cloud.lines[: n - 2 * REACH]
    length = np.linalg.norm(difference, axis=1)
    return length / np.maximum(reach, 1e-9), length / (2 * REACH), measured


def unreliable(cloud: FeaturePoints) -> Mask:
    """(n,) mask of points beside a gap, behind a nearer surface, or on a surface grazed by the beam (Fig. 4)."""
    ranges = np.linalg.norm(cloud.points, axis=1)
    directions = cloud.points / ranges[:, None]
    step = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    same = np.diff(cloud.lines) == 0
    gap = same & (step > GAP * _usual(step, cloud.lines[1:], same))
    jump = np.where(same, np.diff(ranges), 0.0)
    occluded = np.abs(jump) > OCCLUSION * np.minimum(ranges[1:], ranges[:-1])
    bad = np.zeros(len(cloud), np.bool_)
    for back in range(REACH):  # i and i + 1 are the neighbours of pair i
        after, before = slice(back + 1, None), slice(None, len(bad) - 1 - back)
        rest = slice(None, len(gap) - back)
        bad[after] |= (gap | occluded & (jump > 0))[rest]
        bad[before] |= (gap | occluded & (jump < 0))[back:]
    apart = np.linalg.norm(np.diff(cloud.points, axis=0), axis=1)
    along = apart > GRAZING * step * np.minimum(ranges[1:], ranges[:-1])
    bad[1:-1] |= along[1:] & along[:-1]
    return bad


def _usual(step: F64, lines: I64, same: Mask) -> F64:
    """(n,) for each of the steps (n,), the median on its line."""
    usual = np.zeros(int(lines.max()) + 1)
    for line in np.unique(lines):
        steps = step[(lines == line) & same]
        usual[line] = np.median(steps) if len(steps) else 0.0
    return np.asarray(usual[lines])


def _sectors(lines: I64) -> I64:
    """(n,) number of each point's sector, for sorted lines."""
    begins = np.searchsorted(lines, lines)
    counts = np.searchsorted(lines, lines, side="right") - begins
    return np.asarray(lines * SECTORS + (np.arange(len(lines)) - begins) * SECTORS // counts)


def _ranks(sectors: I64, values: F64, candidates: Mask) -> I64:
    """(n,) rank of each candidate in its sector, smallest value first; a huge rank for other points."""
    ranks = np.full(len(sectors), np.iinfo(np.int64).max)
    index = np.flatnonzero(candidates)
    order = index[np.lexsort((values[index], sectors[index]))]
    ranks[order] = np.arange(len(order)) - np.searchsorted(sectors[order], sectors[order])
    return ranks
