"""Candidates side by side: which agree, which contradict each other, and which are accepted for it.

One registration can be fooled by a place that looks the same; several, at different keyframes,
that tell the same story are fooled more rarely. Where two stories are told, neither is believed.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from app.slam.loops.drift import Drift, agree
from app.slam.loops.judgement import summary
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.params import Loops
from app.slam.types import F64

NEIGHBOURHOOD_M = 15.0
"""Loops with farther to walk between their ends, on either side, say nothing of each other."""


def settle(
    fresh: Mapping[Pair, LoopEdge], edges: Mapping[Pair, LoopEdge], poses: F64, drift: Drift, params: Loops, now: int
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
        if edge.verdict is not Verdict.CANDIDATE or edge.overruled:
            continue
        others = [o for o in near if o.pair != edge.pair and max(ways(edge, o)) < NEIGHBOURHOOD_M]
        # what is ambiguous agrees with nothing: where a place has twins, all that was seen there may be one's
        verdicts = [not o.evidence.ambiguous and agree(edge, o, poses, sum(ways(edge, o)), drift) for o in others]
        support = len({other.newer for other, yes in zip(others, verdicts, strict=True) if yes} - {edge.newer})
        against = verdicts.count(False)
        evidence = replace(edge.evidence, support=support)
        measured = edge.measured.by(evidence)
        if support >= params.support and support > 2 * against:
            reason = f"{summary(evidence)}; {support} others agree"
            out[edge.pair] = replace(
                edge, verdict=Verdict.ACCEPTED, reason=reason, measured=measured, decided_at=now, weight=1.0
            )
        elif edge.pair in out:
            waits = f"{summary(evidence)}; {support} of {params.support} others agree"
            contradicted = f", {against} contradict it" if against else ""
            out[edge.pair] = replace(edge, reason=waits + contradicted, measured=measured, weight=1.0)
    return list(out.values())


def _ends(edges: Iterable[LoopEdge], walked: F64) -> F64:
    """(n, 2) m, walked to the older and to the newer keyframe of each."""
    return np.asarray(walked[np.array([edge.pair for edge in edges], np.int64).reshape(-1, 2)])


def represented(settled: Iterable[LoopEdge], edges: Iterable[LoopEdge], reach: int) -> list[LoopEdge]:
    """The same, those just accepted with the loop that is in the graph for them, if one is next to them.

    Submaps of keyframes a quarter of their length apart share three quarters of it. Two loops between such neighbours,
    at both ends, are one measurement rather than two, and a graph of all of them is dense for nothing.

    Args:
        edges: all, as they count. reach: that quarter, in keyframes.
    """
    counting = [edge.pair for edge in edges if edge.counts]
    out = []
    for edge in settled:
        if edge.verdict is Verdict.ACCEPTED and edge.represented_by is None and edge.pair not in counting:
            near = [pair for pair in counting if max(abs(pair[0] - edge.older), abs(pair[1] - edge.newer)) <= reach]
            edge = replace(edge, represented_by=near[0] if near else None)
            counting += [] if near else [edge.pair]
        out.append(edge)
    return out
