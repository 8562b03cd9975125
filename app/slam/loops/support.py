"""Compare candidates: a candidate is accepted if enough others agree with it and few contradict it.

A place that looks the same can fool one registration, but rarely several at different keyframes in the same way.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from app.slam import lie
from app.slam.loops.drift import Drift
from app.slam.loops.types import LOOP_HUBER, LoopEdge, Origin, Pair, Verdict
from app.slam.metrics import walked_m
from app.slam.sections import LoopsParams
from app.slam.types import F64, I64

NAMED = 5
"""Most loops that are named as contradicting a candidate."""
NEIGHBOURHOOD_M = 15.0
"""Loops whose ends are farther apart than this along the trajectory, on either side, are not compared."""
ELSEWHERE_M = 1e6
"""m of trajectory that a pause counts as: odometry tells nothing across it."""
SAME = 2 * LOOP_HUBER
"""Standard deviations up to which two nearby loops count as the same; there Huber's loss halves the pull."""
AGREE = 3.0
"""Standard deviations up to which two loops agree."""
OUTVOTING, STRETCH_M = 2, 4.0
"""To outvote odometry, this many times as many loops must agree, and their newer ends must span this distance, m."""
NO_NEWS = 1.0
"""The limit `SAME` beyond a submap's length. It is strict, as the covariances of loops are generous."""


def settle(
    fresh: Mapping[Pair, LoopEdge],
    edges: Mapping[Pair, LoopEdge],
    poses: F64,
    pauses_before: I64,
    drift: Drift,
    params: LoopsParams,
    now: int,
) -> list[LoopEdge]:
    """Verdicts on new candidates, and on earlier ones that they support or contradict.

    Args:
        fresh: new candidates with a verdict on each alone. edges: all candidates, including `fresh`, with the user's
            edits applied. A candidate that the user decided on is left alone.
        poses: (k, 4, 4) T_odom_imu. pauses_before: (k,) number of pauses before each. now: newest keyframe.

    Returns:
        All of `fresh`, and earlier candidates whose verdict changed, without the user's edits.
    """
    walked = walked_m(poses[:, :3, 3]) + pauses_before * ELSEWHERE_M

    alive = [edge for edge in edges.values() if edge.verdict is not Verdict.REJECTED or edge.evidence.ambiguous]
    apart = np.abs(_ends(alive, walked)[:, None] - _ends(fresh.values(), walked)).max(axis=2)
    near = [alive[index] for index in np.flatnonzero((apart < NEIGHBOURHOOD_M).any(axis=1))]
    ends, out = _ends(near, walked), dict(fresh)
    for edge, own in zip(near, ends, strict=True):
        if edge.verdict is not Verdict.CANDIDATE or edge.edited:
            continue
        ways = np.abs(ends - own)
        around = np.flatnonzero(ways.max(axis=1) < NEIGHBOURHOOD_M)  # and itself, which agrees and adds no support
        others = [near[index] for index in around]
        agree = _agree(edge, others, poses, ways[around].sum(axis=1), drift)
        # an ambiguous loop that agrees is no support: all that is seen there may belong to a place that looks the same
        agreeing = [o.newer for o, yes in zip(others, agree, strict=True) if yes and not o.evidence.ambiguous]
        contradicting = [o.pair for o, yes in zip(others, agree, strict=True) if not yes]
        support, against = len({*agreeing} - {edge.newer}), len(contradicting)
        alone = edge.evidence.mahalanobis > params.max_mahalanobis
        stretch = float(np.ptp(walked[[edge.newer, *agreeing]]))
        needed = params.support * (OUTVOTING if alone else 1)
        evidence = replace(edge.evidence, support=support)
        rivals = _rivals(edge, alive, walked, poses, drift) if alone else 0
        likely = not alone or (stretch >= STRETCH_M and not rivals)
        if likely and support >= needed and support > 2 * against:
            outvoted = f"; together they outvote odometry ({stretch:.0f} m)" if alone else ""
            reason = f"{evidence.summary}; {support} others agree{outvoted}"
            out[edge.pair] = replace(
                edge, verdict=Verdict.ACCEPTED, reason=reason, evidence=evidence, decided_at=now, weight=1.0
            )
        elif edge.pair in out:
            agreement = f"{support} others agree ({needed} needed)"
            waits = f"{evidence.summary}; {agreement}"
            if alone:
                waits = f"{edge.evidence.against_odometry(params.max_mahalanobis)}; {agreement}"
                waits += f" over {stretch:.0f} m (least {STRETCH_M:g} m)"
            if rivals:
                waits += f"; {rivals} that odometry finds likelier lead to another place"
            contradicted = f", {against} contradict it" if against else ""
            named = tuple(contradicting[:NAMED])
            out[edge.pair] = replace(
                edge, reason=waits + contradicted, evidence=evidence, weight=1.0, contradicted_by=named
            )
    return list(out.values())


def _agree(edge: LoopEdge, others: Sequence[LoopEdge], poses: F64, ways: F64, drift: Drift) -> npt.NDArray[np.bool_]:
    """Which of the others agree with a loop: the cycle of both loops and of the odometry between their ends closes
    within its uncertainty.

    Args:
        poses: (k, 4, 4) by odometry. ways: (n,) m along the trajectory between the older ends, plus between the newer.
    """
    T, covariances = transported(others, edge, poses)
    walked = np.array([drift.rotation] * 3 + [drift.translation] * 3) * ways[:, None]
    return _off(edge, T, covariances + np.eye(6) * walked[:, None, :] ** 2) < AGREE


def _rivals(edge: LoopEdge, alive: Sequence[LoopEdge], walked: F64, poses: F64, drift: Drift) -> int:
    """Number of loops from about the same place that lead elsewhere, span more odometry and deviate less from it."""
    less = [o for o in alive if not o.evidence.ambiguous and o.evidence.mahalanobis < edge.evidence.mahalanobis]
    older, newer = (_ends(less, walked) - walked[[*edge.pair]]).T
    chosen = np.flatnonzero((older < -NEIGHBOURHOOD_M) & (np.abs(newer) < NEIGHBOURHOOD_M))
    if not len(chosen):
        return 0
    others = [less[index] for index in chosen]
    agree = _agree(edge, others, poses, np.abs(older[chosen]) + np.abs(newer[chosen]), drift)
    return int(np.count_nonzero(~agree))


def _ends(edges: Iterable[LoopEdge], walked: F64) -> F64:
    """(n, 2) m along the trajectory to the older and to the newer keyframe of each."""
    return np.asarray(walked[np.array([edge.pair for edge in edges], np.int64).reshape(-1, 2)])


def sparsified(
    settled: Iterable[LoopEdge],
    edges: Iterable[LoopEdge],
    T_odom_imu: F64,
    T_map_imu: F64,
    pauses_before: I64,
    half: int,
) -> list[LoopEdge]:
    """The same candidates; accepted ones name the loop that represents them or that they repeat, if there is one.

    Tying a new pose costs the solver far more than a further measurement between poses that are already tied. So:
    - Loops whose keyframes are a quarter of a submap apart at both ends share most points: they are one measurement.
    - If the submaps of several loops share points and the loops agree, one of them ties poses; the others repeat it.
    - A loop that the graph already predicts is represented by the last tie: to `SAME` within a submap's length of that
      tie, to `NO_NEWS` within two. Otherwise the graph would grow denser with every visit to a place.

    Args:
        edges: all, with their verdicts. T_odom_imu, T_map_imu: (k, 4, 4). pauses_before: (k,) number of pauses before
            each; only loops with equal numbers at both ends are compared. half: of a submap, in keyframes.
    """
    counting = {edge.pair: edge for edge in edges if edge.counts}
    out = []
    for edge in settled:
        if edge.counts and edge.pair not in counting:
            alike = [
                other
                for other in counting.values()
                if (pauses_before[[*other.pair]] == pauses_before[[*edge.pair]]).all()
            ]
            edge = _sparsified(edge, alike, T_odom_imu, T_map_imu, half)
            if edge.counts:
                counting[edge.pair] = edge
        out.append(edge)
    return out


def _sparsified(edge: LoopEdge, counting: Collection[LoopEdge], T_odom_imu: F64, T_map_imu: F64, half: int) -> LoopEdge:
    counting = [other for other in counting if edge.open or not other.open]
    near = next((other for other in counting if _apart(edge, other) <= half // 2), None)
    if near is not None:
        return replace(edge, represented_by=near.pair)
    ties = [other for other in counting if other.repeats is None]
    found = (tie for tie in ties if tie.origin is Origin.DETECTED)
    around = sorted((tie for tie in found if _apart(edge, tie) <= 2 * half), key=partial(_apart, edge))
    same = _off(edge, *transported(around, edge, T_odom_imu)) <= SAME if around else np.empty(0)
    if same.any():
        return replace(edge, repeats=around[int(same.argmax())].pair)
    last = min(ties, key=lambda tie: abs(edge.newer - tie.newer), default=edge)
    ago = abs(edge.newer - last.newer)
    if last is not edge and ago <= 4 * half:
        off = _off(edge, lie.inverse(T_map_imu[edge.older]) @ T_map_imu[edge.newer])
        if off <= (SAME if ago <= 2 * half else NO_NEWS):
            return replace(edge, represented_by=last.pair)
    return edge


def transported(edges: Sequence[LoopEdge], first: LoopEdge, T_odom_imu: F64) -> tuple[F64, F64]:
    """Loops transported by odometry to the keyframes of a nearby one: T (n, 4, 4) and covariances (n, 6, 6).

    Args:
        T_odom_imu: (k, 4, 4); taken as exact between ends that are near each other.
    """
    ends = np.array([edge.pair for edge in edges])
    older = lie.inverse(T_odom_imu[first.older]) @ T_odom_imu[ends[:, 0]]
    newer = lie.inverse(T_odom_imu[ends[:, 1]]) @ T_odom_imu[first.newer]
    turn = lie.adjoint(lie.inverse(newer))
    covariances = turn @ np.array([edge.covariance for edge in edges]) @ np.swapaxes(turn, -1, -2)
    measured = np.array([edge.T_older_newer for edge in edges])
    return older @ measured @ newer, (covariances + np.swapaxes(covariances, -1, -2)) / 2


def _apart(a: LoopEdge, b: LoopEdge) -> int:
    """Number of keyframes between two loops, at the ends that are farther apart."""
    return max(abs(a.older - b.older), abs(a.newer - b.newer))


def _off(edge: LoopEdge, T_older_newer: F64, covariances: F64 | float = 0.0) -> F64:
    """Standard deviations between a loop and other measurements (..., 4, 4), exact or with covariances (..., 6, 6)."""
    missed = lie.log_se3(lie.inverse(edge.T_older_newer) @ T_older_newer)
    whitened = np.linalg.solve(edge.covariance + covariances, missed[..., None])[..., 0]
    return np.asarray(np.sqrt((missed * whitened).sum(axis=-1)))
