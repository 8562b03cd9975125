"""The figures of a report: trajectories, errors, times and pieces of the maps, as inline SVG and PNG in one file."""

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from PIL import Image

from app.evaluation import crops
from app.evaluation.measured import Evaluated, Outcome
from app.slam.types import F64, STAGES, U16

PALETTE = ("#2563eb", "#ea580c", "#16a34a", "#9333ea", "#dc2626", "#0891b2", "#ca8a04", "#db2777")
TRUTH = "var(--ink)"
"""Colour of the page's text, light or dark."""
_MOST_POINTS = 700
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 560, 56, 14, 12, 40
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=select_autoescape(("html", "svg")),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def _tex(text: str) -> str:
    """Escape a text for LaTeX."""
    signs = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
    signs |= {"°": r"\textdegree{}"} | {sign: f"\\{sign}" for sign in "&%$#_{}"}
    return "".join(signs.get(sign, sign) for sign in text)


_TEMPLATES.filters["tex"] = _tex


def render(template: str, **values: Any) -> str:
    """Fill in a file of the folder `templates`."""
    return _TEMPLATES.get_template(template).render(**values)


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart through (n,) points x, y."""

    name: str
    colour: str
    x: F64
    y: F64
    dashed: bool = False


def chart(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    equal: bool = False,
    from_zero: bool = False,
    height: int = 300,
) -> Markup:
    """A line chart; later lines are thinner, so that the lines below remain visible.

    `equal`: the same scale on both axes, as for a map. `from_zero`: the y axis begins at 0.
    """
    x0, x1 = _range([line.x for line in lines])
    y0, y1 = _range([line.y for line in lines], from_zero=from_zero)
    right, bottom = _WIDTH - _RIGHT, height - _BOTTOM
    if equal:
        scale = max((x1 - x0) / (right - _LEFT), (y1 - y0) / (bottom - _TOP))
        half_x, half_y = scale * (right - _LEFT) / 2, scale * (bottom - _TOP) / 2
        x0, x1 = (x0 + x1) / 2 - half_x, (x0 + x1) / 2 + half_x
        y0, y1 = (y0 + y1) / 2 - half_y, (y0 + y1) / 2 + half_y

    def at_x(x: F64 | float) -> F64:
        return np.asarray(_LEFT + (x - x0) / (x1 - x0) * (right - _LEFT)).round(1)

    def at_y(y: F64 | float) -> F64:
        return np.asarray(bottom - (y - y0) / (y1 - y0) * (bottom - _TOP)).round(1)

    drawn = []
    for line in lines:
        step = max(1, len(line.x) // _MOST_POINTS)
        chosen = np.unique(np.r_[np.arange(0, len(line.x), step), len(line.x) - 1])
        points = zip(at_x(line.x[chosen]), at_y(line.y[chosen]), strict=True)
        drawn.append((line, " ".join(f"{x:g},{y:g}" for x, y in points)))
    return _axes(
        "chart.svg",
        height,
        (x_label, y_label),
        x_ticks=[(float(at_x(x)), f"{x:.12g}") for x in _ticks(x0, x1, 7)],
        y_ticks=[(float(at_y(y)), f"{y:.12g}") for y in _ticks(y0, y1, 5)],
        lines=drawn,
    )


@dataclass(frozen=True, slots=True)
class Body:
    """A distribution of values: a shape with half widths (n,) 0-1 at `values` (n,), a line from `low` to `high`, and a
    mark at the median."""

    name: str
    colour: str
    values: F64
    widths: F64
    low: float
    high: float
    middle: float


def box(name: str, colour: str, values: F64) -> Body:
    """A box at the quartiles, and a line from 5 to 95 %."""
    low, first, middle, third, high = np.percentile(values, [5, 25, 50, 75, 95])
    return Body(name, colour, np.array([first, third]), np.ones(2), low, high, middle)


def violin(name: str, colour: str, values: F64) -> Body:
    """A shape as wide as values are frequent, on a logarithmic scale, from 0.5 to 99.5 %."""
    low, middle, high = np.percentile(values, [0.5, 50, 99.5])
    edges = np.geomspace(0.9 * low, 1.1 * high, 65)
    counts = np.histogram(values, edges)[0].astype(np.float64)
    smooth = np.convolve(counts, np.exp(-0.5 * (np.arange(-6, 7) / 2.5) ** 2), mode="same")
    return Body(name, colour, np.sqrt(edges[1:] * edges[:-1]), smooth / max(smooth.max(), 1.0), low, high, middle)


def bodies(groups: Sequence[tuple[str, Sequence[Body]]], x_label: str, y_label: str) -> Markup:
    """Groups of distributions side by side on a logarithmic axis; `groups`: names and bodies."""
    height, right = 300, _WIDTH - _RIGHT
    bottom = height - _BOTTOM
    every = [body for _, group in groups for body in group]
    low = np.log10(max(min(min(body.low, body.values.min()) for body in every), 1e-6)) - 0.05
    high = np.log10(max(max(body.high, body.values.max()) for body in every)) + 0.05

    def at_y(y: F64 | float) -> F64:
        level = (np.log10(np.maximum(y, 1e-6)) - low) / (high - low)
        return np.asarray(bottom - level * (bottom - _TOP)).round(1)

    slot = (right - _LEFT) / (len(every) + len(groups))
    place, drawn, labels = _LEFT + slot, [], []
    for label, group in groups:
        labels.append((round(place + slot * (len(group) - 1) / 2, 1), label))
        for body in group:
            half = 0.4 * min(slot, 60.0) * body.widths
            xs, ys = np.r_[place - half, (place + half)[::-1]], np.r_[body.values, body.values[::-1]]
            outline = " ".join(f"{x:.1f},{y:g}" for x, y in zip(xs, at_y(ys), strict=True))
            marks = (float(at_y(value)) for value in (body.low, body.high, body.middle))
            drawn.append((body, outline, round(place, 1), round(0.4 * min(slot, 60.0), 1), *marks))
            place += slot
        place += slot
    ticks = [m * 10.0**k for k in range(int(np.floor(low)), int(np.ceil(high)) + 1) for m in (1, 2, 5)]
    steps = [tick for tick in ticks if low <= np.log10(tick) <= high]
    if len(steps) > 9:
        steps = [tick for tick in steps if f"{tick:e}".startswith("1")]
    y_ticks = [(float(at_y(tick)), f"{tick:g}") for tick in steps]
    return _axes("bodies.svg", height, (x_label, y_label), x_ticks=[], y_ticks=y_ticks, labels=labels, bodies=drawn)


def stacked(rows: Sequence[tuple[str, Sequence[float]]], parts: Sequence[str], unit: str) -> Markup:
    """Horizontal bars, one per row, each of several parts."""
    longest = max((sum(values) for _, values in rows), default=0.0) or 1.0
    left, scale = 110.0, 350 / longest
    drawn = []
    for name, values in rows:
        ends = left + scale * np.cumsum(values)
        bars = [
            (part, f"{value:.2f} {unit}", colour, f"{end - value * scale:.1f}", f"{max(value * scale, 0):.1f}")
            for part, value, colour, end in zip(parts, values, cycle(PALETTE), ends, strict=False)
        ]
        drawn.append((name, bars, f"{ends[-1] + 6:.1f}", f"{sum(values):.2f} {unit}"))
    return Markup(render("bars.svg", rows=drawn))


def density_image(counts: U16, densest: float) -> str:
    """Points per pixel as a PNG in a data URL, light to dark on a logarithmic scale up to `densest`."""
    level = np.log1p(counts.astype(np.float64)) / np.log1p(max(densest, 1.0))
    level = np.where(counts > 0, 0.45 + 0.55 * level, 0.0)  # make single points visible too
    stops = np.array([[255, 255, 255], [168, 200, 236], [84, 140, 210], [38, 78, 158], [12, 18, 58]])
    ramp = [np.interp(np.linspace(0, 1, 256), np.linspace(0, 1, 5), stops[:, channel]) for channel in range(3)]
    image = Image.fromarray(np.rint(255 * level.clip(0, 1)).astype(np.uint8))
    image.putpalette(np.rint(ramp).astype(np.uint8).T.tobytes())
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def _axes(template: str, height: int, titles: tuple[str, str], **drawn: Any) -> Markup:
    """A chart between two axes; titles: of x and y."""
    frame = {"width": _WIDTH, "height": height, "left": _LEFT, "right": _WIDTH - _RIGHT, "top": _TOP}
    x_label, y_label = titles
    return Markup(render(template, **frame, bottom=height - _BOTTOM, x_label=x_label, y_label=y_label, **drawn))


def _range(values: Iterable[F64], *, from_zero: bool = False) -> tuple[float, float]:
    joined = np.concatenate([*values])
    low, high = (0.0 if from_zero else float(joined.min())), float(joined.max())
    room = 0.04 * (high - low) or 1.0
    return (low if from_zero else low - room), high + room


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers, about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(next(m * power for m in (1, 2, 5, 10) if m * power >= raw))
    return [round(value, 10) + 0.0 for value in np.arange(np.ceil(low / step) * step, high + step * 1e-6, step)]


# --- what is shown of a recording -----------------------------------------------------------------
Legend = list[tuple[str, str]]
"""Names with their colours."""

CROP_NOTE = (
    f"{2 * crops.HALF_M:g} × {2 * crops.HALF_M:g} m from above, from {crops.SLICE_M[0]:+g} to {crops.SLICE_M[1]:+g} m"
    " relative to the sensor's height; darker where more points are. Double or thick walls are errors."
)


@dataclass(frozen=True, slots=True)
class Figure:
    picture: Markup
    caption: str
    legend: Legend | None = None


@dataclass(frozen=True, slots=True)
class Pictures:
    """The figures of a recording. `maps`: by place, names and data URLs of that piece of each variant's map."""

    legend: Legend
    figures: list[Figure]
    maps: dict[str, list[tuple[str, str]]]


def colours(recordings: Sequence[Evaluated]) -> dict[str, str]:
    """A colour for each outcome's name, the same in all figures."""
    names = dict.fromkeys(outcome.name for r in recordings for outcome in r.outcomes if not outcome.missing)
    return {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(names)}


def pictures(recording: Evaluated, colour: dict[str, str]) -> Pictures:
    there = [outcome for outcome in recording.outcomes if outcome.trajectory is not None]
    legend = [(outcome.name, colour[outcome.name]) for outcome in there]
    legend += [("truth", TRUTH)] if recording.truth_path is not None else []
    drawn = [*_paths(recording, colour), *_errors(there, colour), *_times(there, colour)]
    return Pictures(legend, drawn, _maps(recording))


def _paths(recording: Evaluated, colour: dict[str, str]) -> list[Figure]:
    """All trajectories from above and from the side, in the truth's world if there is one."""
    paths = []
    for outcome in recording.outcomes:
        if outcome.accuracy is not None:
            paths.append((outcome.name, colour[outcome.name], outcome.accuracy.aligned, False))
        elif outcome.trajectory is not None and recording.truth_path is None:
            paths.append((outcome.name, colour[outcome.name], outcome.trajectory.positions, False))
    if recording.truth_path is not None:
        paths.append(("truth", TRUTH, recording.truth_path, True))
    if not paths:
        return []
    above, side = (
        [Line(name, shade, places[:, 0], places[:, axis], dashed) for name, shade, places, dashed in paths]
        for axis in (1, 2)
    )
    return [
        Figure(chart(above, "x (m)", "y (m)", equal=True, height=420), "From above"),
        Figure(chart(side, "x (m)", "z (m)", height=200), "From the side, heights enlarged"),
    ]


def _errors(outcomes: list[Outcome], colour: dict[str, str]) -> list[Figure]:
    """Position error over time and over distance, and drift over pieces of the path."""
    known = [(outcome.name, colour[outcome.name], outcome.accuracy) for outcome in outcomes if outcome.accuracy]
    if not known:
        return []
    of_time = [Line(name, shade, accuracy.times_s, accuracy.errors_m) for name, shade, accuracy in known]
    of_way = [Line(name, shade, accuracy.walked_m, accuracy.errors_m) for name, shade, accuracy in known]
    figures = [
        Figure(chart(lines, label, "position error (m)", from_zero=True), f"Position error over {what}")
        for lines, label, what in (
            (of_time, "time (s)", "time, after the alignment"),
            (of_way, "true path (m)", "distance, after the alignment"),
        )
    ]
    pieces = sorted({metres for _, _, accuracy in known for metres in accuracy.drift})
    groups = [
        (f"{metres:g} m", [box(name, shade, a.drift[metres]) for name, shade, a in known if metres in a.drift])
        for metres in pieces
    ]
    if groups:
        caption = "Drift over pieces of the path: quartiles, and a line from 5 to 95 %"
        figures.append(Figure(bodies(groups, "length of the piece", "wrong by (% of it)"), caption))
    return figures


def _times(outcomes: list[Outcome], colour: dict[str, str]) -> list[Figure]:
    timed = {o.name: o.timings_ms for o in outcomes if o.timings_ms is not None and len(o.timings_ms)}
    if not timed:
        return []
    groups = [("", [violin(name, colour[name], times[:, -1]) for name, times in timed.items()])]
    figures = [Figure(bodies(groups, "", "time per frame (ms)"), "Time per frame")]
    staged = [outcome.name for outcome in outcomes if outcome.staged and outcome.name in timed]
    if staged:
        bars = [(name, timed[name][:, : len(STAGES)].mean(axis=0).tolist()) for name in staged]
        legend = list(zip(STAGES, PALETTE, strict=False))
        figures.append(Figure(stacked(bars, STAGES, "ms"), "Mean time by stage", legend))
    return figures


def _maps(recording: Evaluated) -> dict[str, list[tuple[str, str]]]:
    """The same piece of every variant's map, on one scale."""
    found = {}
    for place in crops.PLACES:
        pieces = {outcome.name: outcome.crops[place] for outcome in recording.outcomes if place in outcome.crops}
        filled = [counts[counts > 0] for counts in pieces.values() if counts.any()]
        densest = float(np.percentile(np.concatenate(filled), 99)) if filled else 1.0
        if pieces:
            found[place] = [(name, density_image(counts, densest)) for name, counts in pieces.items()]
    return found
