"""The tables of the report as plain rows. A table is a list of indicators: a label, a value, and its format."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from app.evaluation import paper
from app.evaluation.job import GROUND_RANGES_M
from app.evaluation.measured import START_S, Accuracy, Evaluated, Outcome
from app.slam.metrics import RPE_OVER, GroundScore
from app.slam.types import TIMINGS

Number = float | None


@dataclass(frozen=True, slots=True)
class TableRow:
    """Attributes:
    group: the recording. label: of the row. cells: texts by column. best: index of the best cells.
    """

    group: str
    label: str
    cells: tuple[str, ...]
    best: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Table:
    """`folded`: closed at first, on a page where that is possible."""

    title: str
    columns: tuple[str, ...]
    rows: list[TableRow]
    note: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Indicator:
    """One row of a table for each recording. `ranked`: the smallest value is the best."""

    label: str
    value: Callable[[Outcome], Number]
    form: str
    ranked: bool = True


def make_tables(recordings: Sequence[Evaluated]) -> list[Table]:
    """All tables that have rows."""
    made = [accuracy(recordings), all_errors(recordings), runtime(recordings), stages(recordings)]
    made += [map_sharpness(recordings), ground(recordings), beside_paper(recordings)]
    return [table for table in made if table.rows]


def accuracy(recordings: Sequence[Evaluated]) -> Table:
    """As the paper's Table 2."""

    def of(value: Callable[[Accuracy], Number]) -> Callable[[Outcome], Number]:
        return lambda outcome: value(outcome.accuracy) if outcome.accuracy else None

    def rpe(over: str) -> Callable[[Outcome], Number]:
        return of(lambda a: _rmse(a, over))

    def rpe_ratio(a: Accuracy) -> Number:
        error = _rmse(a, RPE_OVER[0])
        return None if error is None else error / a.distance_m

    indicators = [
        Indicator("ATE, RMSE (m)", of(lambda a: a.ate_m["rmse"]), ".4f"),
        Indicator("ATE, mean (m)", of(lambda a: a.ate_m["mean"]), ".4f"),
        Indicator("ATE, max (m)", of(lambda a: a.ate_m["max"]), ".4f"),
        Indicator(f"ATE, RMSE after {START_S:g} s (m)", of(lambda a: a.later_m), ".4f"),
        Indicator("ATE, rotation RMSE (°)", of(lambda a: a.ate_deg["rmse"] if a.ate_deg else None), ".3f"),
        Indicator("ATE ratio error", of(lambda a: a.ate_m["rmse"] / a.distance_m), ".2e"),
        *(Indicator(f"RPE over {over} (m)", rpe(over), ".4f") for over in RPE_OVER),
        Indicator("RPE ratio error", of(rpe_ratio), ".2e"),
    ]
    names = _names(recordings)
    return Table(
        "Trajectory accuracy",
        names,
        _rows(recordings, names, indicators),
        "As the paper's Table 2. ATE: after one SE(3) alignment of positions (Umeyama, no scale). RPE: of the motion"
        " between poses at the given distance. Both against the truth interpolated at our stamps. Ratios are to the"
        f' length of the true path. Values are RMSE unless stated otherwise; "after {START_S:g} s" is aligned again'
        " without the start, where a slip of a centimetre moves all later poses. The smallest of a row is bold.",
    )


def all_errors(recordings: Sequence[Evaluated]) -> Table:
    """Every error of position and of rotation, and each as a ratio to the path length."""
    names = _names(recordings)
    rows: list[TableRow] = []
    for recording in recordings:
        measured = [outcome.accuracy if outcome else None for outcome in _by_name(recording, names)]
        found = [a.errors() if a else {} for a in measured]
        lengths = [a.distance_m if a else None for a in measured]
        for of, unit in dict.fromkeys(key for entry in found for key in entry):
            what, shown, form = {"m": ("position", "m", ".4f"), "deg": ("rotation", "°", ".3f")}[unit]
            spreads = [entry.get((of, unit)) for entry in found]
            ratios = [
                {kind: value / length for kind, value in spread.items()} if spread and length else None
                for spread, length in zip(spreads, lengths, strict=True)
            ]
            rows.append(_spreads(recording.name, f"{of}, {what} ({shown})", spreads, form))
            if any(ratios):
                per_metre = " (°/m)" if unit == "deg" else ""
                rows.append(_spreads(recording.name, f"{of}, {what} / path length{per_metre}", ratios, ".2e"))
        if any(lengths):
            poses = [float(a.poses) if a else None for a in measured]
            rows.append(_row(recording.name, "true path length (m)", lengths, ".2f", ranked=False))
            rows.append(_row(recording.name, "poses compared", poses, ".0f", ranked=False))
    return Table(
        "All errors, RMSE / mean / max",
        names,
        rows,
        "As the table before. A ratio is the error divided by the length of the true path; that of position has no"
        " unit. A dash: the path is too short for a pair at that distance, the truth has no orientations, or positions"
        " along one line do not fix the rotation. The smallest RMSE of a row is bold.",
        folded=True,
    )


def runtime(recordings: Sequence[Evaluated]) -> Table:
    """As the paper's Table 3."""

    def of(*path: str, scale: float = 1.0) -> Callable[[Outcome], Number]:
        return lambda outcome: scale * _at(outcome.runtime, *path) if outcome.runtime else None

    indicators = [
        Indicator("median (ms)", of("total", "median"), ".2f"),
        Indicator("95 % (ms)", of("total", "p95"), ".2f"),
        Indicator("max (ms)", of("total", "max"), ".2f", ranked=False),
        Indicator("mean (ms)", of("total", "mean"), ".2f"),
        Indicator("CPU time per frame, mean (ms)", of("cpu", "mean"), ".2f"),
        Indicator("under 50 ms (%)", of("under_50_ms", scale=100), ".1f", ranked=False),
        Indicator("under 100 ms (%)", of("under_100_ms", scale=100), ".1f", ranked=False),
        Indicator("peak memory (MB)", of("peak_memory_mb"), ".0f", ranked=False),
    ]
    times = [outcome.runtime for recording in recordings for outcome in recording.outcomes if outcome.runtime]
    threads = " or ".join(str(number) for number in sorted({time["threads"] for time in times}))
    names = _names(recordings, run=True)
    return Table(
        "Run time per frame",
        names,
        _rows(recordings, names, indicators),
        f"As the paper's Table 3. All stages of a frame, without reading the file, on {threads} thread(s) per variant."
        " Variants that run side by side share memory and caches, so --jobs 1 gives the quietest times. The machine's"
        f" load was up to {max((time['load'] for time in times), default=0.0):.1f}. Where that is more than its cores,"
        " other work made frames wait, and CPU time is the better measure. CPU time is measured over whole frames, not"
        " by stage.",
    )


def stages(recordings: Sequence[Evaluated]) -> Table:
    rows = []
    for recording in recordings:
        for outcome in recording.outcomes:
            if time := outcome.runtime:
                cells = (
                    " / ".join(f"{time[stage][what]:.2f}" for what in ("median", "p95", "max")) for stage in TIMINGS
                )
                rows.append(TableRow(recording.name, outcome.name, tuple(cells)))
    note = "Wall time of each stage of a frame. CPU time is measured over whole frames only; see the table before."
    return Table("Stages, median / 95 % / max (ms)", TIMINGS, rows, note)


def map_sharpness(recordings: Sequence[Evaluated]) -> Table:
    def of(name: str, scale: float = 1.0) -> Callable[[Outcome], Number]:
        def value(outcome: Outcome) -> Number:
            number = outcome.run["map_sharpness"][name] if outcome.run else None
            return None if number is None else scale * number

        return value

    indicators = [
        Indicator("mean map entropy (nats)", of("entropy"), ".3f"),
        Indicator("plane thickness (mm)", of("thickness", 1e3), ".1f"),
        Indicator("revisit gap, median (mm)", of("revisit_median", 1e3), ".1f"),
        Indicator("revisit gap, 95 % (mm)", of("revisit_p95", 1e3), ".1f"),
    ]
    names = _names(recordings, run=True)
    return Table(
        "Map sharpness",
        names,
        _rows(recordings, names, indicators),
        "The paper's Figure 7 in numbers, without truth: the entropy of the points in balls of 0.3 m, the spread of"
        " points across the planes they form, and the distance along the normal between two passes over the same"
        " surface (at least 20 s and 20 m of path apart; gaps over 1 m are not recognised). Lower is sharper.",
    )


def ground(recordings: Sequence[Evaluated]) -> Table:
    rows = []
    for recording in recordings:
        for outcome in recording.outcomes:
            if (scores := outcome.ground) is None:
                continue
            for label, shown in (("precision", "precision"), ("recall", "recall"), ("f1", "F1")):
                values = [getattr(score, label) for score in (sum(scores, GroundScore()), *scores)]
                cells = tuple("–" if np.isnan(value) else f"{value:.3f}" for value in values)
                rows.append(TableRow(recording.name, f"{outcome.name}, {shown}", cells))
    columns = ("all", *(f"{low:g}–{high:g} m" for low, high in pairwise(GROUND_RANGES_M)))
    note = "Against the labels that the recording's own points carry, by distance from the sensor."
    return Table("Ground segmentation", columns, rows, note)


def beside_paper(recordings: Sequence[Evaluated]) -> Table:
    """Ours and the paper's own, for the simulated twins of its sequences."""

    def of_paper(values: dict[str, float]) -> Callable[[Outcome], Number]:
        return lambda outcome: values.get(outcome.name)

    names = ("FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours")
    rows: list[TableRow] = []
    for recording in recordings:
        if (sequence := paper.SEQUENCES.get(recording.name.partition("-")[0])) is None:
            continue
        indicators = [
            Indicator("ATE (m), here", lambda o: o.accuracy.ate_m["rmse"] if o.accuracy else None, ".4f"),
            Indicator("ATE (m), paper", of_paper(sequence.ate_m), ".2f"),
            Indicator("RPE (m), here, per frame", lambda o: _rmse(o.accuracy, RPE_OVER[0]), ".4f"),
            Indicator("RPE (m), paper", of_paper(sequence.rpe_m), ".2f"),
            Indicator("ms per frame, here", lambda o: _at(o.runtime, "total", "median"), ".1f"),
            Indicator("ms per frame, paper", of_paper(sequence.runtime_ms), ".1f"),
        ]
        rows += _rows([recording], names, indicators)
    return Table("Beside the paper", names, rows, paper.NOT_COMPARABLE)


def _names(recordings: Iterable[Evaluated], *, run: bool = False) -> tuple[str, ...]:
    """Names of all outcomes in order of appearance; with `run` only those of this engine."""
    outcomes = [outcome for recording in recordings for outcome in recording.outcomes]
    return tuple(dict.fromkeys(o.name for o in outcomes if not run or o.run is not None or o.missing))


def _by_name(recording: Evaluated, names: Sequence[str]) -> list[Outcome | None]:
    outcomes = {outcome.name: outcome for outcome in recording.outcomes}
    return [outcomes.get(name) for name in names]


def _rows(recordings: Iterable[Evaluated], names: Sequence[str], indicators: Sequence[Indicator]) -> list[TableRow]:
    """A row for each recording and indicator that has a value."""
    rows = []
    for recording in recordings:
        outcomes = _by_name(recording, names)
        for indicator in indicators:
            values = [indicator.value(outcome) if outcome else None for outcome in outcomes]
            if any(value is not None for value in values):
                rows.append(_row(recording.name, indicator.label, values, indicator.form, ranked=indicator.ranked))
    return rows


def _row(group: str, label: str, values: Sequence[Number], form: str, *, ranked: bool = True) -> TableRow:
    """Formatted values. The smallest is the best, unless all are equal."""
    cells = tuple("–" if value is None else format(value, form) for value in values)
    numbers = [value for value in values if value is not None]
    smallest = format(min(numbers), form) if ranked and numbers else ""
    best = tuple(index for index, cell in enumerate(cells) if cell == smallest)
    return TableRow(group, label, cells, best if len(best) < len(numbers) else ())


def _spreads(group: str, label: str, spreads: Sequence[dict[str, float] | None], form: str) -> TableRow:
    """RMSE, mean and maximum in one cell; ranked by the RMSE."""
    ranked = _row(group, label, [spread["rmse"] if spread else None for spread in spreads], form)
    cells = (
        " / ".join(format(spread[kind], form) for kind in ("rmse", "mean", "max")) if spread else "–"
        for spread in spreads
    )
    return replace(ranked, cells=tuple(cells))


def _rmse(accuracy: Accuracy | None, over: str) -> Number:
    """RMSE of the relative position error, m."""
    error = accuracy.rpe[over] if accuracy else None
    return float(error["m"]["rmse"]) if error else None


def _at(tree: Any, *path: str) -> Any:
    for name in path:
        tree = tree[name] if tree else None
    return tree
