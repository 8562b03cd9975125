"""Verification: register one submap to another and measure the evidence for the result.

Point to plane, between points whose surroundings are flat in both submaps and face the same way: the two sides of a
wall, seen on the way there and on the way back, are often nearer to each other than the error of a guess. small_gicp
finds the neighbours, on one thread, so that the result is the same every time.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp

from app.slam import lie
from app.slam.kernels import patches, small, submaps
from app.slam.loops.submap import Submap
from app.slam.types import F64, I64, Mask

ONE_THREAD = 1
"""Results must not depend on the order in which threads finish."""
NEIGHBOURS = 10
"""Points of a patch, to estimate its normal."""
FLAT_M = 0.04
"""A patch is flat if its points spread less than this along the normal (standard deviation)."""
LEVEL = 0.8
"""Least cosine between the vertical and the normal of ground or ceiling."""
FACING = 0.7
"""Least cosine between the normals of corresponding points."""
COARSE, FINE = (1.2, 0.3, 8), (0.5, 0.08, 12)
"""Passes: reach of correspondences, m; residual from which they count less, m; most iterations."""
ENOUGH = 2e-4
"""Change (rad, m) that ends a pass."""
MOST_POINTS, FEW_POINTS = 2500, 800
"""Points of the source that take part in a registration, and in a rough one; all flat points are judged."""
FITS_M = 0.15
"""A point this near to the plane of its partner fits, roughly."""
PARTNER_M = 0.3
"""A point with another within this distance in the other submap has a partner."""
COMMON = 0.75
"""Overlap is judged on points within this share of the reach from both keyframes, where both submaps are dense."""
BARE = 0.05
"""A place is bare if less than this share of its flat points is upright."""
LEAST_UPRIGHT = 50
"""With fewer upright points than this near both keyframes, overlap is not evidence."""
DISTURBANCE_M = 0.4
"""How far the test for sliding pushes the result along its weakest direction."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A submap ready to be registered.

    Attributes:
        points: (n, 3). normals: (n, 3) unit, towards where the point was seen from.
        flat: (n,) bool. level: (n,) whether ground. upright: (n,) whether neither ground nor ceiling.
        tree: over the points; None if there are none. chosen, few: indices of flat points that take part as source in a
            registration and in a rough one. judged: indices of upright points on which overlap is judged.
    """

    submap: Submap
    points: F64
    normals: F64
    flat: Mask
    level: Mask
    upright: Mask
    tree: small_gicp.KdTree | None
    chosen: I64
    few: I64
    judged: I64

    @property
    def bare(self) -> bool:
        """Whether hardly anything nearby constrains the horizontal position."""
        return int(np.count_nonzero(self.flat & self.upright)) < BARE * int(np.count_nonzero(self.flat))


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a source submap fits a target.

    Attributes:
        T_target_source: (4, 4), level frames. overlap: 0-1. residuals: (k,) m, point to plane.
        information: (6, 6) of the pose per residual variance, rotation then translation, errors
            about the source's origin in the target's axes.
    """

    T_target_source: F64
    overlap: float
    residuals: F64
    information: F64

    @property
    def residual_rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2))) if len(self.residuals) else float("nan")

    @property
    def condition(self) -> float:
        """Smallest over largest eigenvalue of the translation's information, rotation left free; 0-1."""
        values = np.linalg.eigvalsh(self._translation())
        return float(max(values[0], 0.0) / values[-1]) if values[-1] > 0 else 0.0

    @property
    def directions(self) -> F64:
        """(3, 3) unit, target's axes, one a row: directions of translation, least constrained by the points first."""
        return np.asarray(np.linalg.eigh(self._translation())[1].T)

    def _translation(self) -> F64:
        H = self.information
        return np.asarray(H[3:, 3:] - H[3:, :3] @ np.linalg.pinv(H[:3, :3]) @ H[:3, 3:])


def prepare(submap: Submap) -> Prepared:
    points = submap.points.astype(np.float64)
    tree, normals, flat = None, np.empty_like(points), np.empty(len(points), np.bool_)
    if len(points):  # small_gicp crashes when it searches a tree without points
        tree = small_gicp.KdTree(points, ONE_THREAD)
        index, _ = tree.batch_knn_search(points, min(NEIGHBOURS, len(points)), ONE_THREAD)
        patches.planes(points, np.asarray(index, np.int64), submap.eyes, FLAT_M, normals, flat)
    level = flat & (np.abs(normals[:, 2]) > LEVEL)
    chosen, few = _thinned(flat, MOST_POINTS), _thinned(flat, FEW_POINTS)
    ground, upright = level & (normals[:, 2] > 0), ~level
    return Prepared(submap, points, normals, flat, ground, upright, tree, chosen, few, _thinned(upright, MOST_POINTS))


def _thinned(which: Mask, most: int) -> I64:
    """Evenly spread indices of some of them, at most this many."""
    indices = np.flatnonzero(which)
    return indices[:: max(1, -(-len(indices) // most))]


def rough(target: Prepared, source: Prepared, T_guess: F64) -> tuple[F64, float]:
    """(4, 4) T_target_source of the level frames, to a decimetre or so, and the share of points that fit there."""
    return _align(target, source, T_guess, source.few, COARSE)


def register(target: Prepared, source: Prepared, T_rough: F64) -> F64:
    """The same, starting from the result of `rough`, to a centimetre or so."""
    return _align(target, source, T_rough, source.few, FINE)[0]


def refine(target: Prepared, source: Prepared, T: F64) -> F64:
    """The same, starting from the result of `register`, with more points."""
    return _align(target, source, T, source.chosen, FINE)[0]


def _align(
    target: Prepared, source: Prepared, T_guess: F64, chosen: I64, one_pass: tuple[float, float, int]
) -> tuple[F64, float]:
    """Align by Gauss-Newton with Cauchy weights. Returns the pose and the share of the chosen points that fit there."""
    T, turn = T_guess.copy(), np.empty((3, 3))
    points, normals = source.points[chosen], source.normals[chosen]
    reach, scale, iterations = one_pass
    share = 0.0
    for _ in range(iterations):
        H, b, residuals = _pull(target, points, normals, T, reach, scale)
        if np.count_nonzero(~np.isnan(residuals)) < 6:
            return T, 0.0
        share = float(np.count_nonzero(np.abs(residuals) < FITS_M) / len(points))
        step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), b)
        small.rotation(step[0], step[1], step[2], turn)
        T[:3, :3] = turn @ T[:3, :3]
        T[:3, 3] += step[3:]
        if np.abs(step).max() < ENOUGH:
            break
    return T, share


def assess(target: Prepared, source: Prepared, T: F64) -> Fit:
    """Overlap, residuals and information of a source placed on a target at T (4, 4)."""
    back = lie.inverse(T)
    overlap = min(_overlap(target, source, T), _overlap(source, target, back))
    near = np.flatnonzero(_near(target, source, source.points @ T[:3, :3].T + T[:3, 3], T[:3, 3]) & source.flat)
    information, _, residuals = _pull(target, source.points[near], source.normals[near], T, PARTNER_M, np.inf)
    return Fit(T, overlap, residuals[~np.isnan(residuals)], information)


def information(target: Prepared, source: Prepared, T: F64) -> F64:
    """(6, 6) as of a `Fit`, of the points of a rough registration."""
    return _pull(target, source.points[source.few], source.normals[source.few], T, PARTNER_M, np.inf)[0]


def slide(target: Prepared, source: Prepared, fit: Fit, direction: F64) -> float:
    """m along a direction (3,) between the result and where registrations end that were pushed off it, both ways.

    If features constrain this direction, both come back; along a plain corridor they stay where they were put.
    """
    ends = []
    for sign in (-1.0, 1.0):
        pushed = fit.T_target_source.copy()
        pushed[:3, 3] += sign * DISTURBANCE_M * direction
        ends.append(_align(target, source, pushed, source.few, FINE)[0][:3, 3])
    return float(max(abs(direction @ (end - fit.T_target_source[:3, 3])) for end in ends))


def _pull(target: Prepared, points: F64, normals: F64, T: F64, reach: float, scale: float) -> tuple[F64, F64, F64]:
    """Normal equations (6, 6), (6,) of source points placed at T (4, 4), and their residuals, nan without a partner.

    Errors are a rotation about the source's origin and a translation, in the target's axes.
    """
    moved = points @ T[:3, :3].T + T[:3, 3]
    partner, squared = _nearest(target, moved)
    H, b, residuals = np.empty((6, 6)), np.empty(6), np.empty(len(moved))
    submaps.normal_equations(
        moved, normals, T[:3, :3], T[:3, 3], partner, squared, target.points, target.normals, target.flat, reach,
        FACING, scale, H, b, residuals,
    )  # fmt: skip
    return H, b, residuals


def _overlap(target: Prepared, source: Prepared, T: F64) -> float:
    moved = source.points[source.judged] @ T[:3, :3].T + T[:3, 3]
    near = moved[_near(target, source, moved, T[:3, 3])]
    return float((_nearest(target, near)[1] < PARTNER_M**2).mean()) if len(near) >= LEAST_UPRIGHT else 0.0


def _near(target: Prepared, source: Prepared, points: F64, origin: F64) -> Mask:
    """Which points (n, 3), target frame, lie near both the target's origin and `origin`."""
    to_target = np.einsum("ni,ni->n", points, points)
    to_source = np.einsum("ni,ni->n", points - origin, points - origin)
    reach = COMMON * min(target.submap.reach, source.submap.reach)
    return np.asarray(np.maximum(to_target, to_source) < reach**2)


def _nearest(target: Prepared, points: F64) -> tuple[I64, F64]:
    """Index and squared distance (m²) of the nearest point of the target; infinitely far if it has none."""
    if target.tree is None:
        return np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    # the search for k neighbours returns arrays, unlike the search for one, so it is faster
    index, squared = target.tree.batch_knn_search(points, 1, ONE_THREAD)
    return index[:, 0].astype(np.int64), squared[:, 0]
