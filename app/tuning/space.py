"""The search space: parameters with their declared ranges, or narrower ranges from the user."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from app.slam.errors import HemislamError
from app.slam.params import Leaf, Params, leaves

WIDE = 50.0
"""A range whose ends differ by more than this factor is searched on a logarithmic scale."""


@dataclass(frozen=True, slots=True)
class Dimension:
    """A parameter that varies.

    low, high: the ends of a number's range; for a whole number, multiples of the step. Unused for a switch or a choice.
    """

    leaf: Leaf
    low: float = 0.0
    high: float = 0.0

    @property
    def path(self) -> str:
        return self.leaf.path

    @property
    def distribution(self) -> BaseDistribution:
        leaf = self.leaf
        if leaf.choices:
            return CategoricalDistribution(leaf.choices)
        if isinstance(leaf.default, bool):
            return CategoricalDistribution((False, True))
        if isinstance(leaf.default, int):
            return IntDistribution(int(self.low), int(self.high), step=int(leaf.step or 1))
        if self.low > 0 and self.high / self.low > WIDE:
            return FloatDistribution(self.low, self.high, log=True)
        return FloatDistribution(self.low, self.high)

    def holds(self, value: Any) -> bool:
        """Whether the value lies in the range and, for a whole number, is a multiple of the parameter's step."""
        distribution = self.distribution
        if isinstance(distribution, IntDistribution) and value % distribution.step:
            return False
        return isinstance(distribution, CategoricalDistribution) or self.low <= value <= self.high

    def rounded(self, value: Any) -> Any:
        """The value rounded to the parameter's own step, so that the same setting never runs twice."""
        step = self.leaf.step
        if not isinstance(value, float) or not step:
            return value
        return min(max(float(f"{round(value / step) * step:.9g}"), self.low), self.high)

    def grid(self, points: int) -> list[Any]:
        """At most `points` values, evenly spaced over the range."""
        distribution = self.distribution
        if isinstance(distribution, CategoricalDistribution):
            return list(distribution.choices)
        spread = np.geomspace if getattr(distribution, "log", False) else np.linspace
        values = spread(self.low, self.high, points).tolist()
        if isinstance(distribution, IntDistribution):
            values = [round(value / distribution.step) * distribution.step for value in values]
        return sorted({self.rounded(value) for value in values})


def parse_dimensions(text: str) -> tuple[Dimension, ...]:
    """Parse names such as `ground.alpha,ground.sigma=0.01:0.08`, each with its own range or the declared one.

    Raises:
        HemislamError: a name is unknown or repeated, a parameter cannot vary, or a range is invalid.
    """
    known = {leaf.path: leaf for leaf in leaves()}
    found: dict[str, Dimension] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        path, equals, limits = part.partition("=")
        if path not in known:
            Params().with_values({path: 0})  # raises, and suggests similar names
        if path in found:
            raise HemislamError(f"{path} is named twice; name it once.")
        found[path] = _dimension(known[path], limits if equals else None)
    if not found:
        raise HemislamError("Nothing is named that varies; name parameters as in ground.alpha,ground.sigma.")
    return tuple(found.values())


def _dimension(leaf: Leaf, limits: str | None) -> Dimension:
    if leaf.choices or isinstance(leaf.default, bool):
        if limits is not None:
            raise HemislamError(f"{leaf.path} is {leaf.requirement}, so it has no range; leave `={limits}` out.")
        return Dimension(leaf)
    if not isinstance(leaf.default, int | float) or leaf.minimum is None or leaf.maximum is None:
        raise HemislamError(f"{leaf.path} cannot vary: it is {leaf.requirement}; choose a number, switch or choice.")
    if limits is None:
        return Dimension(leaf, leaf.minimum, leaf.maximum)
    try:
        low, high = (float(end) for end in limits.split(":"))
    except ValueError:
        raise HemislamError(f"`{leaf.path}={limits}` is not a range; write it as {leaf.path}=LEAST:GREATEST.") from None
    steps = ""
    if isinstance(leaf.default, int):
        step = int(leaf.step or 1)
        low, high = float(np.ceil(low / step)) * step, float(np.floor(high / step)) * step
        steps = f" in steps of {step}"
    if not leaf.minimum <= low < high <= leaf.maximum:
        within = f"{leaf.range} {leaf.unit}".rstrip()
        raise HemislamError(f"`{leaf.path}={limits}` is not a range within {within}{steps}.")
    return Dimension(leaf, low, high)


def grid(dimensions: Sequence[Dimension], most: int) -> list[Mapping[str, Any]]:
    """At most `most` settings on a grid; every number has the same count of values.

    Raises:
        HemislamError: even with two values each, there are more settings.
    """

    def size(points: int) -> int:
        return math.prod(len(dimension.grid(points)) for dimension in dimensions)

    if size(2) > most:
        raise HemislamError(
            f"A grid over {len(dimensions)} parameters has at least {size(2)} points, more than {most} trials;"
            " search by bayes or random, or vary fewer parameters."
        )
    points = 2
    while points < most and size(points + 1) <= most:
        points += 1
    axes = [[(dimension.path, value) for value in dimension.grid(points)] for dimension in dimensions]
    return [dict(setting) for setting in product(*axes)]
