"""How runs were made: versions, machines, and every parameter, in words for the report."""

from collections.abc import Callable, Sequence
from typing import Any

from app.evaluation.measured import Evaluated
from app.slam.params import leaves

Who = tuple[str, str]
"""Names of a recording and a variant."""


def machines(recordings: Sequence[Evaluated]) -> list[str]:
    """Each machine and version that runs were made with, and which runs if there are several."""
    return [f"{text}{_of(who)}" for text, who in _by_text(recordings, _machine)]


def parameters(recordings: Sequence[Evaluated]) -> list[tuple[str, str]]:
    """Every parameter of this engine's runs by its dotted name; where they differ, each value with whose it is."""
    found = []
    for leaf in leaves():

        def value(run: dict[str, Any], section: str = leaf.section, name: str = leaf.name) -> str:
            found = run["parameters"][section][name]
            return " ".join(map(str, found)) if isinstance(found, list) else str(found)

        values = _by_text(recordings, value, of_engine=True)
        text = "; ".join(f"{value}{_of(who)}" for value, who in values)
        found.append((leaf.path, f"{text} {leaf.unit}".strip()))
    return found


def _machine(run: dict[str, Any]) -> str:
    machine = run["machine"]
    return (
        f"hemislam {run['hemislam']}, code {run['code']}, on {machine['processor']}, {machine['cores']} cores,"
        f" {machine['system']}, Python {machine['python']}, NumPy {machine['numpy']}, Numba {machine['numba']}"
    )


def _by_text(
    recordings: Sequence[Evaluated], of: Callable[[dict[str, Any]], str], *, of_engine: bool = False
) -> list[tuple[str, str]]:
    """What `of` gives for the runs, each text once, with the names of its runs; "" if all have the same."""
    outcomes = [(r.name, outcome) for r in recordings for outcome in r.outcomes if outcome.staged or not of_engine]
    runs = {(name, outcome.name): of(outcome.run) for name, outcome in outcomes if outcome.run}
    texts = dict.fromkeys(runs.values())
    if len(texts) < 2:
        return [(text, "") for text in texts]
    return [(text, _names([who for who in runs if runs[who] == text], list(runs))) for text in texts]


def _names(chosen: Sequence[Who], every: Sequence[Who]) -> str:
    """Runs by variant or by recording alone, where that says it all."""
    for part in (1, 0):
        names = dict.fromkeys(who[part] for who in chosen)
        if sum(who[part] in names for who in every) == len(chosen):
            return ", ".join(names)
    return ", ".join(f"{recording} {variant}" for recording, variant in chosen)


def _of(who: str) -> str:
    return f" ({who})" if who else ""
