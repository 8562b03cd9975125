"""The report shows every measured figure with its unit, in all formats.

Tests app/evaluation/crops.py, app/evaluation/figures.py, app/evaluation/measured.py,
app/evaluation/tables.py.
"""

import csv
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.evaluation.figures import Line, bodies, box, chart, violin
from app.evaluation.measured import Accuracy, Evaluated, Outcome, ratios
from app.evaluation.report import write_report
from app.evaluation.tables import Indicator, _row
from app.slam.params import Params, leaves
from app.slam.trajectory import Trajectory
from app.slam.types import TIMINGS

LENGTH_M = 200.0


def spread(rmse: float) -> dict[str, float]:
    return {"rmse": rmse, "mean": 0.8 * rmse, "max": 3 * rmse}


def column(name: str, size: float, *, bent: bool = True) -> Outcome:
    """Errors of position and of rotation, all different; the walk is too short for pairs 50 m apart."""
    rpe: dict[str, dict[str, Any] | None] = {
        over: {"pairs": 9, "m": spread(size * k), "deg": spread(10 * size * k)}
        for k, over in ((0.1, "1 frame"), (0.2, "1 m"), (0.5, "10 m"))
    }
    errors = {
        "ate_m": spread(size),
        "ate_deg": spread(20 * size) if bent else None,
        "ate_deg_withheld": None if bent else "It lies on one straight line.",
        "rpe": rpe | {"50 m": None},
        "poses": 100,
        "distance_m": LENGTH_M,
        "ate_after_start_m": size,
    }
    accuracy = Accuracy(
        errors | ratios(errors),
        times_s=np.arange(2.0),
        errors_m=np.ones(2),
        walked_m=np.arange(2.0),
        aligned=np.zeros((2, 3)),
        drift={5.0: np.array([0.5, 1.0, 2.0])},
    )
    run = {
        "peak_memory_mb": 100.0, "load": 0.5, "ground": None,
        "parameters": Params().with_values({"scan.voxel_size": size}).model_dump(mode="json"), "hemislam": "1.0",
        "code": "c0de", "machine": dict.fromkeys(("processor", "cores", "system", "python", "numpy", "numba"), "m"),
        "map_sharpness": dict.fromkeys(("entropy", "thickness", "revisit_median", "revisit_p95")),
    }  # fmt: skip
    there = Trajectory(np.arange(2), np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    times = np.ones((2, len(TIMINGS)))
    return Outcome(name, run=run, trajectory=there, timings_ms=times, cpu_ms=np.ones(2), accuracy=accuracy)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("report")
    columns = (column("FAST-LIO", 0.2), column("Ours", 0.1), column("Theirs", 0.4, bent=False))
    write_report(made, [Evaluated("walk", Path("walk.mcap"), "0" * 64, columns)])
    return made


def rows(page: str, title: str) -> dict[str, list[str]]:
    """Cells by label, of the table under a heading of report.md."""
    text = page.split(f"## {title}")[1].split("## ")[0]
    table = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| walk")
    ]
    return {cells[1]: cells[2:] for cells in table}


def test_every_error_stands_in_the_report_with_its_unit_and_as_a_ratio_to_the_path(folder: Path) -> None:
    shown = rows((folder / "report.md").read_text(), "All errors, RMSE / mean / max")
    assert shown["ATE, position (m)"][:2] == ["0.2000 / 0.1600 / 0.6000", "**0.1000 / 0.0800 / 0.3000**"]
    assert shown["ATE, rotation (°)"][:2] == ["4.000 / 3.200 / 12.000", "**2.000 / 1.600 / 6.000**"]
    assert shown["ATE, position / path length"][1] == "**5.00e-04 / 4.00e-04 / 1.50e-03**"
    assert shown["ATE, rotation / path length (°/m)"][1] == "**1.00e-02 / 8.00e-03 / 3.00e-02**"
    for over, metres, degrees, per_metre in (
        ("1 frame", "0.0100 / 0.0080 / 0.0300", "0.100 / 0.080 / 0.300", "5.00e-04 / 4.00e-04 / 1.50e-03"),
        ("1 m", "0.0200 / 0.0160 / 0.0600", "0.200 / 0.160 / 0.600", "1.00e-03 / 8.00e-04 / 3.00e-03"),
        ("10 m", "0.0500 / 0.0400 / 0.1500", "0.500 / 0.400 / 1.500", "2.50e-03 / 2.00e-03 / 7.50e-03"),
    ):
        assert shown[f"RPE over {over}, position (m)"][1] == f"**{metres}**"
        assert shown[f"RPE over {over}, rotation (°)"][1] == f"**{degrees}**"
        assert shown[f"RPE over {over}, rotation / path length (°/m)"][1] == f"**{per_metre}**"
    assert shown["RPE over 50 m, position (m)"] == ["–", "–", "–"]
    assert shown["true path length (m)"] == ["200.00"] * 3
    assert len(rows((folder / "report.md").read_text(), "Trajectory accuracy")) < len(shown)


def test_the_page_folds_the_same_table(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    (folded,) = re.findall(r"<details>.*?</details>", page, re.DOTALL)
    text = html.unescape(re.sub(r"<[^>]*>", "\n", folded))
    for label, cells in rows((folder / "report.md").read_text(), "All errors, RMSE / mean / max").items():
        assert label in text
        assert all(cell.strip("*") in text for cell in cells)


def test_a_rotation_error_that_means_nothing_is_a_dash_with_its_reason(folder: Path) -> None:
    page = (folder / "report.md").read_text()
    assert rows(page, "All errors, RMSE / mean / max")["ATE, rotation (°)"][2] == "–"
    assert "- walk: no rotation error of Theirs. It lies on one straight line." in page


def test_the_same_ratios_are_in_the_files_for_machines(folder: Path) -> None:
    found = json.loads((folder / "results.json").read_text())["recordings"][0]["variants"]
    ours, theirs = found[1]["accuracy"], found[2]["accuracy"]
    assert ours["rpe_ratio_deg_per_m"]["10 m"] == pytest.approx(0.5 / LENGTH_M)
    assert ours["ate_ratio_deg_per_m"] == pytest.approx(2.0 / LENGTH_M)
    assert (theirs["ate_ratio_deg_per_m"], theirs["ate_deg_withheld"]) == (None, "It lies on one straight line.")
    with (folder / "accuracy.csv").open(newline="") as file:
        line = list(csv.DictReader(file))[1]
    assert float(line["rpe.10 m.deg.max"]) == pytest.approx(1.5)
    assert float(line["rpe_ratio_deg_per_m.10 m"]) == pytest.approx(0.5 / LENGTH_M)


def test_the_tables_are_latex_too(folder: Path) -> None:
    text = (folder / "tables.tex").read_text()
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") >= 4
    assert r"walk & ATE, RMSE (m) & 0.2000 & \textbf{0.1000} & 0.4000 \\" in text
    assert r"under 50 ms (\%)" in text and "°" not in text
    (columns,) = {line.count("&") for line in text.splitlines() if line.startswith("walk & ATE")}
    assert columns == 4


def test_errors_stand_over_time_over_distance_and_over_pieces_of_the_path(folder: Path) -> None:
    page = html.unescape((folder / "report.html").read_text())
    for text in (
        "From the side",
        "over time",
        "over distance",
        "Drift over pieces",
        "true path (m)",
        "wrong by (% of it)",
    ):
        assert text in page
    assert "<title>Ours: 1 in the median</title>" in page


def heights(svg: str) -> list[float]:
    """y of the corners of the only polygon."""
    (points,) = re.findall(r'<polygon points="([^"]*)"', svg)
    return [float(point.split(",")[1]) for point in points.split()]


def test_a_box_reaches_from_quartile_to_quartile_and_a_violin_is_widest_where_most_values_are() -> None:
    values = np.geomspace(1.0, 100.0, 1001)
    corners = heights(bodies([("all", [box("a", "red", values)])], "", ""))
    whole = heights(bodies([("all", [violin("a", "red", values)])], "", ""))
    share = (max(corners) - min(corners)) / (max(whole) - min(whole))
    assert share == pytest.approx(0.5, abs=0.06)  # the values spread evenly over the logarithmic axis
    twice = np.r_[np.full(50, 10.0), np.geomspace(5.0, 50.0, 50)]
    body = violin("a", "red", twice)
    assert body.values[np.argmax(body.widths)] == pytest.approx(10.0, rel=0.1)
    assert bodies([("all", [violin("a", "red", np.full(5, 3.0))])], "", "").count("<polygon") == 1


def test_it_is_said_that_cpu_time_is_of_whole_frames(folder: Path) -> None:
    page = (folder / "report.md").read_text()
    assert rows(page, "Run time per frame")["CPU time per frame, mean (ms)"] == ["1.00"] * 3
    assert "CPU time is measured over whole frames" in page.split("## Run time per frame")[1].split("## ")[0]
    assert "CPU time is measured over whole frames" in page.split("## Stages")[1].split("## ")[0]


def test_only_what_differs_by_more_than_its_uncertainty_is_highlighted() -> None:
    ate, median = Indicator("ATE", "", ".4f"), Indicator("median", "", ".2f", like=0.05)
    assert _row("hall", ate, [0.0100, 0.0101, 0.0200]).best == (0, 1), "the first two are alike"
    assert _row("hall", ate, [0.0100, 0.0101, None]).best == (), "and then there is nothing to see"
    assert _row("hall", median, [5.0, 5.2, 5.3]).best == (0, 1), "time differs from run to run"


def test_a_curve_below_another_shows_beside_it() -> None:
    line = np.arange(3.0)
    svg = chart([Line(name, "red", line, line) for name in "abc"], "x", "y")
    widths = [float(width) for width in re.findall(r'stroke-width="([\d.]+)"', svg)]
    assert widths == sorted(widths, reverse=True) and widths[0] > widths[1] + 1 > widths[2] + 2


def test_the_axes_of_a_map_in_a_grid_show_every_metre() -> None:
    east, north = 691_607 + np.arange(4.0), 5_412_341 + np.arange(4.0)
    texts = re.findall(r">([\d.e+]+)</text>", chart([Line("walk", "red", east, north)], "x (m)", "y (m)"))
    assert {"691608", "691608.5", "5412342", "5412343"} <= set(texts)


def test_every_parameter_and_the_machine_stand_in_the_report(folder: Path) -> None:
    """Where the variants differ, each value is told with whose it is."""
    page = (folder / "report.md").read_text()
    for leaf in leaves():
        assert f"- `{leaf.path}` " in page
    assert "- `scan.voxel_size` 0.2 (FAST-LIO); 0.1 (Ours); 0.4 (Theirs) m" in page
    assert "- `ground.alpha` 25.0 deg" in page
    assert "hemislam 1.0, code c0de, on m, m cores" in page
    assert "scan.voxel_size" in (folder / "report.html").read_text()
