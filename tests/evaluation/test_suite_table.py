"""The table of the suite in the documentation, written from results.json."""

from typing import Any

import pytest

from benchmarks.suite_table import BEGIN, END, section, with_section


def results() -> dict[str, Any]:
    """One twin with two of the paper's systems, and a recording that is no twin."""

    def variant(name: str, ate: float, ms: float) -> dict[str, Any]:
        return {"variant": name, "accuracy": {"ate_m": {"rmse": ate}}, "runtime_ms": {"cpu": {"median": ms}}}

    return {
        "machine": {"processor": "a processor", "cores": 2},
        "findings": ["Ours against FAST-LIO: it rises."],
        "recordings": [
            {"name": "outdoor_4-short", "variants": [variant("FAST-LIO", 0.0123, 5.04), variant("Ours", 0.0111, 6.0)]},
            {"name": "mine", "variants": [variant("FAST-LIO", 1.0, 1.0)]},
        ],
    }


def test_each_figure_stands_beside_the_papers() -> None:
    lines = section(results()).splitlines()
    assert "| Outdoor 4 (outdoor_4-short) | ATE here, m | 0.0123 | – | – | 0.0111 |" in lines
    assert "|  | ATE in the paper, m | 2.20 | 0.85 | 2.67 | 0.87 |" in lines
    assert "|  | ms a frame here | 5.0 | – | – | 6.0 |" in lines
    assert "|  | ms a frame in the paper | 19.2 | – | – | 21.2 |" in lines
    assert not any("mine" in line for line in lines)


def test_what_is_not_comparable_and_what_goes_the_other_way_is_said() -> None:
    text = section(results())
    assert "Do not compare" in text
    assert "- Ours against FAST-LIO: it rises." in text


def test_seeds_of_one_sequence_are_averaged() -> None:
    found = results()
    first = found["recordings"][0]
    ours = first["variants"][1]
    other = {**ours, "accuracy": {"ate_m": {"rmse": 0.0333}}, "runtime_ms": {"cpu": {"median": 8.0}}}
    found["recordings"].append({"name": "outdoor_4-seed1-short", "variants": [other]})
    lines = section(found).splitlines()
    assert "| Outdoor 4 (outdoor_4, mean of 2 seeds) | ATE here, m | – | – | – | 0.0222 |" in lines
    assert "|  | ms a frame here | – | – | – | 7.0 |" in lines  # FAST-LIO lacks a seed


def test_a_variant_that_failed_leaves_a_gap() -> None:
    found = results()
    found["recordings"][0]["variants"][1] |= {"accuracy": None, "runtime_ms": None}
    assert "| ATE here, m | 0.0123 | – | – | – |" in section(found)


def test_only_what_is_between_the_marks_is_replaced() -> None:
    page = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    assert with_section(page, "new") == f"before\n{BEGIN}\nnew\n{END}\nafter\n"
    assert with_section(with_section(page, "x"), "new") == with_section(page, "new")
    with pytest.raises(SystemExit):
        with_section("no marks", "new")
