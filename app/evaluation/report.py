"""Write the results: report.html, report.md, results.json, and the tables as CSV and LaTeX."""

import json
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from app import __version__
from app.evaluation.figures import CROP_NOTE, colours, pictures, render
from app.evaluation.findings import MOST_TOLD, findings
from app.evaluation.job import GROUND_RANGES_M, code_digest
from app.evaluation.measured import Evaluated
from app.evaluation.tables import make_tables
from app.slam.params import leaves
from app.slam.provenance import describe_machine
from app.slam.report import finite
from app.slam.text_files import csv_text, write_texts

_Who = tuple[str, str]
"""Names of a recording and a variant."""


def write_report(folder: Path, recordings: Sequence[Evaluated]) -> list[str]:
    """Write all files, each whole or not at all, and return the findings.

    Raises:
        HemislamError: the folder cannot be written to.
    """
    machine, found = describe_machine(), findings(recordings)
    results = _results(recordings, machine, found)
    outcomes = [outcome for recording in recordings for outcome in recording.outcomes]
    colour = colours(recordings)
    shown = {
        "made_by": f"hemislam {__version__} on {machine['processor']}, {machine['cores']} cores, {machine['system']};"
        f" {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "findings": found[:MOST_TOLD],
        "further": found[MOST_TOLD:],
        "tables": make_tables(recordings),
        "recordings": recordings,
        "variants": {o.name: o.missing or o.meaning or "as given" for o in outcomes},
        "pictures": {recording.name: pictures(recording, colour) for recording in recordings},
        "crop_note": CROP_NOTE,
        "machines": _by_text(recordings, _machine),
        "parameters": _parameters(recordings),
    }
    texts = {
        "report.html": render("report.html", **shown),
        "report.md": render("report.md", **shown),
        "tables.tex": render("tables.tex", **shown),
        "results.json": json.dumps(results, indent=2, ensure_ascii=False) + "\n",
        **{f"{name}.csv": _csv(rows) for name, rows in _flat(results).items()},
    }
    write_texts(folder, texts)
    return found


def _results(recordings: Sequence[Evaluated], machine: dict[str, Any], found: list[str]) -> dict[str, Any]:
    results = {
        "hemislam": __version__,
        "code": code_digest(),
        "machine": machine,
        "findings": found,
        "recordings": [
            {
                "name": recording.name,
                "path": str(recording.recording),
                "sha256": recording.sha256,
                "truth": recording.truth or None,
                "notes": list(recording.notes),
                "variants": [outcome.results for outcome in recording.outcomes],
            }
            for recording in recordings
        ],
    }
    valid: dict[str, Any] = finite(results)
    return valid


def _flat(results: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Rows of each CSV table: one per variant and recording, and for ground one per range."""
    tables: dict[str, list[dict[str, Any]]] = {"accuracy": [], "runtime": [], "map_sharpness": [], "ground": []}
    for recording in results["recordings"]:
        for variant in recording["variants"]:
            who = {"recording": recording["name"], "variant": variant["variant"]}
            for name, entry in (
                ("accuracy", variant["accuracy"]),
                ("runtime", variant["runtime_ms"]),
                ("map_sharpness", variant["map_sharpness"]),
            ):
                if entry is not None:
                    tables[name].append(who | dict(_leaves(entry)))
            for index, scores in enumerate(variant["ground"] or []):
                low, high = GROUND_RANGES_M[index : index + 2]
                tables["ground"].append(who | {"from_m": low, "to_m": high} | scores)
    return tables


def _csv(rows: list[dict[str, Any]]) -> str:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return csv_text(names, *([row.get(name, "") for name in names] for row in rows))


def _leaves(entry: Any, path: str = "") -> Iterable[tuple[str, Any]]:
    """Numbers of a tree with their dotted names."""
    if isinstance(entry, dict):
        for name, value in entry.items():
            yield from _leaves(value, f"{path}.{name}" if path else str(name))
    else:
        yield path, entry


def _parameters(recordings: Sequence[Evaluated]) -> list[tuple[str, str]]:
    """Every parameter of this engine's runs by dotted name; if runs differ, each value with the names of its runs."""
    found = []
    for leaf in leaves():

        def value(run: dict[str, Any], section: str = leaf.section, name: str = leaf.name) -> str:
            found = run["parameters"][section][name]
            return " ".join(map(str, found)) if isinstance(found, list) else str(found)

        text = "; ".join(_by_text(recordings, value, of_engine=True))
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
) -> list[str]:
    """The texts that `of` returns for the runs, each once; if they differ, with the names of its runs."""
    groups: dict[str, list[_Who]] = {}
    for recording in recordings:
        for outcome in recording.outcomes:
            if outcome.run and (outcome.staged or not of_engine):
                groups.setdefault(of(outcome.run), []).append((recording.name, outcome.name))
    every = [who for group in groups.values() for who in group]
    return [f"{text} ({_names(group, every)})" if len(groups) > 1 else text for text, group in groups.items()]


def _names(chosen: Sequence[_Who], every: Sequence[_Who]) -> str:
    """Names of runs by variant or by recording alone, if that is unambiguous."""
    for part in (1, 0):
        names = dict.fromkeys(who[part] for who in chosen)
        if sum(who[part] in names for who in every) == len(chosen):
            return ", ".join(names)
    return ", ".join(f"{recording} {variant}" for recording, variant in chosen)
