"""Measured transforms between keyframes, and what is done to a graph with them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from app.slam.rows import Rows
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class Factor:
    """A measured T_first_second (4, 4) with its covariance (6, 6), first < second.

    Attributes:
        robust: whether a large error pulls less than its square, as a loop's should.
        loop: which loop it is of, if that is not between these two; None: it is.
    """

    first: int
    second: int
    T_first_second: F64
    covariance: F64
    robust: bool = False
    loop: tuple[int, int] | None = None

    @property
    def name(self) -> tuple[int, int]:
        """The keyframes of the loop or of the step."""
        return self.loop or (self.first, self.second)


class Factors:
    """One after the other, as rows of numbers, which lie on disk once they are many."""

    def __init__(self) -> None:
        self._heads = Rows((5,), np.int32)  # first, second, robust, and of which loop; -1 for none
        self._transforms = Rows((4, 4), np.float64)
        self._covariances = Rows((6, 6), np.float64)

    def __len__(self) -> int:
        return len(self._heads)

    def __getitem__(self, index: int) -> Factor:
        first, second, robust, *loop = self._heads.view()[index].tolist()
        T, covariance = self._transforms.view()[index], self._covariances.view()[index]
        return Factor(first, second, T, covariance, bool(robust), None if loop[0] < 0 else (loop[0], loop[1]))

    def stretch(self, begin: int, end: int) -> Iterator[Factor]:
        """From `begin` to before `end`."""
        return (self[index] for index in range(begin, end))

    def append(self, factor: Factor) -> None:
        self._transforms.append(factor.T_first_second)
        self._covariances.append(factor.covariance)
        self._heads.append((factor.first, factor.second, factor.robust, *(factor.loop or (-1, -1))))

    def cut(self, count: int) -> None:
        """Keep the first `count`."""
        for rows in (self._heads, self._transforms, self._covariances):
            rows.go_to(count)


Step = Factor | tuple[Factor, ...]
"""One change of a graph: odometry to the next pose, or loops between poses that there are."""


class Steps:
    """What was done to a graph, in order."""

    def __init__(self) -> None:
        self._odometry, self._loops = Factors(), Factors()
        self._closed = Rows((2,), np.int64)  # how many of both there were after each step that was loops

    def __iter__(self) -> Iterator[Step]:
        stepped = looped = 0
        for steps, loops in self._closed.view().tolist():
            yield from self._odometry.stretch(stepped, steps)
            yield tuple(self._loops.stretch(looped, loops))
            stepped, looped = steps, loops
        yield from self._odometry.stretch(stepped, len(self._odometry))

    def append(self, step: Step) -> None:
        if isinstance(step, Factor):
            self._odometry.append(step)
        else:
            for loop in step:
                self._loops.append(loop)
            self._closed.append((len(self._odometry), len(self._loops)))
