"""The tables of the report as plain rows; HTML and Markdown only dress them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from app.evaluation import paper
from app.evaluation.job import GROUND_RANGES_M
from app.evaluation.measured import START_S, Accuracy, Column, Evaluated
from app.slam.metrics import RPE_OVER, GroundScore
from app.slam.types import TIMINGS


@dataclass(frozen=True, slots=True)
class Row:
    """Attributes:
    group: the recording. label: of the row. cells: texts by column. best: index of the best cells.
    """

    group: str
    label: str
    cells: tuple[str, ...]
    best: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Table:
    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    folded: bool = False
    """Opened by those who want it, where a page can be folded."""


def make_tables(recordings: Sequence[Evaluated]) -> list[Table]:
    """All that have anything to say."""
    made = [accuracy(recordings), all_errors(recordings), runtime(recordings), stages(recordings)]
    made += [fineness(recordings), ground(recordings), beside_paper(recordings)]
    return [table for table in made if table is not None]


def accuracy(recordings: Sequence[Evaluated]) -> Table | None:
    """As the paper's Table 2."""
    indicators: list[tuple[str, Callable[[Accuracy], float | None], str]] = [
        ("ATE, RMSE (m)", lambda a: a.ate_m["rmse"], ".4f"),
        ("ATE, mean (m)", lambda a: a.ate_m["mean"], ".4f"),
        ("ATE, max (m)", lambda a: a.ate_m["max"], ".4f"),
        (f"ATE, RMSE after {START_S:g} s (m)", lambda a: a.later_m, ".4f"),
        ("ATE, rotation RMSE (°)", lambda a: a.ate_deg["rmse"] if a.ate_deg else None, ".3f"),
        ("ATE ratio error", lambda a: a.ate_m["rmse"] / a.distance_m, ".2e"),
    ]
    indicators += [(f"RPE over {over} (m)", partial(_rpe, over=over), ".4f") for over in RPE_OVER]
    indicators.append(("RPE ratio error", lambda a: _ratio(_rpe(a, RPE_OVER[0]), a.distance_m), ".2e"))
    indicators.append(("RPE over 10 m, rotation (°)", lambda a: _rpe(a, "10 m", "deg"), ".3f"))
    names = _names(recordings)
    rows = []
    for recording in recordings:
        columns = _by_name(recording, names)
        if not any(column and column.accuracy for column in columns):
            continue
        for label, value, form in indicators:
            values = [value(column.accuracy) if column and column.accuracy else None for column in columns]
            if any(number is not None for number in values):
                rows.append(_row(recording.name, label, values, form))
    if not rows:
        return None
    return Table(
        "Trajectory accuracy",
        names,
        tuple(rows),
        "As the paper's Table 2. ATE after one SE(3) alignment of positions (Umeyama, no scale), RPE of the motion"
        " between poses so far apart, both against the truth interpolated at our stamps; ratios are to the true path's"
        f' length. RMSE where not said otherwise; "after {START_S:g} s" is aligned anew without the start, where a slip'
        " of a centimetre moves all that follows. The smallest of a row is bold.",
    )


def all_errors(recordings: Sequence[Evaluated]) -> Table | None:
    """Every error of position and of rotation, and each as a ratio to the path length."""
    names = _names(recordings)
    rows = []
    for recording in recordings:
        errors = [column.accuracy if column else None for column in _by_name(recording, names)]
        found = [a.errors() if a else {} for a in errors]  # without any there is no row
        for of in dict.fromkeys(key for entry in found for key in entry):
            unit, form = ("m", ".4f") if of[1] == "m" else ("°", ".3f")
            what = f"{of[0]}, {'position' if unit == 'm' else 'rotation'}"
            spreads = [entry.get(of) for entry in found]
            ratios = [
                {kind: value / a.distance_m for kind, value in spread.items()} if a and spread else None
                for a, spread in zip(errors, spreads, strict=True)
            ]
            per_length = f"{what} / path length" + (" (°/m)" if unit == "°" else "")
            rows.append(_spreads(recording.name, f"{what} ({unit})", spreads, form))
            if any(ratios):
                rows.append(_spreads(recording.name, per_length, ratios, ".2e"))
        if _any(lengths := [a.distance_m if a else None for a in errors]):
            rows.append(_row(recording.name, "true path length (m)", lengths, ".2f", ranked=False))
            poses = [float(a.poses) if a else None for a in errors]
            rows.append(_row(recording.name, "poses compared", poses, ".0f", ranked=False))
    if not rows:
        return None
    return Table(
        "All errors, RMSE / mean / max",
        names,
        tuple(rows),
        "As the table before. A ratio is the error divided by the true path length of the whole walk; that of position"
        " has no unit. A dash: the path is too short for a pair so far apart, the truth has no orientations, or"
        " positions along one line do not fix the rotation. The smallest RMSE of a row is bold.",
        folded=True,
    )


def runtime(recordings: Sequence[Evaluated]) -> Table | None:
    """As the paper's Table 3."""
    indicators: list[tuple[str, Callable[[dict[str, Any]], float], str, bool]] = [
        ("median (ms)", lambda r: r["total"]["median"], ".2f", True),
        ("95 % (ms)", lambda r: r["total"]["p95"], ".2f", True),
        ("max (ms)", lambda r: r["total"]["max"], ".2f", False),
        ("mean (ms)", lambda r: r["total"]["mean"], ".2f", True),
        ("CPU time a frame, mean (ms)", lambda r: r["cpu"]["mean"], ".2f", True),
        ("under 50 ms (%)", lambda r: 100 * r["under_50_ms"], ".1f", False),
        ("under 100 ms (%)", lambda r: 100 * r["under_100_ms"], ".1f", False),
        ("peak memory (MB)", lambda r: r["peak_memory_mb"], ".0f", False),
    ]
    names = _names(recordings, run=True)
    rows, threads, load = [], set(), 0.0
    for recording in recordings:
        times = [column.runtime if column else None for column in _by_name(recording, names)]
        threads |= {time["threads"] for time in times if time}
        load = max([load, *(time["load"] for time in times if time)])
        for label, value, form, ranked in indicators:
            values = [value(time) if time else None for time in times]
            if any(number is not None for number in values):
                rows.append(_row(recording.name, label, values, form, ranked=ranked))
    if not rows:
        return None
    return Table(
        "Run time per frame",
        names,
        tuple(rows),
        f"As the paper's Table 3. All stages of a frame, reading the file not counted, on {_list(threads)} thread(s) a"
        " variant; variants that ran side by side share the machine's memory and caches, so --jobs 1 gives the quietest"
        f" times. The machine's load was up to {load:.1f}: where that is more than its cores, other work made frames"
        " wait, and CPU time tells more. CPU time is measured over whole frames, not by stage.",
    )


def stages(recordings: Sequence[Evaluated]) -> Table | None:
    rows = []
    for recording in recordings:
        for column in recording.columns:
            time = column.runtime
            if time:
                cells = tuple(
                    " / ".join(f"{time[stage][what]:.2f}" for what in ("median", "p95", "max")) for stage in TIMINGS
                )
                rows.append(Row(recording.name, column.name, cells))
    note = "Wall time of each stage of a frame; CPU time is measured over whole frames only: see the table before."
    return Table("Stages, median / 95 % / max (ms)", TIMINGS, tuple(rows), note) if rows else None


def fineness(recordings: Sequence[Evaluated]) -> Table | None:
    indicators: list[tuple[str, str, float, str]] = [
        ("mean map entropy (nats)", "entropy", 1.0, ".3f"),
        ("plane thickness (mm)", "thickness", 1e3, ".1f"),
        ("revisit gap, median (mm)", "revisit_median", 1e3, ".1f"),
        ("revisit gap, 95 % (mm)", "revisit_p95", 1e3, ".1f"),
    ]
    names = _names(recordings, run=True)
    rows = []
    for recording in recordings:
        runs = [column.run if column else None for column in _by_name(recording, names)]
        for label, name, scale, form in indicators:
            values = [run["fineness"][name] if run else None for run in runs]
            if any(number is not None for number in values):
                scaled = [None if number is None else number * scale for number in values]
                rows.append(_row(recording.name, label, scaled, form))
    if not rows:
        return None
    return Table(
        "Fineness of the map",
        names,
        tuple(rows),
        "The paper's Figure 7 in numbers, without truth: entropy of the points in balls of 0.3 m, spread of points"
        " across the planes they form, and the distance along the normal between two passes over the same surface (at"
        " least 20 s and 20 m of way apart; gaps over 1 m are not recognised). Lower is finer.",
    )


def ground(recordings: Sequence[Evaluated]) -> Table | None:
    ranges = list(pairwise(GROUND_RANGES_M))
    columns = ("all", *(f"{low:g}–{high:g} m" for low, high in ranges))
    rows = []
    for recording in recordings:
        for column in recording.columns:
            if (scores := column.ground) is None:
                continue
            all_ranges = [sum(scores, GroundScore()), *scores]
            for label in ("precision", "recall", "f1"):
                values = [getattr(score, label) for score in all_ranges]
                cells = tuple("–" if np.isnan(value) else f"{value:.3f}" for value in values)
                rows.append(Row(recording.name, f"{column.name}, {label.replace('f1', 'F1')}", cells))
    note = "Against the labels that the recording's own points carry, by distance from the sensor."
    return Table("Ground segmentation", columns, tuple(rows), note) if rows else None


def beside_paper(recordings: Sequence[Evaluated]) -> Table | None:
    """Ours and the paper's own, for the simulated twins of its sequences."""
    rows = []
    systems = ("FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours")
    for recording in recordings:
        sequence = paper.SEQUENCES.get(recording.name.partition("-")[0])
        if sequence is None:
            continue
        columns = {column.name: column for column in recording.columns}
        found = [columns.get(name) for name in systems]
        errors = [c.accuracy if c else None for c in found]
        times = [c.runtime if c else None for c in found]
        lines: list[tuple[str, list[float | None], str]] = [
            ("ATE (m), here", [e.ate_m["rmse"] if e else None for e in errors], ".4f"),
            ("ATE (m), paper", [sequence.ate_m.get(name) for name in systems], ".2f"),
            ("RPE (m), here, per frame", [_rpe(e, RPE_OVER[0]) if e else None for e in errors], ".4f"),
            ("RPE (m), paper", [sequence.rpe_m.get(name) for name in systems], ".2f"),
            ("ms a frame, here", [t["total"]["median"] if t else None for t in times], ".1f"),
            ("ms a frame, paper", [sequence.runtime_ms.get(name) for name in systems], ".1f"),
        ]
        rows += [_row(recording.name, label, values, form) for label, values, form in lines if _any(values)]
    return Table("Beside the paper", systems, tuple(rows), paper.NOT_COMPARABLE) if rows else None


def _names(recordings: Iterable[Evaluated], *, run: bool = False) -> tuple[str, ...]:
    """Columns of all recordings in order of appearance; with `run` only those of this engine."""
    columns = [column for recording in recordings for column in recording.columns]
    return tuple(dict.fromkeys(c.name for c in columns if not run or c.run is not None or c.missing))


def _by_name(recording: Evaluated, names: Sequence[str]) -> list[Column | None]:
    columns = {column.name: column for column in recording.columns}
    return [columns.get(name) for name in names]


def _row(group: str, label: str, values: Sequence[float | None], form: str, *, ranked: bool = True) -> Row:
    """Formatted; the smallest is best if there are others to compare it with."""
    numbers = [value for value in values if value is not None]
    best: tuple[int, ...] = ()
    cells = tuple("–" if value is None else format(value, form) for value in values)
    if ranked and len(numbers) > 1:
        smallest = format(min(numbers), form)
        best = tuple(index for index, cell in enumerate(cells) if cell == smallest)
        best = () if len(best) == len(numbers) else best
    return Row(group, label, cells, best)


def _spreads(group: str, label: str, spreads: Sequence[dict[str, float] | None], form: str) -> Row:
    """RMSE, mean and maximum in one cell; ranked by the first."""
    ranked = _row(group, label, [spread["rmse"] if spread else None for spread in spreads], form)
    cells = tuple(
        " / ".join(format(spread[kind], form) for kind in ("rmse", "mean", "max")) if spread else "–"
        for spread in spreads
    )
    return replace(ranked, cells=cells)


def _rpe(a: Accuracy, over: str, unit: str = "m") -> float | None:
    error = a.rpe[over]
    return float(error[unit]["rmse"]) if error and error[unit] else None


def _ratio(value: float | None, length: float) -> float | None:
    return None if value is None else value / length


def _any(values: Sequence[float | None]) -> bool:
    return any(value is not None for value in values)


def _list(numbers: Iterable[int]) -> str:
    return " or ".join(str(number) for number in sorted(numbers))
