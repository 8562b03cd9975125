"""The graph of the back end: factors that the solver fails with are left out and reported once."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from app.slam.loops.factors import Closing, Factor, PositionPrior, Step, between
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.support import laid
from app.slam.loops.types import LoopEdge, Pair
from app.slam.types import F64


class Solution:
    """Poses of keyframes by odometry and loops.

    Attributes:
        broken: pairs of loops that the solver failed with; they are not in the graph.
    """

    def __init__(self) -> None:
        self.broken: frozenset[Pair] = frozenset()
        self._graph: PoseGraph | None = None
        self._failures: set[str] = set()  # of the present graph
        self._notices: list[str] = []

    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_map_imu."""
        return np.empty((0, 4, 4)) if self._graph is None else self._graph.poses

    def clear(self) -> None:
        self._graph, self.broken, self._failures = None, frozenset(), set()

    def begin(self, first: F64, window: int) -> None:
        """The first pose, (4, 4)."""
        self.clear()
        self._graph = PoseGraph(first, window)

    def extend(self, odometry: Factor) -> None:
        """The next pose."""
        if self._graph is not None:
            self._report(self._graph.extend(odometry))

    def close(self, loops: Sequence[Factor]) -> None:
        if self._graph is not None:
            self._report(self._graph.close(loops))

    def solve(self, first: F64, window: int, steps: Iterable[Step]) -> None:
        """Solve again from the start. A failure that was reported before is not reported again."""
        before = self._failures
        self.begin(first, window)
        if self._graph is not None:
            self._report(self._graph.replay(steps), before)

    def take_notices(self) -> list[str]:
        """What went wrong since the last call, in sentences."""
        notices, self._notices = self._notices, []
        return notices

    def _report(self, failed: Iterable[Closing], told: Iterable[str] = ()) -> None:
        for factor in failed:
            if isinstance(factor, PositionPrior):
                text = f"The solver failed with the position of keyframe {factor.keyframe.index}; it is left out."
            elif factor.robust:
                self.broken |= {factor.name}
                text = f"The solver failed with the loop {factor.name[0]}-{factor.name[1]}; the graph goes on without."
            else:
                text = f"The solver failed with the step to keyframe {factor.second.index}; it now says little."
            self._failures.add(text)
            if text not in told:
                self._notices.append(text)


def loop_factors(
    edges: Iterable[LoopEdge], by_pair: Mapping[Pair, LoopEdge], T_odom_imu: F64, *, window: int
) -> list[Factor]:
    """The factors of the loops that count.

    Args:
        by_pair: all loops, including those that others repeat. T_odom_imu: (k, 4, 4). window: of the solver. With one,
            each factor is between its own keyframes, as those of the loop that it repeats may have left the window.
    """
    factors = []
    for edge in edges:
        if edge.counts:
            first = by_pair[edge.repeats] if edge.repeats and not window else edge
            T, covariance = edge.T_older_newer, edge.covariance
            if first is not edge:
                T, covariance = laid(edge, first, T_odom_imu)
            factors.append(between(first.older, first.newer, T, covariance / edge.weight, True, edge.pair))
    return factors
