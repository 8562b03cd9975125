"""Writes the results of `hemislam evaluate --suite paper` into the documentation, beside the paper's figures.

hemislam evaluate --suite paper --short --seed 0 --seed 1 --seed 2 --out runs/suite
python -m benchmarks.suite_table runs/suite
"""

import json
import sys
from pathlib import Path
from typing import Any

from app.evaluation import paper

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "measured.md"
BEGIN, END = "<!-- suite: written by benchmarks/suite_table.py -->", "<!-- /suite -->"
SYSTEMS = ("FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours")


def main() -> None:
    (folder,) = sys.argv[1:]
    results = json.loads((Path(folder) / "results.json").read_text(encoding="utf-8"))
    PAGE.write_text(with_section(PAGE.read_text(encoding="utf-8"), section(results)), encoding="utf-8")


def with_section(page: str, text: str) -> str:
    """The page with the text between the marks replaced by `text`."""
    before, mark, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (mark and end):
        raise SystemExit(f"PAGE.md has no `{BEGIN}` ... `{END}` to write between.")
    return f"{before}{BEGIN}\n{text}\n{END}{after}"


def section(results: dict[str, Any]) -> str:
    """Rows of each sequence, here and in the paper; then what may be compared, and the findings."""
    machine = results["machine"]
    lines = [
        f"| sequence | | {' | '.join(SYSTEMS)} |",
        f"| --- | --- |{' ---: |' * len(SYSTEMS)}",
    ]
    twins: dict[str, list[dict[str, Any]]] = {}
    for recording in results["recordings"]:
        twins.setdefault(recording["name"].partition("-")[0], []).append(recording)
    for scene, recordings in twins.items():
        sequence = paper.SEQUENCES.get(scene)
        if sequence is None:
            continue
        found = [{variant["variant"]: variant for variant in recording["variants"]} for recording in recordings]
        ours = [[variants.get(name) for variants in found] for name in SYSTEMS]
        rows = (
            ("ATE here, m", [_mean(seeds, "accuracy", "ate_m", "rmse") for seeds in ours], ".4f"),
            ("ATE in the paper, m", [sequence.ate_m.get(name) for name in SYSTEMS], ".2f"),
            ("ms a frame here", [_mean(seeds, "runtime_ms", "cpu", "median") for seeds in ours], ".1f"),
            ("ms a frame in the paper", [sequence.runtime_ms.get(name) for name in SYSTEMS], ".1f"),
        )
        one = len(recordings) == 1
        which = recordings[0]["name"] if one else f"{scene}, mean of {len(recordings)} seeds"
        name = f"{sequence.name} ({which})"
        for label, values, form in rows:
            if any(value is not None for value in values):
                cells = " | ".join("–" if value is None else format(value, form) for value in values)
                lines.append(f"| {name} | {label} | {cells} |")
                name = ""
    lines += ["", paper.NOT_COMPARABLE, "", "What it says of the whole method (`report.md` has its parts):", ""]
    lines += [f"- {finding}" for finding in results["findings"] if finding.startswith("Ours ")]
    return "\n".join(
        [
            *lines,
            "",
            f"Measured on {machine['processor']}, {machine['cores']} cores, one of them a variant; times are CPU time,"
            " the median over all frames.",
        ]
    )


def _mean(trees: list[Any], *path: str) -> float | None:
    """The mean over all seeds; None if a seed has no value."""
    values = [_at(tree, *path) for tree in trees]
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there and len(there) == len(values) else None


def _at(tree: Any, *path: str) -> float | None:
    for name in path:
        tree = tree.get(name) if tree else None
    return None if tree is None else float(tree)


if __name__ == "__main__":
    main()
