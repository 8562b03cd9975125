"""Bends a map by its fixes: each becomes a factor of the pose graph, on the keyframe nearest in time.

    g = T_map_imu @ (T_keyframe_then @ lever)        the antenna, carried to the time of the fix by odometry

Fixes that do not fit even a bent map are rejected, unless the user counts them. The fixes also determine how stiff the
graph is: those of some stretches must predict those of the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import optimize

from app.georeference.align import FEWEST, MEDIAN_SIGMAS, MOST_SIGMAS, Alignment, aligned_robustly, overrides_of
from app.georeference.fixes import Fixes
from app.georeference.ground import Ground
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
STRETCH_S = 3.0
"""Fixes of every other stretch predict those between them."""
PART_S, FEWEST_IN_PART = 20.0, 5
MOST_BY_DRIFT = 0.9
"""With more of its uncertainty by drift, the clocks' offset is better found in stretches, for all their noise."""

_minimize: Any = optimize.minimize_scalar


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
    before = PathOverTime(trajectory).poses((keyframe_stamps_ns - trajectory.stamps_ns[0]) * 1e-9)
    if found.offset_drift_s > MOST_BY_DRIFT * found.offset_sigma_s:
        offset_s = offset_by_parts(trajectory, fixes, found)
        note = f"Clock offset, estimated in stretches of the trajectory: {offset_s * 1e3:.1f} ms."
        found = replace(
            found, offset_s=offset_s, offset_sigma_s=float("nan"), offset_drift_s=0.0, notes=(*found.notes, note)
        )
    priors = _priors(trajectory, keyframe_stamps_ns, before, fixes, found)
    word = overrides_of(overridden, found.names)
    held, barred = np.asarray(word == 1.0), np.asarray(word == 0.0)
    chosen = [replace(prior, robust=True) for prior, no in zip(priors, barred, strict=True) if not no]
    stretches = [int(name) - 1 for name, no in zip(found.names, barred, strict=True) if not no]
    halves = np.asarray((fixes.stamps_ns[stretches] - fixes.stamps_ns[stretches[0]]) * 1e-9 // STRETCH_S % 2 == 0)
    try:
        graph = _stiffened(graph, chosen, halves, before)
        poses = optimise(before[0], [*graph, *chosen], before, free=True)
        used: Mask = ~barred
        for _ in range(MOST_ROUNDS):
            off, distances = _off(priors, poses)
            scale = max(1.0, float(np.median(distances[used])) / MEDIAN_SIGMAS)
            agree = ((distances < MOST_SIGMAS * scale) | held) & ~barred
            poses = optimise(before[0], [*graph, *(priors[i] for i in np.flatnonzero(agree))], poses, free=True)
            if (agree == used).all():
                break
            used = agree
    except ArithmeticError as error:
        raise HemislamError(f"The graph cannot be solved with these fixes ({error}).") from error
    off, distances = _off(priors, poses)
    moved = float(np.linalg.norm(poses[:, :3, 3] - before[:, :3, 3], axis=1).max())
    notes = (*found.notes, f"The fixes bend the map: keyframes move by up to {moved:.3f} m.")
    turned = off @ np.array(found.reference.rotation).T
    return poses @ lie.inverse(before), replace(
        found, residuals=turned, distances=distances, used=used, notes=notes, yaw_sigma=float("nan")
    )


def _stiffened(graph: Sequence[Factor], priors: Sequence[PositionPrior], half: Mask, before: F64) -> list[Factor]:
    """The graph with the smallest factor on its covariances with which fixes predict one another best.

    Args:
        half: (n,) which of the priors predict the others, and the other way round. before: (k, 4, 4) to start from.
    """
    best, cap, kept = np.inf, 0.0, list(graph)
    for factor in STIFFNESS if min(half.sum(), (~half).sum()) >= FEWEST else ():
        stiff = [replace(one, covariance=one.covariance * factor) for one in graph]
        missed = []
        for known in (half, ~half):
            poses = optimise(
                before[0], [*stiff, *(priors[i] for i in np.flatnonzero(known).tolist())], before, free=True
            )
            missed.append(_off([priors[i] for i in np.flatnonzero(~known).tolist()], poses)[1])
        distances = np.concatenate(missed)
        cap = cap or MOST_SIGMAS * max(1.0, float(np.median(distances)) / MEDIAN_SIGMAS)
        score = float(np.minimum(distances, cap) @ np.minimum(distances, cap))
        if score > best:
            break
        best, kept = score, stiff
    return kept


def offset_by_parts(trajectory: Trajectory, fixes: Fixes, found: Alignment) -> float:
    """The clocks' offset (s) near that of an alignment, by stretches of PART_S each aligned separately.

    Drift over the whole walk looks like an offset; within a stretch there is little of it, but more noise.
    """
    path, rows = PathOverTime(trajectory), np.array([int(name) - 1 for name in found.names])
    seconds: F64 = (fixes.stamps_ns[rows] - path.start_ns).astype(np.float64) * 1e-9
    places = Ground.in_grid(found.grid, found.reference.crs).places
    arm, R = np.array(found.lever_arm), np.array(found.reference.rotation)
    count = max(1, round(float(seconds[-1] - seconds[0]) / PART_S))
    ends = np.searchsorted(seconds, np.linspace(seconds[0], seconds[-1], count + 1)[1:-1])
    parts = [part for part in np.split(np.arange(len(rows)), ends) if len(part) >= FEWEST_IN_PART]
    if not parts:
        return found.offset_s

    def cost(offset: float) -> float:
        aligned = (aligned_robustly(path.antenna(seconds[part] - offset, arm) @ R.T, places[part]) for part in parts)
        return sum(float(off.sum()) for _, _, off in aligned)

    around = found.offset_s + np.linspace(-1.0, 1.0, 41)
    best = float(around[np.argmin([cost(offset) for offset in around.tolist()])])
    exact = _minimize(cost, bounds=(best - 0.05, best + 0.05), method="bounded", options={"xatol": 1e-5})
    return float(exact.x)


def _priors(
    trajectory: Trajectory, keyframe_stamps_ns: I64, keyframes: F64, fixes: Fixes, found: Alignment
) -> list[PositionPrior]:
    """One for each fix of the alignment."""
    rows = np.array([int(name) - 1 for name in found.names])
    stamps_ns = fixes.stamps_ns[rows] - round(found.offset_s * 1e9)
    after = np.searchsorted(keyframe_stamps_ns, stamps_ns).clip(max=len(keyframe_stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(keyframe_stamps_ns[before] - stamps_ns) <= np.abs(keyframe_stamps_ns[after] - stamps_ns)
    nearest = np.where(nearer, before, after)
    then = PathOverTime(trajectory).poses((stamps_ns - trajectory.stamps_ns[0]) * 1e-9)
    arms = (lie.inverse(keyframes[nearest]) @ then @ np.array([*found.lever_arm, 1.0]))[:, :3]
    places = found.reference.from_crs(found.grid)
    scatter = np.linalg.norm(found.residuals, axis=1) / np.maximum(found.distances, 1e-9)
    sigmas = np.where(np.isfinite(fixes.sigmas[rows]), fixes.sigmas[rows], scatter[:, None])
    R = np.array(found.reference.rotation)
    return [
        PositionPrior(KeyframeId(0, int(keyframe)), place, R.T @ np.diag(sigma**2) @ R, arm)
        for keyframe, place, sigma, arm in zip(nearest, places, sigmas, arms, strict=True)
    ]


def _off(priors: Sequence[PositionPrior], poses: F64) -> tuple[F64, F64]:
    """(n, 3) m, measured minus map in the map's axes, and (n,) the same in standard deviations."""
    T = poses[[prior.keyframe for prior in priors]]
    arms = np.array([prior.arm for prior in priors])
    off = np.array([prior.p_map_imu for prior in priors]) - T[:, :3, 3] - np.einsum("nij,nj->ni", T[:, :3, :3], arms)
    whitened = np.linalg.solve(np.array([prior.covariance for prior in priors]), off[..., None])[..., 0]
    return off, np.sqrt(np.einsum("ni,ni->n", off, whitened))
