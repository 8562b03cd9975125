"""The sentences of the report agree with the figures, in whichever direction these change."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.evaluation.findings import findings
from app.evaluation.measured import Accuracy, Evaluated, Outcome
from app.slam.types import TIMINGS


def column(name: str, ate_m: float, cpu_ms: float) -> Outcome:
    none, error = np.zeros(0), {"rmse": ate_m, "mean": ate_m, "max": ate_m}
    accuracy = Accuracy({"ate_m": error, "ate_after_start_m": ate_m}, none, none, none, np.zeros((0, 3)))
    run = {"peak_memory_mb": 100.0, "load": 0.5, "ground": None}
    times = np.full((10, len(TIMINGS)), cpu_ms)
    return Outcome(name, run=run, timings_ms=times, cpu_ms=times[:, 0], accuracy=accuracy)


def said(where: str, ours: list[float], theirs: list[float], cpu: tuple[float, float] = (3.0, 3.0)) -> list[str]:
    """What is said of Ours against FAST-LIO, by errors in millimetres, a recording each."""
    recordings = [
        Evaluated(
            f"{where}_{number}",
            Path("x"),
            "",
            (column("FAST-LIO", 1e-3 * b, cpu[1]), column("Ours", 1e-3 * a, cpu[0])),
        )
        for number, (a, b) in enumerate(zip(ours, theirs, strict=True))
    ]
    return [text for text in findings(recordings) if text.startswith("Ours ")]


def about(texts: list[str], what: str) -> str:
    (text,) = [text for text in texts if re.search(rf"the mean {re.escape(what)} (falls|rises|stays|is)", text)]
    return text


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict", "against"),
    [
        (1.0, 2.0, "falls by 50 %, 0.002 to 0.001 m", False),
        (3.0, 2.0, "rises by 50 %, 0.002 to 0.003 m", True),
        (2.01, 2.0, "stays the same", False),
        (50.0, 2.0, "is 25 times as large, 0.002 to 0.05 m", True),
    ],
)
def test_an_error_that_falls_and_one_that_rises_are_distinguished(
    ours: float, theirs: float, verdict: str, against: bool
) -> None:
    text = about(said("indoor", [ours], [theirs]), "error (ATE)")
    assert verdict in text
    assert ("goes against what the paper found" in text) is against


@pytest.mark.parametrize(("ours", "theirs", "verdict"), [(2.0, 4.0, "falls by 50 %"), (6.0, 4.0, "rises by 50 %")])
def test_time_outdoors_is_reported_either_way_and_the_paper_promised_nothing(
    ours: float, theirs: float, verdict: str
) -> None:
    text = about(said("outdoor", [1.0], [1.0], (ours, theirs)), "CPU time per frame outdoors")
    assert verdict in text and "against what the paper" not in text


def test_outdoors_is_only_reported_of_recordings_outdoors() -> None:
    assert not any("outdoors" in text for text in said("indoor", [1.0], [1.0]))


def test_recordings_that_go_the_other_way_are_named_though_the_mean_falls() -> None:
    text = about(said("outdoor", [1.0, 3.0], [3.0, 2.0]), "error (ATE)")
    assert "falls by" in text and "it rises on outdoor_1" in text and "outdoor_0" not in text
    most = about(said("outdoor", [3.0] * 5 + [1.0], [2.0] * 6), "error (ATE)")
    assert "it rises on 5 of them" in most
    assert "it rises on all" in about(said("outdoor", [3.0, 3.0], [2.0, 2.0]), "error (ATE)")


def test_a_difference_that_recordings_do_not_share_may_be_chance() -> None:
    """By hand: differences of +2, -1, +2 have the mean 1 and the standard error sqrt(3) / sqrt(3) = 1 mm."""
    text = about(said("indoor", [12.0, 9.0, 12.0], [10.0, 10.0, 10.0]), "error (ATE)")
    assert "rises by 10 %" in text and "goes against what the paper found" in text
    assert "over 3 recordings (± 10.0 %, one standard error: may be chance)" in text


def test_a_difference_that_all_recordings_share_is_not_chance() -> None:
    text = about(said("indoor", [11.0, 11.1, 10.9], [10.0, 10.0, 10.0]), "error (ATE)")
    assert "(± 0.6 %, one standard error)" in text


def test_an_error_of_zero_is_no_base_for_per_cent() -> None:
    assert "rises from zero, 0 to 0.001 m" in about(said("indoor", [1.0], [0.0]), "error (ATE)")
    assert "stays the same, 0 to 0 m" in about(said("indoor", [0.0], [0.0]), "error (ATE)")
    shared = about(said("indoor", [1.0, 1.1, 0.9], [0.0] * 3), "error (ATE)")
    assert "rises from zero, 0 to 0.001 m over 3 recordings; it rises on all" in shared
    assert "over 3 recordings (may be chance)" in about(said("indoor", [1.0, 0.0, 0.0], [0.0] * 3), "error (ATE)")


def walks(*variants: tuple[str, float, float]) -> list[Evaluated]:
    """Three recordings with the same results: names of variants, errors (mm) and CPU times (ms)."""
    outcomes = tuple(column(name, 1e-3 * error, cpu) for name, error, cpu in variants)
    return [Evaluated(f"outdoor_{number}", Path("x"), "", outcomes) for number in range(3)]


def test_the_biggest_difference_comes_first_and_what_went_wrong_before_it() -> None:
    found = findings(walks(("FAST-LIO", 4.0, 3.0), ("FAST-LIO-GD", 3.0, 3.0), ("Ours", 1.0, 3.0)))
    assert found[0].startswith("Ours against FAST-LIO") and "falls by 75 %" in found[0]
    (first, *_) = recordings = walks(("FAST-LIO", 4.0, 3.0), ("Ours", 1.0, 3.0))
    assert first.outcomes[0].run is not None
    first.outcomes[0].run.update(lost=3, frames=400)
    assert "lost in 3 of 400 frames" in findings(recordings)[0]


def test_every_variant_of_the_user_s_is_among_the_first_five() -> None:
    paper = [("FAST-LIO", 9.0, 9.0), ("FAST-LIO-GD", 5.0, 6.0), ("FAST-LIO-L", 3.0, 4.0), ("Ours", 1.0, 3.0)]
    own = [("tight", 1.0, 2.7), ("loose", 1.01, 3.0), ("wide", 1.0, 3.01), ("odd", 1.2, 3.0)]
    first = "\n".join(findings(walks(*paper, *own))[:5])
    assert "odd against Ours (as given): the mean error (ATE) rises by 20 %" in first
    assert "tight against Ours (as given): the mean CPU time per frame falls by 10 %" in first
    assert "loose, wide: no difference from Ours beyond chance." in first
    assert "FAST-LIO" in first, "and the biggest of the others"


def test_without_the_paper_s_variants_it_is_said_what_both_of_the_user_s_are() -> None:
    one, other = column("wide", 0.002, 3.0), column("bare", 0.001, 3.0)
    outcomes = replace(one, meaning="ground.sigma = 0.2"), replace(other, meaning="loops.enabled = False")
    (text,) = findings([Evaluated("walk", Path("x"), "", outcomes)])
    assert text.startswith("bare against wide (loops.enabled = False instead of ground.sigma = 0.2): the mean error")
