"""The graph of keyframe poses (paper 2.4, eq. 8), solved incrementally, and sound whatever the solver fails with.

The poses are a function of a list of steps, to the last bit. A list that goes on from the one before costs only what is
new. Any other is done from its beginning, as is all after an exception, which leaves gtsam's solver broken.
"""

from collections.abc import Sequence
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
        self._asked: list[Step] = []  # of `follow`
        self._failed: tuple[Closing, ...] = ()  # among them
        self._reset()

    def __len__(self) -> int:
        return self._solver.count

    @property
    def poses(self) -> F64:
        """(n, 4, 4)."""
        return self._solver.poses()

    @property
    def steps(self) -> tuple[Step, ...]:
        """Those that were done, without what the solver failed with."""
        return tuple(self._steps)

    def follow(self, steps: Sequence[Step]) -> tuple[Closing, ...]:
        """Apply these steps from the start; leading steps that are the same objects as before are not repeated.

        Returns:
            All factors among them that the solver failed with; `do` says what became of each.
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
        """Add the next pose by its odometry factor, or loops and position priors of poses that are there.

        Returns:
            What the solver failed with. Loops and priors are left out then; odometry is replaced by a factor with a
            large covariance.
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
