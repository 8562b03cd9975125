"""The tables of the report as plain rows. A table is a list of indicators: a label, a value, and its format."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from app.evaluation import paper
from app.evaluation.findings import LIKE, LIKE_IN_TIME
from app.evaluation.job import GROUND_RANGES_M
from app.evaluation.measured import START_S, Evaluated
from app.slam.metrics import RPE_OVER, GroundScore
from app.slam.types import TIMINGS

Number = float | None
_SPREAD = ("rmse", "mean", "max")


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
    """`folded`: initially closed, on a page that can fold tables."""

    title: str
    columns: tuple[str, ...]
    rows: list[TableRow]
    note: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Indicator:
    """One row of a table for each recording.

    Attributes:
        path: of the value, as for `Outcome.value`. scale: multiplies it. ranked: the smallest is the best.
        like: share up to which two values count as equal.
    """

    label: str
    path: str
    form: str
    ranked: bool = True
    scale: float = 1.0
    like: float = LIKE


def make_tables(recordings: Sequence[Evaluated]) -> list[Table]:
    """All tables that have rows."""
    made = [accuracy(recordings), all_errors(recordings), runtime(recordings), stages(recordings)]
    made += [map_sharpness(recordings), ground(recordings), beside_paper(recordings)]
    return [table for table in made if table.rows]


def accuracy(recordings: Sequence[Evaluated]) -> Table:
    """The indicators of the paper's Table 2."""
    indicators = [
        Indicator("ATE, RMSE (m)", "accuracy/ate_m/rmse", ".4f"),
        Indicator("ATE, mean (m)", "accuracy/ate_m/mean", ".4f"),
        Indicator("ATE, max (m)", "accuracy/ate_m/max", ".4f"),
        Indicator(f"ATE, RMSE after {START_S:g} s (m)", "accuracy/ate_after_start_m", ".4f"),
        Indicator("ATE, rotation RMSE (°)", "accuracy/ate_deg/rmse", ".3f"),
        Indicator("ATE ratio error", "accuracy/ate_ratio", ".2e"),
        *(Indicator(f"RPE over {over} (m)", f"accuracy/rpe/{over}/m/rmse", ".4f") for over in RPE_OVER),
        Indicator("RPE ratio error", f"accuracy/rpe_ratio/{RPE_OVER[0]}", ".2e"),
    ]
    names = _names(recordings)
    return Table(
        "Trajectory accuracy",
        names,
        _rows(recordings, names, indicators),
        "As the paper's Table 2. ATE: after one SE(3) alignment of positions (Umeyama, no scale). RPE: of the motion"
        " between poses at the given distance. Both against the truth interpolated at our stamps. Ratios are to the"
        f' length of the true path. Values are RMSE unless stated otherwise; "after {START_S:g} s" is aligned again'
        " without the start, where a slip of a centimetre moves all later poses. Bold: the smallest of a row, and what"
        f" differs from it by less than {100 * LIKE:g} %; nothing where all do.",
    )


def all_errors(recordings: Sequence[Evaluated]) -> Table:
    """Every error of position and of rotation, and each as a ratio to the path length."""
    names = _names(recordings)
    paths = {"ATE": "accuracy/ate_", **{f"RPE over {over}": f"accuracy/rpe/{over}/" for over in RPE_OVER}}
    units = (("m", "position", "m", ".4f", ""), ("deg", "rotation", "°", ".3f", " (°/m)"))
    rows: list[TableRow] = []
    for recording in recordings:
        lengths = recording.values(names, "accuracy/distance_m")
        if not any(lengths):
            continue
        for (of, path), (unit, what, shown, form, per_metre) in product(paths.items(), units):
            spreads = recording.values(names, path + unit)
            ratios = [
                {kind: spread[kind] / length for kind in _SPREAD} if spread and length else None
                for spread, length in zip(spreads, lengths, strict=True)
            ]
            rows.append(_spreads(recording.name, f"{of}, {what} ({shown})", spreads, form))
            if any(ratios):
                rows.append(_spreads(recording.name, f"{of}, {what} / path length{per_metre}", ratios, ".2e"))
        of_path = Indicator("true path length (m)", "accuracy/distance_m", ".2f", ranked=False)
        rows += _rows([recording], names, [of_path, Indicator("poses compared", "accuracy/poses", ".0f", ranked=False)])
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
    """The indicators of the paper's Table 3."""
    indicators = [
        Indicator("median (ms)", "runtime_ms/total/median", ".2f", like=LIKE_IN_TIME),
        Indicator("95 % (ms)", "runtime_ms/total/p95", ".2f", like=LIKE_IN_TIME),
        Indicator("max (ms)", "runtime_ms/total/max", ".2f", ranked=False),
        Indicator("mean (ms)", "runtime_ms/total/mean", ".2f", like=LIKE_IN_TIME),
        Indicator("CPU time per frame, mean (ms)", "runtime_ms/cpu/mean", ".2f", like=LIKE_IN_TIME),
        Indicator("under 50 ms (%)", "runtime_ms/under_50_ms", ".1f", ranked=False, scale=100),
        Indicator("under 100 ms (%)", "runtime_ms/under_100_ms", ".1f", ranked=False, scale=100),
        Indicator("peak memory (MB)", "runtime_ms/peak_memory_mb", ".0f", ranked=False),
    ]
    times = [time for r in recordings for outcome in r.outcomes if (time := outcome.value("runtime_ms"))]
    names = _names(recordings, run=True)
    return Table(
        "Run time per frame",
        names,
        _rows(recordings, names, indicators),
        "As the paper's Table 3. All stages of a frame, without reading the file, on one thread."
        " Variants that run side by side share memory and caches, so --jobs 1 gives the quietest times. The machine's"
        f" load was up to {max((time['load'] for time in times), default=0.0):.1f}. Where that is more than its cores,"
        " other work made frames wait, and CPU time is the better measure. CPU time is measured over whole frames, not"
        " by stage.",
    )


def stages(recordings: Sequence[Evaluated]) -> Table:
    rows = []
    for recording in recordings:
        for outcome in recording.outcomes:
            if outcome.staged and (time := outcome.value("runtime_ms")):
                cells = (
                    " / ".join(f"{time[stage][what]:.2f}" for what in ("median", "p95", "max")) for stage in TIMINGS
                )
                rows.append(TableRow(recording.name, outcome.name, tuple(cells)))
    note = "Wall time of each stage of a frame. CPU time is measured over whole frames only; see the table before."
    return Table("Stages, median / 95 % / max (ms)", TIMINGS, rows, note)


def map_sharpness(recordings: Sequence[Evaluated]) -> Table:
    indicators = [
        Indicator("mean map entropy (nats)", "map_sharpness/entropy", ".3f"),
        Indicator("plane thickness (mm)", "map_sharpness/thickness", ".1f", scale=1e3),
        Indicator("revisit gap, median (mm)", "map_sharpness/revisit_median", ".1f", scale=1e3),
        Indicator("revisit gap, 95 % (mm)", "map_sharpness/revisit_p95", ".1f", scale=1e3),
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
    """Our values beside the paper's, for the simulated twins of its sequences."""
    names = paper.SYSTEMS
    rows: list[TableRow] = []
    for recording in recordings:
        if (sequence := paper.SEQUENCES.get(recording.name.partition("-")[0])) is None:
            continue
        run = {outcome.name for outcome in recording.outcomes}
        for label, path, form, theirs, their_form in (
            ("ATE (m)", "accuracy/ate_m/rmse", ".4f", sequence.ate_m, ".2f"),
            ("ATE ratio error", "accuracy/ate_ratio", ".2e", sequence.ratios(sequence.ate_m), ".2e"),
            ("RPE (m), per frame", f"accuracy/rpe/{RPE_OVER[0]}/m/rmse", ".4f", sequence.rpe_m, ".2f"),
            ("RPE ratio error", f"accuracy/rpe_ratio/{RPE_OVER[0]}", ".2e", sequence.ratios(sequence.rpe_m), ".2e"),
            ("ms per frame", "runtime_ms/total/median", ".1f", sequence.runtime_ms, ".1f"),
        ):
            rows += _rows([recording], names, [Indicator(f"{label}, here", path, form)])
            values = [theirs.get(name) if name in run else None for name in names]
            rows += [_row(recording.name, Indicator(f"{label}, paper", "", their_form), values)] if any(values) else []
    return Table("Beside the paper", names, rows, paper.NOT_COMPARABLE)


def _names(recordings: Iterable[Evaluated], *, run: bool = False) -> tuple[str, ...]:
    """Names of all outcomes in order of appearance; with `run`, without trajectories from elsewhere."""
    outcomes = [outcome for recording in recordings for outcome in recording.outcomes]
    return tuple(dict.fromkeys(o.name for o in outcomes if not run or o.run is not None or o.missing))


def _rows(recordings: Iterable[Evaluated], names: Sequence[str], indicators: Sequence[Indicator]) -> list[TableRow]:
    """A row for each recording and indicator that has a value."""
    rows = []
    for recording, indicator in product(recordings, indicators):
        found = recording.values(names, indicator.path)
        values = [None if value is None else indicator.scale * value for value in found]
        if any(value is not None for value in values):
            rows.append(_row(recording.name, indicator, values))
    return rows


def _row(group: str, indicator: Indicator, values: Sequence[Number]) -> TableRow:
    """A row of formatted values. Values about equal to the smallest are marked best, unless all values are."""
    cells = tuple("–" if value is None else format(value, indicator.form) for value in values)
    numbers = [value for value in values if value is not None]
    most = min(numbers) + indicator.like * abs(min(numbers)) if indicator.ranked and numbers else -np.inf
    best = tuple(index for index, value in enumerate(values) if value is not None and value <= most)
    return TableRow(group, indicator.label, cells, best if len(best) < len(numbers) else ())


def _spreads(group: str, label: str, spreads: Sequence[dict[str, float] | None], form: str) -> TableRow:
    """RMSE, mean and maximum in one cell; ranked by the RMSE."""
    ranked = _row(group, Indicator(label, "", form), [spread["rmse"] if spread else None for spread in spreads])
    cells = (" / ".join(format(spread[kind], form) for kind in _SPREAD) if spread else "–" for spread in spreads)
    return replace(ranked, cells=tuple(cells))
