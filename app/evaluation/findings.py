"""What the tables say, in sentences: where they bear the paper out, where they go against it."""

from collections.abc import Callable, Sequence

import numpy as np

from app.evaluation.measured import Column, Evaluated

LIKE = 0.02
"""Closer than this share of one another, two values are the same."""

_CLAIMS = (
    ("FAST-LIO-GD", "FAST-LIO", "thinning the ground"),
    ("FAST-LIO-L", "FAST-LIO", "closing loops"),
    ("Ours", "FAST-LIO", "both together"),
)


def findings(recordings: Sequence[Evaluated]) -> list[str]:
    """One sentence each; the claims of the paper first, then what is missing or went wrong."""
    said = []
    for name, base, what in _CLAIMS:
        for metric, value, unit, digits in _METRICS:
            sentence = _claim(recordings, name, base, what, metric, value, unit, digits)
            said += [sentence] if sentence else []
    missing: dict[str, list[str]] = {}
    for recording in recordings:
        for column in recording.columns:
            if column.missing:
                missing.setdefault(f"{column.name}: {column.missing}", []).append(recording.name)
            elif column.unmeasured:
                said.append(f"{recording.name}, {column.name}: the error can not be told. {column.unmeasured}")
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


def _time(column: Column) -> float | None:
    """CPU time, which other programs on the machine disturb least."""
    return float(column.runtime["cpu"]["mean"]) if column.runtime else None


_METRICS: tuple[tuple[str, Callable[[Column], float | None], str, str], ...] = (
    ("error (ATE)", _ate, "m", ".4f"),
    ("CPU time a frame", _time, "ms", ".2f"),
)


def _claim(
    recordings: Sequence[Evaluated],
    name: str,
    base: str,
    what: str,
    metric: str,
    value: Callable[[Column], float | None],
    unit: str,
    digits: str,
) -> str:
    """`name` against `base`, over all recordings that have both; "" if none has."""
    pairs = []
    for recording in recordings:
        columns = {column.name: column for column in recording.columns}
        if name in columns and base in columns:
            ours, theirs = value(columns[name]), value(columns[base])
            if ours is not None and theirs is not None:
                pairs.append((recording.name, ours, theirs))
    if not pairs:
        return ""
    ours, theirs = (float(np.mean([pair[k] for pair in pairs])) for k in (1, 2))
    verdict, against = _compare(ours, theirs)
    sentence = (
        f"{name} against {base} ({what}): the mean {metric} {verdict}, {theirs:{digits}} to {ours:{digits}} {unit}"
    )
    worse = [pair[0] for pair in pairs if _compare(pair[1], pair[2])[1]]
    if len(pairs) > 1:
        sentence += f" over {len(pairs)} recordings" + (f"; it rises on {', '.join(worse)}" if worse else "")
    return sentence + ("; this goes against what the paper found." if against else ".")


def _compare(ours: float, theirs: float) -> tuple[str, bool]:
    """In words, and whether it got worse."""
    if abs(ours - theirs) <= LIKE * max(abs(theirs), 1e-9):
        return "stays the same", False
    change = 100 * abs(ours - theirs) / theirs
    return (f"falls by {change:.0f} %", False) if ours < theirs else (f"rises by {change:.0f} %", True)
