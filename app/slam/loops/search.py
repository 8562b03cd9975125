"""The search for loops at each keyframe of a session. The user's edits play no part in it.

Each keyframe appends to a history; going back means reading less of it. The loops found at a keyframe depend only on
the keyframes up to it, so each keyframe is searched once. To know where to look, the search has a graph of its own,
made of the loops as they were found.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops import slips
from app.slam.loops.detection import Detector
from app.slam.loops.drift import Drift, Expectation, expect
from app.slam.loops.edits import apply_edits
from app.slam.loops.factors import PositionPrior, loosened, odometry_factor
from app.slam.loops.pose_graph import Graph, Measured
from app.slam.loops.support import settle, sparsified
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.loops.verdicts import judge
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe

SURE_M = 0.3
"""If odometry's position is more certain than this (standard deviation), one place that fits is enough."""


class Search:
    """Finds loops among the keyframes of one session. It keeps a thinned cloud of each on disk until `close`.

    Attributes:
        start: parameters that act on restart. detector: holds the keyframes.
        finished: whether the session ends there. graph: without any edits.
    """

    def __init__(self) -> None:
        self.start = LoopsParams()
        self.detector = Detector(self.start)
        self.finished = False
        self._params: list[LoopsParams] = []  # for each keyframe
        self._measured: list[Measured] = []
        self._loose: dict[int, Measured] = {}  # weakened odometry of keyframes before which it slipped
        self._found: list[tuple[LoopEdge, ...]] = []  # when each keyframe came
        self._ends: dict[int, tuple[LoopEdge, ...]] = {}  # also found at the session's end, by the number of keyframes
        self.graph = Graph(np.eye(4), 0)

    def __len__(self) -> int:
        return len(self.detector)

    @property
    def known(self) -> int:
        """Keyframes of the history, including those beyond the present one."""
        return len(self._found)

    @property
    def found(self) -> dict[Pair, LoopEdge]:
        """The candidates with the first `len` keyframes, with their verdicts."""
        last = self._ends[len(self)] if self.finished else ()
        return {edge.pair: edge for found in (*self._found[: len(self)], last) for edge in found}

    @property
    def measured(self) -> Sequence[Measured]:
        """Measurements of the first `len` keyframes. At a detected slip, odometry is weak, so the graph can bend."""
        seen = len(self) - slips.REACH
        return [self._loose.get(k, one) if k <= seen else one for k, one in enumerate(self._measured[: len(self)])]

    @property
    def solved(self) -> tuple[F64, dict[Pair, LoopEdge]]:
        """(k, 4, 4) T_map_imu of the first `len` keyframes, and the loops with their verdicts, without any edits."""
        edges = apply_edits(self.found, (), {})
        poses = self.graph.solve(self.measured, edges, self.detector.poses)
        return poses, self.graph.sound(edges)

    def close(self) -> None:
        self.detector.close()

    def add(self, keyframe: Keyframe, params: LoopsParams, priors: tuple[PositionPrior, ...] = ()) -> None:
        """Take a keyframe, and look for loops of the newest one whose surroundings are complete.

        If the history has another keyframe at this index, that one and all later ones are forgotten. If it has the same
        one, nothing is computed again. Raises HemislamError if an earlier one is missing.

        Args:
            priors: what was measured of this keyframe alone.
        """
        index = keyframe.index
        if index > self.known:
            raise HemislamError(f"Keyframe {index} cannot follow on {self.known} keyframes; one is missing.")
        self.go_to(index)
        if not self._is_known(keyframe, params):
            self.forget()
            if not index:
                self.detector.close()
                self.start, self.detector = params, Detector(params)
                self.graph = Graph(keyframe.T_odom_imu, params.window)
            drift = Drift.of(params)
            odometry = odometry_factor(index, self.detector.head(index - 1), keyframe, drift) if index else None
            self._measured.append(Measured(odometry, priors))
            self._params.append(params)
            self.detector.take(keyframe)
            self._look_for_slip(index - slips.REACH + 1)
            complete = index - self.detector.ahead
            self._found.append(self._look(range(max(complete, 0), complete + 1)))
        self.go_to(index + 1)

    def finish(self) -> None:
        """The session ends here: look for loops of the last keyframes too. `add` and `go_to` take that back."""
        count = len(self)
        if count and count not in self._ends:
            self._ends[count] = self._look(range(max(count - self.detector.ahead, 0), count))
        self.finished = count > 0

    def go_to(self, count: int) -> None:
        """Go to the state after `count` keyframes of the history. Raises HemislamError if it has fewer."""
        if not 0 <= count <= self.known:
            raise HemislamError(f"The loop search knows {self.known} keyframes and cannot go to {count}.")
        self.finished = False
        self.detector.go_to(count)

    def forget(self) -> None:
        """Forget the history beyond the present keyframe."""
        count = len(self)
        for history in (self._params, self._measured, self._found):
            del history[count:]
        self._ends = {end: found for end, found in self._ends.items() if end <= count}
        self._loose = {k: one for k, one in self._loose.items() if k + slips.REACH <= count}
        self.detector.forget()

    def _is_known(self, keyframe: Keyframe, params: LoopsParams) -> bool:
        """Whether this keyframe, with the same parameters, comes next in the history."""
        index = len(self)
        if index == self.known or self._params[index] != params:
            return False
        known = self.detector.head(index)
        return (
            known.stamp_ns == keyframe.stamp_ns
            and np.array_equal(known.T_odom_imu, keyframe.T_odom_imu)
            and np.array_equal(known.covariance, keyframe.covariance, equal_nan=True)
        )

    def _look_for_slip(self, index: int) -> None:
        """Look for a slip of odometry on the step to a keyframe, once the few keyframes after it have come."""
        if index > 0 and self.start.enabled and (slip := self.detector.slip(index)) is not None:
            measured, after = self._measured[index], self.detector.poses[index]
            assert measured.odometry is not None
            self._loose[index] = replace(measured, odometry=loosened(measured.odometry, slip.moved, after[:3, :3]))

    def _look(self, keyframes: range) -> tuple[LoopEdge, ...]:
        """Look for loops of some keyframes. Returns new candidates, and earlier ones with another verdict."""
        detector, now = self.detector, len(self) - 1
        params = self._params[now]
        if not params.enabled or not keyframes:
            return ()
        drift = Drift.of(params)
        poses, known = self.solved
        updates: dict[Pair, LoopEdge] = {}
        for newer in keyframes:
            accepted = [edge for edge in known.values() if edge.verdict is Verdict.ACCEPTED]
            expectation = expect(newer, poses, accepted, drift, detector.resumed, detector.astray)
            fresh = {edge.pair: edge for edge in self._judged(newer, expectation, params) if edge.pair not in known}
            known, settled = known | fresh, list(fresh.values())
            if any(edge.verdict is Verdict.CANDIDATE for edge in settled):
                settled = settle(fresh, known, detector.poses, detector.pauses_before, drift, params, now)
                settled = sparsified(
                    settled, known.values(), detector.poses, poses, detector.pauses_before, detector.half
                )
            updates.update((edge.pair, edge) for edge in settled)
            known.update(updates)
        return tuple(updates.values())

    def _judged(self, newer: int, expectation: Expectation, params: LoopsParams) -> list[LoopEdge]:
        """Candidates with a verdict on each alone."""
        out: list[LoopEdge] = []
        for sighting in self.detector.look(newer, expectation, params):
            between = [index for index in self._loose if sighting.older < index <= min(newer, len(self) - slips.REACH)]
            broken = any(slip.is_break for index in between if (slip := self.detector.slip(index)))
            out.append(judge(sighting, self.detector, expectation, params, broken=broken))
            if out[-1].verdict is Verdict.CANDIDATE and out[-1].evidence.gate_m < SURE_M:
                break
        return out
