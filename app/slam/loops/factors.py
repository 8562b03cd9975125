"""Measured transforms between keyframes, and what is done to a graph with them."""

from dataclasses import dataclass

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


Step = Factor | tuple[Factor, ...]
"""One change of a graph: odometry to the next pose, or loops between poses that there are."""
