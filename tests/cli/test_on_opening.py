"""Tests app/cli/run.py: `run` and `info` with an unknown mounting."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from app.__main__ import cli
from app.calibration.calibrate import Calibration
from app.slam.params import Params
from tests.calibration.rehearsal import known


def rehearsed(monkeypatch: pytest.MonkeyPatch, *, sure: bool = True) -> None:
    def found(path: Path, params: Params, *_: object) -> Calibration:
        return known(path, sure=sure, params=params)

    monkeypatch.setattr("app.calibration.calibrate.calibrate", found)


def test_an_unknown_mounting_is_found_used_and_reported(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rehearsed(monkeypatch)
    done = CliRunner().invoke(cli, ["run", str(walk), "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "The LiDAR seems to be rotated by 70°, -50°, 104° on the IMU" in done.output
    assert "rotated by 70°, -50°, 104°" in report["calibration"] and "--write" in report["calibration"]
    assert np.allclose(report["parameters"]["sensor"]["rotation"], [70, -50, 104], atol=0.01)


def test_a_given_mounting_or_a_refusal_is_respected(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rehearsed(monkeypatch)
    for number, option in enumerate(["--preset=h2lid-mount", "--no-calibrate"]):
        folder = tmp_path / str(number)
        CliRunner().invoke(cli, ["run", str(walk), option, "--out", str(folder)])
        report = json.loads((folder / "report.json").read_text())
        assert report["calibration"] is None and report["parameters"]["sensor"]["rotation"] == [0, 0, 0]


def test_what_a_motion_does_not_determine_changes_nothing(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rehearsed(monkeypatch, sure=False)
    done = CliRunner().invoke(cli, ["run", str(walk), "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["calibration"] is None and "seems to be" not in done.output


def test_info_shows_how_the_lidar_is_turned(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsed(monkeypatch)
    told = CliRunner().invoke(cli, ["info", str(walk)]).output
    assert "rotated by 70°, -50°, 104° on the IMU, and the IMU's clock" in told
    assert f"`run` and `serve` use this. To save it: hemislam calibrate {walk} --write" in told
    assert told.count("mount ") == 1 and "no pose of the LiDAR on the IMU is given" not in told, "it is said once"


def test_the_command_to_save_it_can_be_pasted(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsed(monkeypatch)
    mine = tmp_path / "my walk.mcap"
    mine.symlink_to(walk)
    told = CliRunner().invoke(cli, ["info", str(mine)]).output
    assert f"hemislam calibrate '{mine}' --write" in told


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--write"], "add --force"),
        (["--plot", "none/residuals.svg"], "folder that exists"),
        (["--plot", "walk.mcap"], "choose a .svg"),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("app.calibration.calibrate.calibrate", lambda *_: pytest.fail("minutes of work are lost"))
    Path("walk.params.yaml").write_text("sensor: {max_range: 40}\n")
    done = CliRunner().invoke(cli, ["calibrate", "walk.mcap", *options])
    assert done.exit_code == 2 and said in done.output


def test_what_cannot_be_kept_can_be_passed_instead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsed(monkeypatch)
    monkeypatch.chdir(tmp_path)
    Path("walk.params.yaml").mkdir()
    done = CliRunner().invoke(cli, ["calibrate", "walk.mcap", "--write", "--plot", "residuals.svg"])
    assert done.exit_code == 2 and "Is a directory" in done.output and "Instead, pass --set 'sensor." in done.output
