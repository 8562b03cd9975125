"""`hemislam evaluate` from the outside: its tables, resuming after a kill, and refused input.

Tests app/evaluation/job.py, app/evaluation/runner.py, app/evaluation/variants.py.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from app.__main__ import cli
from app.cli.evaluate import read_subjects
from app.evaluation.job import RUN_FILES
from app.evaluation.variants import PAPER, choose_variants, parse_variant
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.trajectory import read_tum, write_tum
from tests.cli.conftest import ROOT, write_walk

REPORT_FILES = (
    "report.html",
    "report.md",
    "results.json",
    "tables.tex",
    "accuracy.csv",
    "runtime.csv",
    "map_sharpness.csv",
    "ground.csv",
)
VARIANT = "coarse:scan.voxel_size=0.8,ground.alpha=30"


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "app", "evaluate", *map(str, arguments)]


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, ["evaluate", *map(str, arguments)])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


@pytest.fixture(scope="module")
def evaluated(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole ablation, a variant, and a trajectory from elsewhere: the truth itself."""
    folder = tmp_path_factory.mktemp("evaluation")
    theirs = folder / "theirs.tum"
    write_tum(theirs, read_tum(recording.with_name("walk_truth.tum")))
    done = call(recording, "--out", folder, "--variant", VARIANT, "--compare", f"Perfect={theirs}")
    assert done.exit_code == 0, done.output
    return folder


def results(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return found


def columns(folder: Path) -> dict[str, dict[str, Any]]:
    return {entry["variant"]: entry for entry in results(folder)["recordings"][0]["variants"]}


def test_every_variant_is_measured(evaluated: Path) -> None:
    assert all((evaluated / name).is_file() for name in REPORT_FILES)
    there = columns(evaluated)
    assert list(there) == ["FAST-LIO", "FAST-LIO-GD", "FAST-LIO-L", "Ours", "coarse", "Perfect"]
    for name in ("FAST-LIO", "FAST-LIO-GD", "coarse"):
        entry = there[name]
        assert entry["frames"] == 39
        assert 0 < entry["accuracy"]["ate_m"]["rmse"] < 0.02
        assert entry["accuracy"]["ate_ratio"] == pytest.approx(
            entry["accuracy"]["ate_m"]["rmse"] / entry["accuracy"]["distance_m"]
        )
        assert entry["runtime_ms"]["total"]["median"] <= entry["runtime_ms"]["total"]["max"]
        assert entry["map_sharpness"]["thickness"] < 0.02
    assert there["coarse"]["parameters"]["ground"]["alpha"] == 30
    assert there["FAST-LIO"]["ground"] is None  # it segments none
    assert sum(scores["true_positive"] for scores in there["FAST-LIO-GD"]["ground"]) > 1000
    assert there["Perfect"]["accuracy"]["ate_m"]["max"] < 1e-6


def test_the_variants_with_loops_have_some_to_show(evaluated: Path) -> None:
    there = columns(evaluated)
    for name in ("FAST-LIO-L", "Ours"):
        assert there[name]["accuracy"] is not None and there[name]["runtime_ms"] is not None


def test_the_page_needs_nothing_else(evaluated: Path) -> None:
    page = (evaluated / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:)[^"']*""", page)
    assert "http" not in page.replace("http-equiv", "")
    for text in ("Trajectory accuracy", "Run time per frame", "Map sharpness", "From above", "Perfect"):
        assert text in page


def test_it_is_said_which_point_the_truth_is_taken_of(evaluated: Path) -> None:
    assert results(evaluated)["recordings"][0]["truth"].endswith(
        "poses of a point taken as the IMU's own (no lever arm)."
    )


def test_of_a_part_only_that_part_of_another_trajectory_is_measured(
    recording: Path, evaluated: Path, tmp_path: Path
) -> None:
    theirs = ["--compare", f"Perfect={evaluated / 'theirs.tum'}"]
    done = call(recording, "--out", tmp_path, "--no-ablation", "--variant", VARIANT, "--duration", "3.3", *theirs)
    assert done.exit_code == 0, done.output
    ours, perfect = (columns(tmp_path)[name]["accuracy"] for name in ("coarse", "Perfect"))
    whole = columns(evaluated)["Perfect"]["accuracy"]
    assert perfect["distance_m"] == pytest.approx(ours["distance_m"], rel=0.05)
    assert perfect["distance_m"] < 0.9 * whole["distance_m"]


def test_a_finished_run_is_not_run_again(recording: Path, evaluated: Path) -> None:
    runs = sorted((evaluated / "runs").rglob("run.json"))
    before = {path: path.stat().st_mtime_ns for path in runs}
    done = call(recording, "--out", evaluated, "--variant", VARIANT, "--compare", f"Perfect={evaluated / 'theirs.tum'}")
    assert done.exit_code == 0
    assert before == {path: path.stat().st_mtime_ns for path in runs}


def deterministic(folder: Path) -> Any:
    """results.json but for times, memory, and where things lie."""

    def kept(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: kept(entry) for name, entry in value.items() if name not in ("runtime_ms", "findings")}
        return [kept(entry) for entry in value] if isinstance(value, list) else value

    return kept(results(folder)["recordings"])


def test_killed_at_any_moment_and_started_again_it_gives_the_same_tables(
    recording: Path, evaluated: Path, tmp_path: Path
) -> None:
    systems = ("--variant", VARIANT, "--baseline", "loam")
    arguments = (recording, "--out", tmp_path, "--no-ablation", *systems)
    whole = evaluated.parent / "whole"
    assert call(*arguments[:2], whole, *arguments[3:]).exit_code == 0
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    runs = tmp_path / "runs" / "walk"

    def kill_when(moment: Callable[[], bool]) -> None:
        for _ in range(5):
            process = subprocess.Popen(
                command(*arguments), cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            while not moment() and process.poll() is None:
                time.sleep(0.001)
            process.send_signal(signal.SIGKILL)
            if process.wait() == -signal.SIGKILL:  # it was still at work
                return
            shutil.rmtree(runs)  # on a busy machine the moment may pass unseen
        pytest.fail("it was never caught at work")

    begin = time.monotonic()
    kill_when(lambda: time.monotonic() > begin + 2.0)  # before the first results
    kill_when(lambda: any(runs.glob("*/trajectory.tum")))  # in the middle of writing results
    kill_when(lambda: any(runs.glob("*/run.json")))  # some are finished, some are not
    survived = {path: path.stat().st_mtime_ns for path in runs.glob("*/run.json")}
    done = call(*arguments)
    assert done.exit_code == 0, done.output
    assert deterministic(tmp_path) == deterministic(whole)
    assert survived.items() <= {path: path.stat().st_mtime_ns for path in runs.glob("*/run.json")}.items()
    assert all({path.name for path in run.iterdir()} == set(RUN_FILES) for run in runs.iterdir())


def test_a_variant_is_a_name_and_parameters() -> None:
    variant = parse_variant("mine:ground.sigma=0.03,sensor.translation=[0, 0.1, 0],map.radius=50")
    assert variant.values == {"ground.sigma": 0.03, "sensor.translation": [0, 0.1, 0], "map.radius": 50}
    assert variant.applied(Params()).sensor.translation == (0, 0.1, 0)
    assert PAPER[0].applied(Params()).ground.enabled is False
    assert PAPER[1].applied(Params()).ground.enabled is True


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("ground.sigma=0.03", "write it as"),
        ("x:ground.sigma", "write it as"),
        ("a/b:ground.sigma=0.03", "cannot be named `a/b`"),
    ],
)
def test_a_malformed_variant_is_refused(text: str, says: str) -> None:
    with pytest.raises(HemislamError, match=says):
        parse_variant(text)


def test_two_variants_of_one_name_and_misspelt_parameters_are_refused() -> None:
    with pytest.raises(HemislamError, match="two variants named Ours"):
        choose_variants([parse_variant("Ours:ground.sigma=0.03")], ablation=True)
    with pytest.raises(HemislamError, match=r"Variant x: There is no parameter `ground\.sigm`"):
        parse_variant("x:ground.sigm=0.03").applied(Params())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "Nothing to evaluate"),
        (["--suite", "papre"], "no suite `papre`"),
        (["RECORDING", "--lever-arm", "1", "2"], "requires 3 arguments"),
        (["RECORDING", "--lever-arm", "1", "2", "3", "--truth", "none"], "--lever-arm belongs to a truth"),
        (["RECORDING", "--compare", "theirs.tum"], "NAME=FILE"),
        (["RECORDING", "--compare", "Ours=theirs.tum"], "a column Ours exists already"),
        (["RECORDING", "--short"], "--duration shortens it"),
        (["RECORDING", "--start", "10000"], "has no scan after 10000 s; it lasts"),
        (["RECORDING", "--truth", "topic:/odom"], "no topic /odom"),
        (["RECORDING", "--truth", "a", "--truth", "b"], "2 --truth options for 1 recordings"),
        (["RECORDING", "--out", "/proc"], "The folder /proc/runs cannot be made"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence(
    recording: Path, tmp_path: Path, arguments: list[str], says: str
) -> None:
    out = tmp_path / "out"
    done = call("--out", out, *(str(recording) if text == "RECORDING" else text for text in arguments))
    assert done.exit_code == 2 and not out.exists()
    assert says in done.stderr and "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_each_recording_has_a_name_of_its_own(tmp_path: Path) -> None:
    paths = [tmp_path / folder / f"{name}.mcap" for folder, name in (("a", "x~2"), ("a", "x"), ("b", "x"), ("c", "x"))]
    names = [subject.name for subject in read_subjects(paths, lambda *_, **__: Params(), ["none"] * 4)]
    assert names == ["x~2", "x", "x~3", "x~4"]
