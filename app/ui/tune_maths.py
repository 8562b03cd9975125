"""The plots and texts of the Tune tab: pure functions."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from app.tuning.objectives import Objective
from app.tuning.process import Tried
from app.tuning.trial import Trial
from app.ui.colours import TABLES
from app.ui.html import panel

_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, 334.0, 8.0, 108.0
"""Edges of a scatter plot, in units of its picture."""
_AXES: Final = (24.0, 316.0, 16.0, 120.0)
"""Left, right, top and bottom of the parallel coordinates."""
_OUTLIERS: Final = 5.0
"""Percent of trials whose bad scores may be clipped to the edge of a plot."""
_WIDE: Final = 50.0
"""An axis is logarithmic if its ends differ by more than this factor."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Attributes:
    low, high: values at its two ends. share: position of a value along the axis, 0-1.
    """

    name: str
    low: str
    high: str
    share: Callable[[Any], float]


class Dot(NamedTuple):
    number: int
    x: float
    y: float
    words: str
    best: bool
    chosen: bool


def words(trial: Trial, objectives: Sequence[Objective]) -> str:
    """A trial in one line, as the page shows it on hover."""
    scores = ", ".join(f"{one.title} {one.text(value)}" for one, value in zip(objectives, trial.scores, strict=True))
    return f"trial {trial.number}: {scores} · {trial.name}"


def number_axis(name: str, values: Sequence[float]) -> Axis:
    """An axis over these numbers, logarithmic if their range is wide."""
    low, high = min(values), max(values)
    by = math.log if low > 0 and high > _WIDE * low else float
    begin, span = by(low), by(high) - by(low)

    def share(value: float) -> float:
        return (by(min(max(value, low), high)) - begin) / span if span else 0.5

    # enough digits that the difference of the two ends has three
    digits = max(4, 3 + math.ceil(math.log10(max(abs(low), abs(high)) / (high - low)))) if span else 4
    return Axis(name, f"{low:.{digits}g}", f"{high:.{digits}g}", share)


def score_axis(trials: Sequence[Trial], index: int, objective: Objective) -> Axis:
    """An axis over the scores of an objective, without its worst outliers."""
    values = np.array([_score(trial, index) for trial in trials])
    name = f"{objective.title}, {objective.unit}" if objective.unit else objective.title
    worst = np.percentile(values, _OUTLIERS if objective.greatest else 100 - _OUTLIERS)
    return number_axis(name, np.clip(values, worst, None) if objective.greatest else np.clip(values, None, worst))


def _score(trial: Trial, index: int) -> float:
    value = trial.scores[index]
    return math.nan if value is None else value


def _parameter_axis(path: str, trials: Sequence[Trial]) -> Axis:
    name = path.partition(".")[2].replace("_", " ")
    values = [trial.values[path] for trial in trials if path in trial.values]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return number_axis(name, values)
    kinds = sorted(set(map(str, values)))
    most = max(len(kinds) - 1, 1)
    return Axis(name, kinds[0], kinds[-1], lambda value: kinds.index(str(value)) / most)


def dots(
    found: Tried, objectives: Sequence[Objective], x: tuple[Axis, Callable[[Trial], float]], y: int, chosen: int
) -> tuple[list[Dot], Axis]:
    """Dots of the trials with scores, in a scatter plot over `x`, and the axis of objective `y`."""
    done = [trial for trial in found.trials if trial.complete]
    axis, (across, value) = score_axis(done, y, objectives[y]), x
    return [
        Dot(
            trial.number,
            round(_LEFT + (_RIGHT - _LEFT) * across.share(value(trial)), 1),
            round(_BOTTOM - (_BOTTOM - _TOP) * axis.share(_score(trial, y)), 1),
            words(trial, objectives),
            trial.number in found.best,
            trial.number == chosen,
        )
        for trial in done
    ], axis


def best_so_far(drawn: Sequence[Dot], greatest: bool) -> str:
    """The line of the best score up to each trial."""
    heights = np.array([dot.y for dot in drawn])  # downwards
    best = np.minimum.accumulate(heights) if greatest else np.maximum.accumulate(heights)
    return " ".join(f"{dot.x:g},{height:g}" for dot, height in zip(drawn, best, strict=True))


def parallel(found: Tried, objectives: Sequence[Objective], chosen: int) -> str:
    """Each trial as a line through its parameters and scores; the lighter, the better by the first objective."""
    done = [trial for trial in found.trials if trial.complete and trial.values]
    if len(done) < 2:
        return ""
    paths = list(done[0].values)
    axes = [_parameter_axis(path, done) for path in paths]
    axes += [score_axis(done, index, objective) for index, objective in enumerate(objectives)]
    left, right, top, bottom = _AXES
    across = np.linspace(left, right, len(axes))
    lines = []
    for trial in sorted(done, key=lambda one: (one.number == chosen, one.number in found.best, one.number)):
        values = [*(trial.values[path] for path in paths), *trial.scores]
        shares = [axis.share(value) for axis, value in zip(axes, values, strict=True)]
        good = shares[len(paths)] if objectives[0].greatest else 1 - shares[len(paths)]
        colour = TABLES["viridis"][round(255 * good)]
        points = " ".join(f"{x:.0f},{bottom - (bottom - top) * y:.1f}" for x, y in zip(across, shares, strict=True))
        lines.append((trial.number, points, colour.tolist(), words(trial, objectives), trial.number == chosen))
    ends = {0: "start", len(axes) - 1: "end"}
    places = enumerate(zip(across, axes, strict=True))
    drawn = [(round(float(x), 1), axis, ends.get(place, "middle")) for place, (x, axis) in places]
    return panel("tune.parallel", drawn, lines)


def plots(found: Tried, objectives: Sequence[Objective], chosen: int) -> str:
    """All results of the trials as HTML; "" before the first score."""
    done = [trial for trial in found.trials if trial.complete]
    if not done:
        return ""
    numbers = number_axis("trial", [0, max(found.trials[-1].number, 1)])
    parts = [_best(found, objectives, chosen)]
    for index, objective in enumerate(objectives):
        drawn, axis = dots(found, objectives, (numbers, lambda trial: trial.number), index, chosen)
        line = best_so_far(drawn, objective.greatest)
        parts.append(panel("tune.scatter", f"{axis.name}, over trials", drawn, line, numbers, axis))
    if len(objectives) == 2:
        across = score_axis(done, 0, objectives[0])
        drawn, axis = dots(found, objectives, (across, lambda trial: _score(trial, 0)), 1, chosen)
        parts.append(panel("tune.scatter", f"Pareto front: {axis.name}, over the first", drawn, "", across, axis))
    parts.append(parallel(found, objectives, chosen))
    if found.importance:
        rows = [(name.partition(".")[2].replace("_", " "), round(100 * s)) for name, s in found.importance.items()]
        parts.append(panel("tune.importance", f"What {objectives[0].title} depends on", rows))
    return "".join(parts)


def _best(found: Tried, objectives: Sequence[Objective], chosen: int) -> str:
    held = {trial.number: trial.scores for trial in found.held_back}
    numbers = list(dict.fromkeys([0, *found.best[:5], *([chosen] if chosen >= 0 else [])]))
    shown = [found.trials[number] for number in numbers if number < len(found.trials)]
    heads = [one.title.partition(",")[0] for one in objectives]
    if held:
        heads += [f"{head}, held back" for head in heads]
    rows = []
    for trial in shown:
        scores = [one.text(value) for one, value in zip(objectives, trial.scores, strict=True)]
        if held:
            again = held.get(trial.number, (None,) * len(objectives))
            scores += ["" if value is None else one.text(value) for one, value in zip(objectives, again, strict=True)]
        rows.append((trial.number, scores, words(trial, objectives), trial.number == chosen))
    picked = next((trial for trial in shown if trial.number == chosen), None)
    return panel("tune.best", heads, rows, words(picked, objectives) if picked else "")


def left(seconds: float) -> str:
    """A remaining time in words."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s left"
    return f"{round(seconds / 60)} min left" if seconds < 5400 else f"{seconds / 3600:.1f} h left"
