"""The settings tried, and the best of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from app.tuning.objectives import Objective

SearchMethod = Literal["bayes", "random", "grid"]
"""How the next settings are chosen."""
DEFAULTS = "as given"
"""Name of the first trial: the parameters that the user gave."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Attributes:
    values: by dotted name; empty for the first trial. scores: by objective, None if missing. error: why it failed.
    """

    number: int
    values: Mapping[str, Any]
    scores: tuple[float | None, ...]
    error: str = ""

    @property
    def name(self) -> str:
        return ", ".join(f"{path} = {value}" for path, value in self.values.items()) or DEFAULTS

    @property
    def complete(self) -> bool:
        return None not in self.scores


def front(trials: Sequence[Trial], objectives: Sequence[Objective]) -> list[Trial]:
    """The Pareto front: trials that no other trial beats, sorted by the first objective, the best first."""

    def costs(trial: Trial) -> list[float]:
        scores = zip(objectives, trial.scores, strict=True)
        return [-score if one.greatest else score for one, score in scores if score is not None]

    best: list[Trial] = []
    for trial in sorted((one for one in trials if one.complete), key=lambda one: (costs(one), one.number)):
        # a trial that beats this one comes before it
        if not any(all(a <= b for a, b in zip(costs(other), costs(trial), strict=True)) for other in best):
            best.append(trial)
    return best


def beats(trial: Trial, other: Trial, objectives: Sequence[Objective]) -> bool:
    """Whether one trial is better than the other in some objective and worse in none."""
    return trial != other and front((other, trial), objectives) == [trial]


def proposal(trials: Sequence[Trial], held_back: Sequence[Trial], objectives: Sequence[Objective]) -> Trial | None:
    """The setting to use; None if no trial has a result.

    On the part held back, it must beat the given parameters; otherwise these stay. Without that part, it is the best
    trial.
    """
    if not held_back:
        return next(iter(front(trials, objectives)), None)
    given = held_back[0]
    better = (trial for trial in front(held_back, objectives) if beats(trial, given, objectives))
    return next(better, given)


def advice(trials: Sequence[Trial], held_back: Sequence[Trial], objectives: Sequence[Objective]) -> str:
    """The result on the part held back, in a sentence; "" if there is no such part."""
    best = proposal(trials, held_back, objectives)
    if not held_back or best is None:
        return ""
    if not any(trial.complete for trial in held_back):
        return "On the part held back no setting gives a result; search on another part of the recording."
    if best.number:
        return f"Trial {best.number} is also better than the parameters as given on the part held back."
    return "On the part held back nothing is better than the parameters as given: keep them."
