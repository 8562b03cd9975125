"""`hemislam georeference` on a walk whose truth is known. Tests app/cli/georeference.py."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.georeference import reference
from app.slam.trajectory import stamp_text, write_tum
from tests.georeference.walks import LEVER, TRUTH, Walked, off, walked

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def made() -> Walked:
    return walked()


@pytest.fixture
def results(made: Walked, tmp_path: Path) -> Path:
    write_tum(tmp_path / "trajectory.tum", made.trajectory)
    fixes = made.fixes
    rows = np.column_stack([fixes.latitude, fixes.longitude, fixes.height, fixes.sigmas])
    lines = [
        ",".join([stamp_text(stamp), *map(repr, row)])
        for stamp, row in zip(fixes.stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    text = "time,latitude,longitude,height,sigma_e,sigma_n,sigma_u\n" + "\n".join(lines) + "\n"
    (tmp_path / "fixes.csv").write_text(text)
    return tmp_path


def test_a_file_of_fixes_places_the_map_and_names_each_wild_fix(hemislam: Call, made: Walked, results: Path) -> None:
    outcome = hemislam("georeference", results, "--gnss", results / "fixes.csv", "--lever-arm", *LEVER)
    assert outcome.code == 0, outcome.err
    found = reference.read(results)
    assert found is not None and found.crs == "EPSG:32632"
    assert np.sqrt((off(found, made.trajectory) ** 2).mean()) < 0.02
    rejected = {line.split()[0] for line in outcome.out.splitlines() if "rejected" in line}
    assert {str(number) for number in made.outliers} <= rejected | {"719", "720"}  # after the last pose
    assert "Clock offset" in outcome.out and "RMS" in outcome.out
    assert {path.name for path in results.iterdir()} >= {"gnss_residuals.csv", "georeference.svg"}


def test_without_fixes_it_says_where_to_take_them_from(hemislam: Call, results: Path) -> None:
    outcome = hemislam("georeference", results)
    assert outcome.code == 2 and "--gnss FILE" in outcome.err
    (results / "report.json").write_text(json.dumps({"recording": {"path": str(results / "gone.mcap")}}))
    outcome = hemislam("georeference", results)
    assert outcome.code == 2 and "There is no recording" in outcome.err


def test_a_folder_without_a_trajectory_is_refused(hemislam: Call, tmp_path: Path) -> None:
    outcome = hemislam("georeference", tmp_path)
    assert outcome.code == 2 and "trajectory.tum cannot be read" in outcome.err


def test_control_points_are_listed_with_their_residuals(hemislam: Call, results: Path) -> None:
    grid = TRUTH.to_crs(np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 1.0], [0.0, 20.0, 2.0]])).tolist()
    (results / "c.csv").write_text("name,E,N,H\n" + "".join(f"P{k},{e},{n},{h}\n" for k, (e, n, h) in enumerate(grid)))
    (results / "p.csv").write_text("name,x,y,z\nP0,0,0,0\nP1,30,0,1\nP2,0,20,2\n")
    files = ("--control", results / "c.csv", "--picks", results / "p.csv")
    outcome = hemislam("georeference", results, *files, "--crs", "EPSG:32632")
    assert outcome.code == 0, outcome.err
    assert [line.split()[0] for line in outcome.out.splitlines() if line.startswith("P")] == ["P0", "P1", "P2"]
    assert "of 3 of 3 control points" in outcome.out
    outcome = hemislam("georeference", results, *files[:2])
    assert outcome.code == 2 and "go together" in outcome.err
