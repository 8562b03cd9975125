"""Bends a map by its fixes: each becomes a factor of the pose graph, on the keyframe nearest in time.

    g = T_map_imu @ (T_keyframe_then @ lever)        the antenna, carried to the time of the fix by odometry

Fixes that do not fit even a bent map are rejected, unless the user counts them. The fixes also determine how stiff the
graph is: fixes of some stretches must predict those of the other stretches. If the clocks' offset is not given, it is
estimated together with the bent map. Then the graph is never very stiff: a very stiff graph would turn slow drift by
millimetres into an offset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.georeference.align import FEWEST, MEDIAN_SIGMAS, MOST_SIGMAS, Alignment, overrides_of
from app.georeference.fixes import Fixes
from app.georeference.path import PathOverTime
from app.slam import lie
from app.slam.arrays import F64, I64, Mask
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.factors import Factor, PositionPrior
from app.slam.loops.solvers import optimise
from app.slam.trajectory import Trajectory

MOST_ROUNDS = 5
STIFFNESS = (1.0, 3e-2, 1e-3, 3e-5)
"""Factors of the graph's covariances that are tried: a good sensor drifts far less than the graph expects."""
LEAST_FOR_CLOCKS = 1e-2
"""The smallest of these factors while the clocks' offset is estimated. Fixes cannot show drift of a millimetre in ten
seconds; along the walk, it looks like an offset of a millisecond."""
STRETCH_S = 3.0
"""Fixes of every other stretch predict those between them."""
STEP_S, EXACT_S, FARTHEST_S = 2e-3, 1e-5, 2.0
"""s, of the search for the clocks' offset: first step, last step, and largest distance from the alignment's offset."""


def bend(
    trajectory: Trajectory,
    keyframe_stamps_ns: I64,
    graph: Sequence[Factor],
    fixes: Fixes,
    found: Alignment,
    overridden: Mapping[str, bool],
) -> tuple[F64, Alignment]:
    """Solve the graph with the fixes.

    Args:
        trajectory: T_map_imu at all scans, keyframes among them. graph: odometry and loops of the keyframes.
        found: how the fixes lie on the map as it is. overridden: whether fixes of these names count, whatever their
            residuals.

    Returns:
        (k, 4, 4) T_bent_map at each keyframe, and how the fixes lie on the bent map.

    Raises:
        HemislamError: the solver fails.
    """
    path = PathOverTime(trajectory)
    before = path.poses(np.asarray((keyframe_stamps_ns - path.start_ns) * 1e-9, np.float64))
    problem = _Problem(path, keyframe_stamps_ns, before, graph, fixes, found)
    word = overrides_of(overridden, found.names)
    held, barred = np.asarray(word == 1.0), np.asarray(word == 0.0)
    try:
        factor = problem.stiffness(~barred)
        clocks, problem = problem.scaled(max(factor, LEAST_FOR_CLOCKS)), problem.scaled(factor)
        offset_s, sigma_s, used = found.offset_s, found.offset_sigma_s, ~barred
        poses = problem.solved(offset_s, before, used, robust=True)
        for _ in range(MOST_ROUNDS):
            _, distances = _off(problem.priors(offset_s), poses)
            scale = max(1.0, float(np.median(distances[used])) / MEDIAN_SIGMAS)
            agree: Mask = ((distances < MOST_SIGMAS * scale) | held) & ~barred
            if np.isfinite(found.offset_sigma_s):
                offset_s, sigma_s = clocks.offset(offset_s, poses, agree)
            poses = problem.solved(offset_s, poses, agree)
            if (agree == used).all():
                break
            used = agree
    except ArithmeticError as error:
        raise HemislamError(f"The graph cannot be solved with these fixes ({error}).") from error
    off, distances = _off(problem.priors(offset_s), poses)
    moved = float(np.linalg.norm(poses[:, :3, 3] - before[:, :3, 3], axis=1).max())
    return poses @ lie.inverse(before), replace(
        found,
        residuals=off @ np.array(found.reference.rotation).T,
        distances=distances,
        used=used,
        offset_s=offset_s,
        offset_sigma_s=sigma_s,
        yaw_sigma=float("nan"),
        notes=(*found.notes, f"The fixes bend the map: keyframes move by up to {moved:.3f} m."),
    )


@dataclass(frozen=True, slots=True)
class _Problem:
    """A graph and the fixes that bend it.

    Attributes:
        path: the trajectory before. stamps_ns: (k,) of the keyframes. keyframes: (k, 4, 4) T_map_imu before.
        found: the alignment. Below, (n,) refers to its n fixes.
    """

    path: PathOverTime
    stamps_ns: I64
    keyframes: F64
    graph: Sequence[Factor]
    fixes: Fixes
    found: Alignment

    def priors(self, offset_s: float) -> list[PositionPrior]:
        """(n,) priors if the fixes are stamped late by this; each on the keyframe nearest in time by the alignment."""
        found, rows = self.found, self.rows
        aligned_ns = self.fixes.stamps_ns[rows] - round(found.offset_s * 1e9)
        after = np.searchsorted(self.stamps_ns, aligned_ns).clip(max=len(self.stamps_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(self.stamps_ns[before] - aligned_ns) <= np.abs(self.stamps_ns[after] - aligned_ns)
        nearest = np.where(nearer, before, after)  # the same for every offset, so that the cost has no jumps
        stamps_ns = self.fixes.stamps_ns[rows] - round(offset_s * 1e9)
        then = self.path.poses(np.asarray((stamps_ns - self.path.start_ns) * 1e-9, np.float64))
        arms = (lie.inverse(self.keyframes[nearest]) @ then @ np.array([*found.lever_arm, 1.0]))[:, :3]
        places = found.reference.from_crs(found.grid)
        scatter = np.linalg.norm(found.residuals, axis=1) / np.maximum(found.distances, 1e-9)
        sigmas = np.where(np.isfinite(self.fixes.sigmas[rows]), self.fixes.sigmas[rows], scatter[:, None])
        R = np.array(found.reference.rotation)
        return [
            PositionPrior(KeyframeId(0, int(keyframe)), place, R.T @ np.diag(sigma**2) @ R, arm)
            for keyframe, place, sigma, arm in zip(nearest, places, sigmas, arms, strict=True)
        ]

    @property
    def rows(self) -> I64:
        """(n,) indices of the fixes."""
        return np.array([int(name) - 1 for name in self.found.names])

    def solved(self, offset_s: float, start: F64, which: Mask, *, robust: bool = False) -> F64:
        """(k, 4, 4) the optimum of the graph and some of the fixes (n,), from `start`."""
        priors = self.priors(offset_s)
        chosen = [replace(priors[i], robust=robust) for i in np.flatnonzero(which).tolist()]
        return optimise(self.keyframes[0], [*self.graph, *chosen], start, free=True)

    def offset(self, offset_s: float, start: F64, which: Mask) -> tuple[float, float]:
        """The clocks' offset with which graph and fixes agree best, and its standard deviation, s.

        The map bends for each offset that is tried. So drift, which an alignment would take for an offset, is absorbed
        by the graph.
        """
        from scipy import optimize  # the page's engine imports this module, and few maps are bent

        slopes: list[float] = []
        find_root: Any = optimize.root_scalar

        def slope(late: float) -> float:
            """Slope of half the sum of squares, minimised over all poses, whose derivatives then do not matter."""
            poses, priors = self.solved(late, start, which), self.priors(late)
            off, _ = _off(priors, poses)
            (ahead, _), (behind, _) = (_off(self.priors(late + side), poses) for side in (STEP_S / 4, -STEP_S / 4))
            weights = np.linalg.inv([prior.covariance for prior in priors])
            pull = np.einsum("ni,nij,nj->n", (ahead - behind) / (STEP_S / 2), weights, off)
            slopes.append(float(pull[which].sum()))
            return slopes[-1]

        end = find_root(slope, x0=offset_s, x1=offset_s + STEP_S, method="secant", xtol=EXACT_S, maxiter=20)
        bend = (slopes[1] - slopes[0]) / STEP_S
        if not end.converged or abs(end.root - self.found.offset_s) > FARTHEST_S or bend <= 0:
            return offset_s, float("nan")
        return float(end.root), bend**-0.5

    def scaled(self, factor: float) -> "_Problem":
        """The same problem with all covariances of the graph multiplied by a factor."""
        return replace(self, graph=[replace(one, covariance=one.covariance * factor) for one in self.graph])

    def stiffness(self, which: Mask) -> float:
        """The smallest factor on the graph's covariances with which the fixes predict one another best."""
        seconds = (self.fixes.stamps_ns[self.rows] - self.fixes.stamps_ns[self.rows[which][0]]) * 1e-9
        half = np.asarray(seconds // STRETCH_S % 2 == 0)
        parts = half & which, ~half & which
        priors = self.priors(self.found.offset_s)
        best, cap, kept = np.inf, 0.0, 1.0
        for factor in STIFFNESS if min(part.sum() for part in parts) >= FEWEST else ():
            stiff, missed = self.scaled(factor), []
            for known, asked in (parts, parts[::-1]):
                poses = stiff.solved(self.found.offset_s, self.keyframes, known, robust=True)
                missed.append(_off(priors, poses)[1][asked])
            distances = np.concatenate(missed)
            cap = cap or MOST_SIGMAS * max(1.0, float(np.median(distances)) / MEDIAN_SIGMAS)
            score = float(np.minimum(distances, cap) @ np.minimum(distances, cap))
            if score > best:
                break
            best, kept = score, factor
        return kept


def _off(priors: Sequence[PositionPrior], poses: F64) -> tuple[F64, F64]:
    """(n, 3) m, measured minus map in the map's axes, and (n,) the same in standard deviations."""
    T = poses[[prior.keyframe for prior in priors]]
    arms = np.array([prior.arm for prior in priors])
    off = np.array([prior.p_map_imu for prior in priors]) - T[:, :3, 3] - np.einsum("nij,nj->ni", T[:, :3, :3], arms)
    whitened = np.linalg.solve(np.array([prior.covariance for prior in priors]), off[..., None])[..., 0]
    return off, np.sqrt(np.einsum("ni,ni->n", off, whitened))
