"""What the report shows of one recording: trajectories, errors, times, and pieces of the maps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from app.evaluation import crops, figures
from app.evaluation.figures import PALETTE, TRUTH, Line
from app.evaluation.measured import Evaluated, Outcome
from app.slam.types import STAGES

Legend = list[tuple[str, str]]
"""Names and their colours."""

CROP_NOTE = (
    f"{2 * crops.HALF_M:g} × {2 * crops.HALF_M:g} m from above, from {crops.SLICE_M[0]:+g} to {crops.SLICE_M[1]:+g} m"
    " relative to the sensor's height; brighter where more points are. Double or thick walls are errors."
)


@dataclass(frozen=True, slots=True)
class Figure:
    picture: Markup
    caption: str
    legend: Legend


@dataclass(frozen=True, slots=True)
class Pictures:
    """Of one recording. `maps`: by place, names and data URLs of the same piece of each variant's map."""

    legend: Legend
    figures: list[Figure]
    maps: dict[str, list[tuple[str, str]]]


def colours(recordings: Sequence[Evaluated]) -> dict[str, str]:
    """A colour for each outcome's name, the same in all pictures."""
    names = dict.fromkeys(outcome.name for r in recordings for outcome in r.outcomes if not outcome.missing)
    return {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(names)}


def pictures(recording: Evaluated, colour: dict[str, str]) -> Pictures:
    there = [outcome for outcome in recording.outcomes if outcome.trajectory is not None]
    legend = [(outcome.name, colour[outcome.name]) for outcome in there]
    legend += [("truth", TRUTH)] if recording.truth_path is not None else []
    drawn = [_from_above(recording, colour), _errors(there, colour), *_times(there, colour)]
    return Pictures(legend, [figure for figure in drawn if figure is not None], _maps(recording))


def _from_above(recording: Evaluated, colour: dict[str, str]) -> Figure | None:
    """All trajectories, in the truth's world if there is one."""
    lines, path = [], recording.truth_path
    if path is not None:
        lines.append(Line("truth", TRUTH, path[:, 0], path[:, 1], dashed=True))
    for outcome in recording.outcomes:
        places = None
        if outcome.accuracy is not None:
            places = outcome.accuracy.aligned
        elif outcome.trajectory is not None and path is None:
            places = outcome.trajectory.positions
        if places is not None:
            lines.append(Line(outcome.name, colour[outcome.name], places[:, 0], places[:, 1]))
    if not lines:
        return None
    return Figure(figures.chart(lines, "x (m)", "y (m)", equal=True, height=420), "From above", [])


def _errors(outcomes: list[Outcome], colour: dict[str, str]) -> Figure | None:
    lines = [
        Line(outcome.name, colour[outcome.name], outcome.accuracy.times_s, outcome.accuracy.errors_m)
        for outcome in outcomes
        if outcome.accuracy
    ]
    if not lines:
        return None
    picture = figures.chart(lines, "time (s)", "position error (m)", from_zero=True)
    return Figure(picture, "Position error over time, after the alignment", [])


def _times(outcomes: list[Outcome], colour: dict[str, str]) -> list[Figure]:
    timed = {o.name: o.timings_ms for o in outcomes if o.timings_ms is not None and len(o.timings_ms)}
    if not timed:
        return []
    last = float(np.percentile(np.concatenate([times[:, -1] for times in timed.values()]), 99.5))
    edges = np.linspace(0, last, 61)
    lines = [figures.histogram(name, colour[name], times[:, -1], edges) for name, times in timed.items()]
    bars = [(name, times[:, : len(STAGES)].mean(axis=0).tolist()) for name, times in timed.items()]
    return [
        Figure(figures.chart(lines, "time per frame (ms)", "frames (%)", from_zero=True), "Time per frame", []),
        Figure(figures.stacked(bars, STAGES, "ms"), "Mean time by stage", list(zip(STAGES, PALETTE, strict=False))),
    ]


def _maps(recording: Evaluated) -> dict[str, list[tuple[str, str]]]:
    """The same piece of every variant's map, equally bright."""
    found = {}
    for place in crops.PLACES:
        pieces = {outcome.name: outcome.crops[place] for outcome in recording.outcomes if place in outcome.crops}
        filled = [counts[counts > 0] for counts in pieces.values() if counts.any()]
        brightest = float(np.percentile(np.concatenate(filled), 99)) if filled else 1.0
        if pieces:
            found[place] = [(name, figures.density_image(counts, brightest)) for name, counts in pieces.items()]
    return found
