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
    problem = _problem(PathOverTime(trajectory), keyframe_stamps_ns, graph, fixes, found)
    before = problem.keyframes
    word = overrides_of(overridden, found.names)
    held, barred = np.asarray(word == 1.0), np.asarray(word == 0.0)
    try:
        factor = problem.stiffness(~barred)
        clocks, problem = problem.scaled(max(factor, LEAST_FOR_CLOCKS)), problem.scaled(factor)
        offset_s, sigma_s, used = found.offset_s, found.offset_sigma_s, ~barred
        poses = problem.solved(offset_s, before, used, robust=True)
        for _ in range(MOST_ROUNDS):
            _, distances = problem.off(offset_s, poses)
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
    off, distances = problem.off(offset_s, poses)
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
    """A graph and the n fixes that bend it.

    Attributes:
        path: the trajectory before. keyframes: (k, 4, 4) T_map_imu before.
        nearest: (n,) indices of the keyframes that the fixes act on. stamps_ns: (n,).
        places: (n, 3) m, in the map. covariances: (n, 3, 3) of the places. found: the alignment.
    """

    path: PathOverTime
    keyframes: F64
    graph: Sequence[Factor]
    nearest: I64
    stamps_ns: I64
    places: F64
    covariances: F64
    found: Alignment

    def arms(self, offset_s: float) -> F64:
        """(n, 3) m, the antenna in the IMU frame of each fix's keyframe, if the fixes are stamped late by this."""
        stamps_ns = self.stamps_ns - round(offset_s * 1e9)
        then = self.path.poses(np.asarray((stamps_ns - self.path.start_ns) * 1e-9, np.float64))
        T_keyframe_then = lie.inverse(self.keyframes[self.nearest]) @ then
        return np.asarray((T_keyframe_then @ np.array([*self.found.lever_arm, 1.0]))[:, :3])

    def off(self, offset_s: float, poses: F64) -> tuple[F64, F64]:
        """(n, 3) m, measured minus map in the map's axes, and (n,) the same in standard deviations."""
        T = poses[self.nearest]
        off = self.places - T[:, :3, 3] - np.einsum("nij,nj->ni", T[:, :3, :3], self.arms(offset_s))
        whitened = np.linalg.solve(self.covariances, off[..., None])[..., 0]
        return off, np.sqrt(np.einsum("ni,ni->n", off, whitened))

    def solved(self, offset_s: float, start: F64, which: Mask, *, robust: bool = False) -> F64:
        """(k, 4, 4) the optimum of the graph and some of the fixes (n,), from `start`."""
        arms = self.arms(offset_s)
        priors = [
            PositionPrior(KeyframeId(0, int(self.nearest[i])), self.places[i], self.covariances[i], arms[i], robust)
            for i in np.flatnonzero(which)
        ]
        return optimise(self.keyframes[0], [*self.graph, *priors], start, free=True)

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
            poses = self.solved(late, start, which)
            off, ahead, behind = (self.off(late + side, poses)[0] for side in (0.0, STEP_S / 4, -STEP_S / 4))
            pull = np.einsum("ni,nij,nj->n", (ahead - behind) / (STEP_S / 2), np.linalg.inv(self.covariances), off)
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
        seconds = (self.stamps_ns - self.stamps_ns[which][0]) * 1e-9
        half = np.asarray(seconds // STRETCH_S % 2 == 0)
        parts = half & which, ~half & which
        best, cap, kept = np.inf, 0.0, 1.0
        for factor in STIFFNESS if min(part.sum() for part in parts) >= FEWEST else ():
            stiff, missed = self.scaled(factor), []
            for known, asked in (parts, parts[::-1]):
                poses = stiff.solved(self.found.offset_s, self.keyframes, known, robust=True)
                missed.append(self.off(self.found.offset_s, poses)[1][asked])
            distances = np.concatenate(missed)
            cap = cap or MOST_SIGMAS * max(1.0, float(np.median(distances)) / MEDIAN_SIGMAS)
            score = float(np.minimum(distances, cap) @ np.minimum(distances, cap))
            if score > best:
                break
            best, kept = score, factor
        return kept


def _problem(path: PathOverTime, stamps_ns: I64, graph: Sequence[Factor], fixes: Fixes, found: Alignment) -> _Problem:
    """Each fix acts on the keyframe nearest in time by the alignment. stamps_ns: (k,) of the keyframes."""
    rows = np.array([int(name) - 1 for name in found.names])
    aligned_ns = fixes.stamps_ns[rows] - round(found.offset_s * 1e9)
    # the same keyframes for every offset, so that the cost has no jumps
    nearest = np.searchsorted(stamps_ns[1:] + stamps_ns[:-1], 2 * aligned_ns)
    scatter = np.linalg.norm(found.residuals, axis=1) / np.maximum(found.distances, 1e-9)
    sigmas = np.where(np.isfinite(fixes.sigmas[rows]), fixes.sigmas[rows], scatter[:, None])
    R = np.array(found.reference.rotation)
    return _Problem(
        path,
        path.poses(np.asarray((stamps_ns - path.start_ns) * 1e-9, np.float64)),
        graph,
        nearest,
        fixes.stamps_ns[rows],
        found.reference.from_crs(found.grid),
        np.array([R.T @ np.diag(sigma**2) @ R for sigma in sigmas]),
        found,
    )
