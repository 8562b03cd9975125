"""Search for loops of keyframes: recognise places, judge each candidate, then compare candidates."""

from collections.abc import Callable
from dataclasses import dataclass

from app.slam.loops.detection import Detector
from app.slam.loops.drift import Drift, expect
from app.slam.loops.scan_context import ScanContext
from app.slam.loops.support import placed, settle
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.loops.verdicts import judge
from app.slam.sections import LoopsParams
from app.slam.types import F64

SURE_M = 0.3
"""If odometry knows its position better than this (standard deviation), one place that fits is enough."""

Edges = dict[Pair, LoopEdge]


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search: contexts of the keyframes that had none, and candidates that are new or changed."""

    contexts: tuple[ScanContext, ...] = ()
    updates: tuple[LoopEdge, ...] = ()


def search(
    detector: Detector,
    keyframes: range,
    found: Edges,
    counting: Callable[[Edges], Edges],
    poses: F64,
    params: LoopsParams,
) -> Found:
    """Look for loops of some keyframes; those before the last that lack a context get one.

    Args:
        found: candidates so far. counting: returns them as they count with the user's edits.
        poses: (k, 4, 4) T_map_imu.
    """
    drift = Drift.of(params)
    described, updates, now = detector.described, Edges(), len(detector) - 1
    while detector.described < keyframes.stop:
        detector.learn([detector.describe(detector.described)])
    for newer in keyframes:
        known = {**found, **updates}
        accepted = [edge for edge in counting(known).values() if edge.verdict is Verdict.ACCEPTED]
        expectation = expect(newer, poses, accepted, drift)
        seen = []
        for sighting in detector.look(newer, expectation, params):
            seen.append(judge(sighting, detector, expectation, params))
            if seen[-1].verdict is Verdict.CANDIDATE and seen[-1].evidence.gate_m < SURE_M:
                break
        fresh = {edge.pair: edge for edge in seen if edge.pair not in known}
        updates.update(fresh)
        if any(edge.verdict is Verdict.CANDIDATE for edge in fresh.values()):
            counted = counting({**known, **fresh})
            settled = settle(fresh, counted, detector.poses, drift, params, now)
            settled = placed(settled, counted.values(), detector.poses, poses, detector.half)
            updates.update((edge.pair, edge) for edge in settled)
    contexts = tuple(detector.context(index) for index in range(described, keyframes.stop))
    return Found(contexts, tuple(updates.values()))
