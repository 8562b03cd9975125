"""The graph of keyframe poses (paper 2.4, eq. 8), solved incrementally, and sound whatever the solver fails with.

A list keeps every step that was done to the graph. To take a factor out, or to recover from an exception (after which
gtsam's solver stays broken), the rest of the list is done again. The poses are a function of the list, to the last bit.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from app.slam.loops.factors import Closing, Factor, Step
from app.slam.loops.solvers import Incremental, Windowed
from app.slam.types import F64


class PoseGraph:
    """Poses tied by factors.

    Args:
        first: (4, 4), the first pose, which is held. window: how many of the newest poses are
            solved for; older ones are marginalised and stay as they are. 0: all.
    """

    def __init__(self, first: F64, window: int = 0) -> None:
        self._first, self._window = np.array(first, dtype=np.float64), window
        self._reset()

    def __len__(self) -> int:
        return self._solver.count

    @property
    def poses(self) -> F64:
        """(n, 4, 4)."""
        return self._solver.poses()

    @property
    def steps(self) -> tuple[Step, ...]:
        return tuple(self._steps)

    def extend(self, odometry: Factor) -> tuple[Closing, ...]:
        """Add the next pose by its odometry factor.

        Returns:
            The factor if the solver failed with it; one with a large covariance takes its place.
        """
        return self._do(odometry)

    def close(self, factors: Sequence[Closing]) -> tuple[Closing, ...]:
        """Add loops or position priors. Returns those that the solver failed with; they are not in the graph."""
        return self._do(tuple(factors)) if factors else ()

    def replay(self, steps: Iterable[Step]) -> tuple[Closing, ...]:
        """Start again and do these steps. Returns the factors that the solver failed with."""
        self._reset()
        return tuple(failed for step in steps for failed in self._do(step))

    def _reset(self) -> None:
        self._steps: list[Step] = []
        self._solver = Windowed(self._first, self._window) if self._window else Incremental(self._first)

    def _do(self, step: Step) -> tuple[Closing, ...]:
        try:
            self._try(step)
            self._steps.append(step)
            return ()
        except (RuntimeError, ValueError, IndexError, ArithmeticError):  # gtsam's exceptions, and our own below
            self.replay(self._steps)
        if isinstance(step, Factor):
            sound = np.isfinite(step.T_first_second).all()
            T = step.T_first_second if sound else np.eye(4)
            self._do(replace(step, T_first_second=T, covariance=np.eye(6)))
            return (step,)
        if len(step) == 1:
            return step
        return tuple(failed for factor in step for failed in self.close([factor]))

    def _try(self, step: Step) -> None:
        self._solver.update(step)
        if not np.isfinite(self._solver.newest).all():
            raise ArithmeticError("a pose is not finite")
