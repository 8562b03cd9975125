"""Candidates side by side: which agree, which contradict each other, and which are accepted for it.

One registration can be fooled by a place that looks the same; several, at different keyframes,
that tell the same story are fooled more rarely. Where two stories are told, neither is believed.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from app.slam import lie
from app.slam.loops import se3
from app.slam.loops.drift import Drift, agree
from app.slam.loops.types import LOOP_HUBER, LoopEdge, Origin, Pair, Verdict
from app.slam.params import LoopsParams
from app.slam.types import F64

NEIGHBOURHOOD_M = 15.0
"""Loops with farther to walk between their ends, on either side, say nothing of each other."""
SAME = 2 * LOOP_HUBER
"""Standard deviations up to which a loop says what another near it says: by there the graph's loss halves its pull."""
NO_NEWS = 1.0
"""The same beyond a submap's length. Of six numbers, few errors are as small; covariances of loops are generous."""


def settle(
    fresh: Mapping[Pair, LoopEdge],
    edges: Mapping[Pair, LoopEdge],
    poses: F64,
    drift: Drift,
    params: LoopsParams,
    now: int,
) -> list[LoopEdge]:
    """Verdicts on the candidates seen just now, and on those before that they bear on.

    Args:
        fresh: seen just now, judged each by itself. edges: all, with those, as they count with the
            user's commands; what the user has decided is not decided here.
        poses: (k, 4, 4) T_odom_imu. now: newest keyframe.

    Returns:
        All of `fresh`, and those before whose verdict changed, without the user's commands.
    """
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])

    def ways(a: LoopEdge, b: LoopEdge) -> tuple[float, float]:
        return abs(float(walked[a.older] - walked[b.older])), abs(float(walked[a.newer] - walked[b.newer]))

    alive = [edge for edge in edges.values() if edge.verdict is not Verdict.REJECTED or edge.evidence.ambiguous]
    apart = np.abs(_ends(alive, walked)[:, None] - _ends(fresh.values(), walked)).max(axis=2)
    near = [alive[index] for index in np.flatnonzero((apart < NEIGHBOURHOOD_M).any(axis=1))]
    out = dict(fresh)
    for edge in near:
        if edge.verdict is not Verdict.CANDIDATE or edge.edited:
            continue
        others = [o for o in near if o.pair != edge.pair and max(ways(edge, o)) < NEIGHBOURHOOD_M]
        # what is ambiguous agrees with nothing: where a place has twins, all that was seen there may be one's
        verdicts = [not o.evidence.ambiguous and agree(edge, o, poses, sum(ways(edge, o)), drift) for o in others]
        support = len({other.newer for other, yes in zip(others, verdicts, strict=True) if yes} - {edge.newer})
        against = verdicts.count(False)
        evidence = replace(edge.evidence, support=support)
        measured = replace(edge.measured, evidence=evidence)
        if support >= params.support and support > 2 * against:
            reason = f"{evidence.summary}; {support} others agree"
            out[edge.pair] = replace(
                edge, verdict=Verdict.ACCEPTED, reason=reason, measured=measured, decided_at=now, weight=1.0
            )
        elif edge.pair in out:
            waits = f"{evidence.summary}; {support} of {params.support} others agree"
            contradicted = f", {against} contradict it" if against else ""
            out[edge.pair] = replace(edge, reason=waits + contradicted, measured=measured, weight=1.0)
    return list(out.values())


def _ends(edges: Iterable[LoopEdge], walked: F64) -> F64:
    """(n, 2) m, walked to the older and to the newer keyframe of each."""
    return np.asarray(walked[np.array([edge.pair for edge in edges], np.int64).reshape(-1, 2)])


def placed(
    settled: Iterable[LoopEdge], edges: Iterable[LoopEdge], T_odom_imu: F64, T_map_imu: F64, half: int
) -> list[LoopEdge]:
    """The same, those just accepted with the loop that is in the graph for them or that they repeat, if there is one.

    A pose costs the solver far more than a measurement between poses that are tied already, so of loops whose submaps
    share any points and that measured the same, one ties poses and the others are laid on these. Where a place was
    passed several times before, being tied to one of these times is being tied to all, as they are to each other: what
    the graph says already, to `SAME` within a submap's length of the last tie or to `NO_NEWS` within two, is not told
    it again, else it would be the denser the more often one comes by. And submaps of keyframes a quarter of their
    length apart share three quarters of it: two loops between such neighbours, at both ends, are one measurement.

    Args:
        edges: all, as they count. T_odom_imu, T_map_imu: (k, 4, 4). half: of a submap, in keyframes.
    """
    counting = {edge.pair: edge for edge in edges if edge.counts}
    out = []
    for edge in settled:
        if edge.verdict is Verdict.ACCEPTED and edge.represented_by is None and edge.pair not in counting:
            edge = _placed(edge, counting.values(), T_odom_imu, T_map_imu, half)
            if edge.counts:
                counting[edge.pair] = edge
        out.append(edge)
    return out


def _placed(edge: LoopEdge, counting: Collection[LoopEdge], T_odom_imu: F64, T_map_imu: F64, half: int) -> LoopEdge:
    near = next((other for other in counting if _apart(edge, other) <= half // 2), None)
    if near is not None:
        return replace(edge, represented_by=near.pair)
    ties = [other for other in counting if other.repeats is None]
    found = (tie for tie in ties if tie.origin is Origin.DETECTED)
    around = sorted((tie for tie in found if _apart(edge, tie) <= 2 * half), key=partial(_apart, edge))
    same = next((tie for tie in around if _off(edge, *laid(tie, edge, T_odom_imu)) <= SAME), None)
    if same is not None:
        return replace(edge, repeats=same.pair)
    last = min(ties, key=lambda tie: abs(edge.newer - tie.newer), default=edge)
    ago = abs(edge.newer - last.newer)
    if last is not edge and ago <= 4 * half:
        off = _off(edge, lie.inverse(T_map_imu[edge.older]) @ T_map_imu[edge.newer])
        if off <= (SAME if ago <= 2 * half else NO_NEWS):
            return replace(edge, represented_by=last.pair)
    return edge


def laid(edge: LoopEdge, first: LoopEdge, T_odom_imu: F64) -> tuple[F64, F64]:
    """What a loop measured, as one between the keyframes of another near it: T (4, 4), and its covariance (6, 6).

    Args:
        T_odom_imu: (k, 4, 4); taken as exact between ends that are near each other.
    """
    older = lie.inverse(T_odom_imu[first.older]) @ T_odom_imu[edge.older]
    newer = lie.inverse(T_odom_imu[edge.newer]) @ T_odom_imu[first.newer]
    turn = se3.adjoint(lie.inverse(newer))
    covariance = turn @ edge.covariance @ turn.T
    return older @ edge.T_older_newer @ newer, (covariance + covariance.T) / 2


def _apart(a: LoopEdge, b: LoopEdge) -> int:
    """Keyframes between them, at the ends that are farther from one another."""
    return max(abs(a.older - b.older), abs(a.newer - b.newer))


def _off(edge: LoopEdge, T_older_newer: F64, covariance: F64 | float = 0.0) -> float:
    """Standard deviations by which a loop measured something else than that. covariance: (6, 6) of that; 0: exact."""
    missed = se3.log(lie.inverse(edge.T_older_newer) @ T_older_newer)
    return float(np.sqrt(missed @ np.linalg.solve(edge.covariance + covariance, missed)))
