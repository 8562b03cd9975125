"""Measured transforms between keyframes, and what is done to a graph with them."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

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


class Odometry:
    """Factors from each pose to the next, as rows of numbers: every keyframe's is kept."""

    def __init__(self) -> None:
        self._transforms = Rows((4, 4), np.float64)
        self._covariances = Rows((6, 6), np.float64)

    def __len__(self) -> int:
        return len(self._transforms)

    def __getitem__(self, index: int) -> Factor:
        """From pose `index` to the one after it."""
        return Factor(index, index + 1, self._transforms.view()[index], self._covariances.view()[index])

    def __iter__(self) -> Iterator[Factor]:
        return (self[index] for index in range(len(self)))

    def append(self, factor: Factor) -> None:
        """To the next pose."""
        self._transforms.append(factor.T_first_second)
        self._covariances.append(factor.covariance)

    def cut(self, count: int) -> None:
        """Keep the first `count`."""
        self._transforms.go_to(count)
        self._covariances.go_to(count)


Step = Factor | tuple[Factor, ...]
"""One change of a graph: odometry to the next pose, or loops between poses that there are."""


class Steps:
    """What was done to a graph, in order."""

    def __init__(self) -> None:
        self._odometry = Odometry()
        self._loops: list[tuple[int, tuple[Factor, ...]]] = []  # with how much odometry before them

    def __iter__(self) -> Iterator[Step]:
        odometry, gone = iter(self._odometry), 0
        for count, loops in self._loops:
            yield from islice(odometry, count - gone)
            yield loops
            gone = count
        yield from odometry

    def append(self, step: Step) -> None:
        if isinstance(step, Factor):
            self._odometry.append(step)
        else:
            self._loops.append((len(self._odometry), step))
