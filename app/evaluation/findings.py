"""Findings of a report in sentences: where the tables confirm the paper, and where they contradict it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from app.evaluation.measured import START_S, Evaluated
from app.evaluation.variants import PAPER

LIKE, LIKE_IN_TIME = 0.02, 0.05
"""Two values that differ by less than this share count as equal; run times differ by more from run to run."""
MOST_TOLD = 5
"""Number of sentences at the top of a report."""
MOST_NAMED = 4
"""At most this many differing recordings are named; of more, only the number is given."""
CHANCE = 2.0
"""A mean difference of less than this many standard errors over the recordings may be chance."""

MANY = 10
"""A difference by more than this factor is given as a factor, not in percent."""

_SAME = "stays the same"
_CLAIMS = (
    ("FAST-LIO-GD", "FAST-LIO", "downsampling the ground"),
    ("FAST-LIO-L", "FAST-LIO", "closing loops"),
    ("Ours", "FAST-LIO", "both together"),
)


@dataclass(frozen=True, slots=True)
class Claim:
    """Attributes:
    size: relative change of a value, 0 if it may be chance; inf if something went wrong.
    own: whether it is about a variant of the user.
    """

    text: str
    size: float
    own: bool = False


def findings(recordings: Sequence[Evaluated]) -> list[str]:
    """One sentence each, the largest difference first; the user's variants are among the first `MOST_TOLD`."""
    found = _own(recordings) + _mishaps(recordings)
    for (name, base, what), metric in product(_CLAIMS, _METRICS):
        if (difference := _difference(recordings, name, base, metric)) is not None:
            text = f"{name} against {base} ({what}): the mean {metric.name} {difference.words}{difference.rest}"
            surprising = difference.against and not metric.is_time
            text += "; this goes against what the paper found." if surprising else "."
            found.append(Claim(text, difference.size))
    found.sort(key=lambda claim: -claim.size)
    first = sorted(found, key=lambda claim: not claim.own)[:MOST_TOLD]
    return [claim.text for claim in sorted(found, key=lambda claim: claim not in first)]


def _own(recordings: Sequence[Evaluated]) -> list[Claim]:
    """The user's variants compared with ours; variants without a difference share one sentence."""
    outcomes = {o.name: o for recording in recordings for o in recording.outcomes if o.run is not None}
    names = [name for name in outcomes if name not in {variant.name for variant in PAPER}]
    base = "Ours" if "Ours" in outcomes else next(iter(outcomes), "")
    meanings = {name: outcome.meaning or "as given" for name, outcome in outcomes.items()}
    found, alike = [], []
    for name in names:
        if name == base:
            continue
        compared = [(metric, _difference(recordings, name, base, metric)) for metric in _OWN_METRICS]
        sure = [(metric, difference) for metric, difference in compared if difference is not None and difference.size]
        if not sure:
            alike.append(name)
            continue
        words = "; ".join(f"the mean {metric.name} {difference.words}" for metric, difference in sure)
        size = max(difference.size for _, difference in sure)
        what = meanings[name] if base == "Ours" else f"{meanings[name]} instead of {meanings[base]}"
        found.append(Claim(f"{name} against {base} ({what}): {words}.", size, own=True))
    if alike:
        found.append(Claim(f"{', '.join(alike)}: no difference from {base} beyond chance.", 0.0, own=True))
    return found


def _mishaps(recordings: Sequence[Evaluated]) -> list[Claim]:
    """Everything that is missing or went wrong."""
    found = []
    missing: dict[str, list[str]] = {}
    straight = []
    for recording in recordings:
        doubts = {one.name: doubt for one in recording.outcomes if (doubt := one.value("accuracy/ate_deg_withheld"))}
        if doubts:
            (first, *_) = doubts.values()
            straight.append(f"{recording.name}: no rotation error of {', '.join(doubts)}. {first}")
        for outcome in recording.outcomes:
            who, run = f"{recording.name}, {outcome.name}", outcome.run or {}
            if outcome.missing:
                missing.setdefault(f"{outcome.name}: {outcome.missing}", []).append(recording.name)
            elif outcome.unmeasured:
                found.append(f"{who}: the error cannot be measured. {outcome.unmeasured}")
            if run.get("lost"):
                found.append(f"{who}: lost in {run['lost']} of {run['frames']} frames.")
            if run.get("dropped"):
                found.append(f"{who}: {sum(run['dropped'].values())} scans were dropped.")
    for sentence, names in missing.items():
        text = sentence.rstrip(".")
        found.append(f"{text}." if len(names) == len(recordings) else f"{', '.join(names)}: {text}.")
    return [Claim(text, np.inf) for text in found] + [Claim(text, 0.0) for text in straight]


@dataclass(frozen=True, slots=True)
class _Metric:
    """Attributes:
    path: of its value, as for `Outcome.value`. where: prefix of the names of the recordings concerned.
    """

    name: str
    path: str
    unit: str = "m"
    where: str = ""

    @property
    def is_time(self) -> bool:
        """Times differ more from run to run, and the paper does not promise that they fall."""
        return self.unit == "ms"

    def text(self, value: float) -> str:
        return f"{value:.2f}" if self.is_time else f"{value:.3g}"


_ATE = _Metric("error (ATE)", "accuracy/ate_m/rmse")
_CPU = _Metric("CPU time per frame", "runtime_ms/cpu/mean", "ms")
"""CPU time: the time least disturbed by other programs on the machine."""
_METRICS = (
    _ATE,
    replace(_ATE, name="error (ATE) outdoors", where="outdoor"),
    _Metric(f"error (ATE) without the first {START_S:g} s", "accuracy/ate_after_start_m"),
    _CPU,
    # Table 3: outdoors, where much of a scan is ground, thinning the ground should recover most of its cost
    replace(_CPU, name="CPU time per frame outdoors", where="outdoor"),
)
_OWN_METRICS = (_ATE, _CPU, _Metric("plane thickness", "map_sharpness/thickness"))


@dataclass(frozen=True, slots=True)
class _Difference:
    """Attributes:
    words: how the mean of a metric differs. size: see `Claim`. against: whether it got worse. rest: where it rises.
    """

    words: str
    size: float
    against: bool
    rest: str


def _difference(recordings: Sequence[Evaluated], name: str, base: str, metric: _Metric) -> _Difference | None:
    """`name` compared with `base` over all recordings that have both; None if there is no such recording."""
    both = [(r.name, *r.values((name, base), metric.path)) for r in recordings if r.name.startswith(metric.where)]
    pairs = [(where, ours, theirs) for where, ours, theirs in both if ours is not None and theirs is not None]
    if not pairs:
        return None
    ours, theirs = (float(np.mean([pair[k] for pair in pairs])) for k in (1, 2))
    like = LIKE_IN_TIME if metric.is_time else LIKE
    verdict, against = _compare(ours, theirs, like)
    words = f"{verdict}, {metric.text(theirs)} to {metric.text(ours)} {metric.unit}"
    (certainty, may_be_chance), rest = _certainty(pairs), ""
    worse = [pair[0] for pair in pairs if _compare(pair[1], pair[2], like)[1]]
    if len(pairs) > 1:
        words += f" over {len(pairs)} recordings{certainty}"
        where = ", ".join(worse) if len(worse) <= MOST_NAMED else f"{len(worse)} of them"
        where = "all" if len(worse) == len(pairs) else where
        rest = f"; it rises on {where}" if worse else ""
    certain = verdict != _SAME and not may_be_chance
    return _Difference(words, abs(ours - theirs) / max(abs(theirs), 1e-9) if certain else 0.0, against, rest)


def _certainty(pairs: Sequence[tuple[str, float, float]]) -> tuple[str, bool]:
    """How certain the mean difference is, in words, and whether it may be chance."""
    if len(pairs) < 3:
        return "", False
    differences = np.array([ours - theirs for _, ours, theirs in pairs])
    error = float(differences.std(ddof=1) / np.sqrt(len(pairs)))
    base, mean = float(np.mean([theirs for _, _, theirs in pairs])), abs(float(differences.mean()))
    may_be_chance = LIKE * base < mean < CHANCE * error
    if base == 0:
        return " (may be chance)" if may_be_chance else "", may_be_chance
    return f" (± {100 * error / base:.1f} %, one standard error{': may be chance' * may_be_chance})", may_be_chance


def _compare(ours: float, theirs: float, like: float) -> tuple[str, bool]:
    """The difference in words, and whether the value got worse."""
    if abs(ours - theirs) <= like * max(abs(theirs), 1e-9):
        return _SAME, False
    if theirs == 0:
        return "rises from zero", True
    if ours > MANY * theirs:
        return f"is {ours / theirs:.0f} times as large", True
    change = 100 * abs(ours - theirs) / theirs
    return (f"falls by {change:.0f} %", False) if ours < theirs else (f"rises by {change:.0f} %", True)
