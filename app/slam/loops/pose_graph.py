"""The graph of keyframe poses (paper 2.4, eq. 8), solved incrementally. It stays sound if the solver fails.

The poses are a function of a list of steps, to the last bit. If a list extends the previous one, only the new steps are
solved. Any other list is solved from its beginning. So is everything after an exception, which leaves gtsam's solver
broken.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops.factors import Closing, Factor, PositionPrior, Step, loop_factors
from app.slam.loops.solvers import Incremental, Windowed, optimise
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.types import F64

Edges = Mapping[Pair, LoopEdge]


class PoseGraph:
    """Poses tied by factors.

    Args:
        first: (4, 4), the first pose, which is held. window: how many of the newest poses are
            solved for; older ones are marginalised and stay as they are. 0: all.
    """

    def __init__(self, first: F64, window: int = 0) -> None:
        self._first, self._window = np.array(first, dtype=np.float64), window
        self._asked: list[Step] = []  # of `follow`
        self._failed: tuple[Closing, ...] = ()  # factors of these that the solver failed with
        self._reset()

    def __len__(self) -> int:
        return self._solver.count

    @property
    def poses(self) -> F64:
        """(n, 4, 4)."""
        return self._solver.poses()

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that were done, without factors that the solver failed with."""
        return tuple(self._steps)

    def follow(self, steps: Sequence[Step]) -> tuple[Closing, ...]:
        """Apply these steps from the start; leading steps that are the same objects as before are not repeated.

        Returns:
            All factors of these that the solver failed with; `do` says what became of each.
        """
        known = len(self._asked)
        if len(steps) < known or any(one is not other for one, other in zip(self._asked, steps, strict=False)):
            known, self._failed = 0, ()
            self._reset()
        self._asked = list(steps)
        for step in steps[known:]:
            self._failed += self.do(step)
        return self._failed

    def do(self, step: Factor | Sequence[Closing]) -> tuple[Closing, ...]:
        """Add the next pose by its odometry factor, or loops and position priors of existing poses.

        Returns:
            Factors that the solver failed with. Such loops and priors are left out; such odometry is replaced by a
            factor with a large covariance.
        """
        if not isinstance(step, Factor):
            step = tuple(step)
        if not step:
            return ()
        try:
            self._try(step)
            self._steps.append(step)
            return ()
        except (RuntimeError, ValueError, IndexError, ArithmeticError):  # gtsam's exceptions, and our own below
            done = self._steps
            self._reset()
            for before in done:
                self.do(before)
        if isinstance(step, Factor):
            sound = np.isfinite(step.T_first_second).all()
            T = step.T_first_second if sound else np.eye(4)
            self.do(replace(step, T_first_second=T, covariance=np.eye(6)))
            return (step,)
        if len(step) == 1:
            return step
        return tuple(failed for factor in step for failed in self.do([factor]))

    def _reset(self) -> None:
        self._steps: list[Step] = []
        self._solver = Windowed(self._first, self._window) if self._window else Incremental(self._first)

    def _try(self, step: Step) -> None:
        self._solver.update(step)
        if not np.isfinite(self._solver.newest).all():
            raise ArithmeticError("a pose is not finite")


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of one keyframe. odometry: to it; None for the first. priors: of it alone."""

    odometry: Factor | None
    priors: tuple[PositionPrior, ...]


class Graph:
    """The graph of a history and of its loops with their verdicts: a function of both, whatever was solved before.

    It is solved in the order in which keyframes and loops came.

    Args:
        first: (4, 4), the first pose. window: of the solver.
    """

    def __init__(self, first: F64, window: int) -> None:
        self._solver, self._window = PoseGraph(first, window), window
        self._factors: dict[int, tuple[list[LoopEdge], tuple[Closing, ...]]] = {}  # of the loops decided at a keyframe
        self.failed: tuple[Closing, ...] = ()

    def solve(self, history: Sequence[Measured], edges: Edges, T_odom_imu: F64) -> F64:
        """(k, 4, 4) T_map_imu of the history's keyframes. Steps in common with the last solution are reused.

        Args:
            edges: loops with their verdicts. T_odom_imu: (k, 4, 4).
        """
        arrivals: dict[int, list[LoopEdge]] = {}
        for edge in edges.values():
            if edge.counts:
                arrivals.setdefault(edge.decided_at, []).append(edge)
        steps: list[Step] = []
        for index, measured in enumerate(history):
            loops = self._loops(index, arrivals[index], edges, T_odom_imu) if index in arrivals else ()
            steps += [step for step in (measured.odometry, measured.priors, loops) if step]
        self.failed = self._solver.follow(steps)
        return self._solver.poses[: len(history)]

    def sound(self, edges: Edges) -> dict[Pair, LoopEdge]:
        """The same loops; those that the solver failed with are rejected."""
        out = dict(edges)
        for factor in self.failed:
            if isinstance(factor, Factor) and factor.robust and factor.name in out:
                reason = "the solver failed with it"
                out[factor.name] = replace(out[factor.name], verdict=Verdict.REJECTED, reason=reason)
        return out

    def factors(self, history: Sequence[Measured], edges: Edges, T_odom_imu: F64) -> list[Closing]:
        """All factors of the graph: odometry, priors, loops."""
        odometry = [measured.odometry for measured in history if measured.odometry is not None]
        priors = [prior for measured in history for prior in measured.priors]
        return [*odometry, *priors, *loop_factors(edges.values(), edges, T_odom_imu, window=self._window)]

    def _loops(self, index: int, arrived: list[LoopEdge], edges: Edges, T_odom_imu: F64) -> tuple[Closing, ...]:
        """Factors of loops, the same objects as before if the loops are the same."""
        made_of = arrived + [edges[edge.repeats] for edge in arrived if edge.repeats]
        known = self._factors.get(index)
        if known is None or known[0] != made_of:  # compared by identity
            known = made_of, tuple(loop_factors(arrived, edges, T_odom_imu, window=self._window))
            self._factors[index] = known
        return known[1]


def optimum(poses: F64, factors: Sequence[Closing]) -> F64:
    """(k, 4, 4) T_map_imu by all factors at once, from `poses`. Raises HemislamError if the solver fails."""
    if len(poses) < 2:
        return poses
    try:
        return optimise(poses[0], factors, poses)
    except ArithmeticError as error:
        raise HemislamError(f"The solver fails with this graph ({error}); reject the loop added last.") from error


def failure(factor: Closing) -> str:
    """The notice about a factor that the solver failed with."""
    if isinstance(factor, PositionPrior):
        return f"The solver failed with the position of keyframe {factor.keyframe}; it is left out."
    if factor.robust:
        return f"The solver failed with the loop {'{}-{}'.format(*factor.name)}; the graph continues without it."
    return f"The solver failed with the step to keyframe {factor.second}; it now says little."
