"""What the tables say, in sentences: where they bear the paper out, where they go against it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from app.evaluation.measured import START_S, Column, Evaluated

LIKE = 0.02
"""Closer than this share of one another, two values are the same."""
MOST_NAMED = 4
"""Recordings that go the other way; of more, the number is told and the tables show which."""
CHANCE = 2.0
"""A mean difference of fewer standard errors than this, over the recordings, may be chance."""

_CLAIMS = (
    ("FAST-LIO-GD", "FAST-LIO", "thinning the ground"),
    ("FAST-LIO-L", "FAST-LIO", "closing loops"),
    ("Ours", "FAST-LIO", "both together"),
)


def findings(recordings: Sequence[Evaluated]) -> list[str]:
    """One sentence each; the claims of the paper first, then what is missing or went wrong."""
    said = []
    for name, base, what in _CLAIMS:
        for metric in _METRICS:
            chosen = [recording for recording in recordings if recording.name.startswith(metric.where)]
            sentence = _claim(chosen, name, base, what, metric)
            said += [sentence] if sentence else []
    missing: dict[str, list[str]] = {}
    for recording in recordings:
        for column in recording.columns:
            if column.missing:
                missing.setdefault(f"{column.name}: {column.missing}", []).append(recording.name)
            elif column.unmeasured:
                said.append(f"{recording.name}, {column.name}: the error can not be told. {column.unmeasured}")
            elif column.accuracy and column.accuracy.doubt:
                said.append(f"{recording.name}, {column.name}: no rotation error. {column.accuracy.doubt}")
            run = column.run or {}
            if run.get("lost"):
                said.append(f"{recording.name}, {column.name}: lost in {run['lost']} of {run['frames']} frames.")
            if run.get("dropped"):
                said.append(f"{recording.name}, {column.name}: {sum(run['dropped'].values())} scans were dropped.")
    said += [
        f"{text}." if len(names) == len(recordings) else f"{', '.join(names)}: {text}."
        for text, names in missing.items()
    ]
    return said


def _ate(column: Column) -> float | None:
    return column.accuracy.ate_m["rmse"] if column.accuracy else None


def _later(column: Column) -> float | None:
    return column.accuracy.later_m if column.accuracy else None


def _time(column: Column) -> float | None:
    """CPU time, which other programs on the machine disturb least."""
    return float(column.runtime["cpu"]["mean"]) if column.runtime else None


@dataclass(frozen=True, slots=True)
class _Metric:
    """Attributes:
    where: recordings whose name begins so; the paper says something about these.
    promised: whether the paper found that it falls.
    """

    name: str
    value: Callable[[Column], float | None]
    unit: str
    digits: str
    where: str = ""
    promised: bool = True


_METRICS = (
    _Metric("error (ATE)", _ate, "m", ".3g"),
    _Metric("error (ATE) outdoors", _ate, "m", ".3g", where="outdoor"),
    _Metric(f"error (ATE) without the first {START_S:g} s", _later, "m", ".3g"),
    _Metric("CPU time a frame", _time, "ms", ".2f", promised=False),
    # Table 3: outdoors, where much is ground, thinning it should make up for most of what it costs
    _Metric("CPU time a frame outdoors", _time, "ms", ".2f", where="outdoor", promised=False),
)


def _claim(recordings: Sequence[Evaluated], name: str, base: str, what: str, metric: _Metric) -> str:
    """`name` against `base`, over all recordings that have both; "" if none has."""
    pairs = []
    for recording in recordings:
        columns = {column.name: column for column in recording.columns}
        if name in columns and base in columns:
            ours, theirs = metric.value(columns[name]), metric.value(columns[base])
            if ours is not None and theirs is not None:
                pairs.append((recording.name, ours, theirs))
    if not pairs:
        return ""
    ours, theirs = (float(np.mean([pair[k] for pair in pairs])) for k in (1, 2))
    verdict, against = _compare(ours, theirs)
    sentence = f"{name} against {base} ({what}): the mean {metric.name} {verdict},"
    sentence += f" {theirs:{metric.digits}} to {ours:{metric.digits}} {metric.unit}"
    worse = [pair[0] for pair in pairs if _compare(pair[1], pair[2])[1]]
    if len(pairs) > 1:
        sentence += f" over {len(pairs)} recordings{_certainty(pairs)}"
        where = ", ".join(worse) if len(worse) <= MOST_NAMED else f"{len(worse)} of them"
        where = "all" if len(worse) == len(pairs) else where
        sentence += f"; it rises on {where}" if worse else ""
    return sentence + ("; this goes against what the paper found." if against and metric.promised else ".")


def _certainty(pairs: Sequence[tuple[str, float, float]]) -> str:
    """How well the recordings tell the mean difference, in words."""
    if len(pairs) < 3:
        return ""
    differences = np.array([ours - theirs for _, ours, theirs in pairs])
    error = float(differences.std(ddof=1) / np.sqrt(len(pairs)))
    base, mean = float(np.mean([theirs for _, _, theirs in pairs])), abs(float(differences.mean()))
    chance = ": may be chance" if LIKE * base < mean < CHANCE * error else ""
    return f" (± {100 * error / base:.1f} %, one standard error{chance})"


def _compare(ours: float, theirs: float) -> tuple[str, bool]:
    """In words, and whether it got worse."""
    if abs(ours - theirs) <= LIKE * max(abs(theirs), 1e-9):
        return "stays the same", False
    change = 100 * abs(ours - theirs) / theirs
    return (f"falls by {change:.0f} %", False) if ours < theirs else (f"rises by {change:.0f} %", True)
