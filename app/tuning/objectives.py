"""The objectives of a search. A new objective is one entry in `OBJECTIVES`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from app.slam.errors import HemislamError
from app.slam.metrics import RPE_OVER, GroundScore

if TYPE_CHECKING:  # the page only names objectives and does not need the evaluation
    from app.evaluation.evaluate import Subject
    from app.evaluation.measured import Outcome


@dataclass(frozen=True, slots=True)
class Objective:
    """Attributes:
    of: its value for a finished run; None if the run has none. greatest: whether a greater value is better.
    needs_truth: whether it is measured against a truth.
    """

    name: str
    title: str
    unit: str
    of: "Callable[[Outcome], Any]"
    greatest: bool = False
    needs_truth: bool = False

    def text(self, value: float | None) -> str:
        """A value with its unit."""
        return "none" if value is None else f"{value:.4g} {self.unit}".rstrip()


def _at(path: str) -> "Callable[[Outcome], Any]":
    return lambda outcome: outcome.value(path)


def _ground_f1(outcome: "Outcome") -> float | None:
    return sum(outcome.ground, GroundScore()).f1 if outcome.ground else None


OBJECTIVES: dict[str, Objective] = {
    objective.name: objective
    for objective in (
        Objective("ate", "ATE, RMSE", "m", _at("accuracy/ate_m/rmse"), needs_truth=True),
        Objective(
            "rpe", f"RPE over {RPE_OVER[1]}, RMSE", "m", _at(f"accuracy/rpe/{RPE_OVER[1]}/m/rmse"), needs_truth=True
        ),
        Objective("loop-drift", "Drift at accepted loops, median", "m", lambda o: (o.run or {}).get("loop_drift_m")),
        Objective("ground-f1", "Ground F1", "", _ground_f1, greatest=True),
        Objective("entropy", "Map entropy", "nats", _at("map_sharpness/entropy")),
        Objective("thickness", "Thickness of planes", "m", _at("map_sharpness/thickness")),
        Objective("frame-time", "CPU time a frame, median", "ms", _at("runtime_ms/cpu/median")),
    )
}


def choose_objectives(names: Sequence[str], subjects: "Sequence[Subject]") -> tuple[Objective, ...]:
    """Find objectives by name. Raises HemislamError: a name is unknown or repeated, or a recording lacks a truth."""
    chosen = []
    for name in names:
        objective = OBJECTIVES.get(name)
        if objective is None:
            raise HemislamError(f"There is no objective {name}; choose from {', '.join(OBJECTIVES)}.")
        if objective in chosen:
            raise HemislamError(f"The objective {name} is named twice; name it once.")
        without = [subject.name for subject in subjects if subject.truth is None]
        if objective.needs_truth and without:
            raise HemislamError(
                f"The objective {name} needs true poses, and {without[0]} has none; give some (--truth on the"
                " command line), or choose an objective that needs none, such as entropy."
            )
        chosen.append(objective)
    return tuple(chosen)


def mean_score(objective: Objective, outcomes: "Sequence[Outcome]") -> float | None:
    """The mean over all recordings; None if a recording has no value."""
    values = [objective.of(outcome) for outcome in outcomes]
    if any(value is None or not np.isfinite(value) for value in values):
        return None
    return float(np.mean(values))
