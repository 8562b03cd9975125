"""`hemislam georeference` on a walk whose truth is known. Tests app/cli/georeference.py."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.export import map_file
from app.export.points import Block
from app.georeference import reference
from app.sensors.navsat import navsat_message
from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.factors import Factor
from app.slam.loops.solvers import g2o_text
from app.slam.trajectory import read_tum, stamp_text, write_tum
from tests.georeference.walks import LEVER, TRUTH, Walked, off, walked
from tests.sensors.rig import write_mcap

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def made() -> Walked:
    return walked()


@pytest.fixture
def results(made: Walked, tmp_path: Path) -> Path:
    write_tum(tmp_path / "trajectory.tum", made.trajectory)
    fixes = made.fixes
    rows = np.column_stack([fixes.places, fixes.sigmas])
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
    found, problem = reference.read(results)
    assert found is not None and problem == "" and found.crs == "EPSG:32632"
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
    assert outcome.code == 2 and "There is no recording" in outcome.err and "--gnss FILE" in outcome.err


def test_the_fixes_of_a_recording_that_was_moved_are_read_where_it_is_now(
    hemislam: Call, made: Walked, results: Path
) -> None:
    times = made.fixes.stamps_ns.tolist()
    moved = write_mcap(
        results / "moved.mcap", [("/fix", time, navsat_message(made.fixes, index)) for index, time in enumerate(times)]
    )
    outcome = hemislam("georeference", results, "--gnss", moved, "--lever-arm", *LEVER)
    assert outcome.code == 0, outcome.err
    found, _ = reference.read(results)
    assert found is not None and np.sqrt((off(found, made.trajectory) ** 2).mean()) < 0.02


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


def write_map(results: Path, made: Walked) -> None:
    """A map of one point in each tenth scan, and the graph of its odometry."""
    stamps_ns, poses = made.trajectory.stamps_ns[::10].tolist(), made.trajectory.poses[::10]
    none = np.zeros(1, np.uint8)
    map_file.write(
        results / "map.ply",
        [
            Block(k, stamp, pose, pose[None, :3, 3], np.array([stamp]), none, none.astype("f4"), none.astype("u2"))
            for k, (stamp, pose) in enumerate(zip(stamps_ns, poses, strict=True))
        ],
    )
    noise = np.diag([np.radians(0.3)] * 3 + [0.01] * 3) ** 2
    steps = enumerate(lie.inverse(poses[:-1]) @ poses[1:])
    factors = [Factor(KeyframeId(0, k), KeyframeId(0, k + 1), step, noise) for k, step in steps]
    (results / "graph.g2o").write_text(g2o_text(poses, factors))


def test_a_wild_fix_that_the_user_insists_on_pulls_walk_and_map_alike(
    hemislam: Call, made: Walked, results: Path
) -> None:
    write_map(results, made)
    bent, (wild, sound) = results / "bent", (int(made.outliers[3]), 101)
    assert sound not in made.outliers
    bent.mkdir()
    (bent / "report.json").write_text("{}")  # of another run
    call = ["georeference", results, "--gnss", results / "fixes.csv", "--lever-arm", *LEVER, "--factors", "--out"]
    assert "already holds results (report.json)" in hemislam(*call, bent).err
    outcome = hemislam(*call, bent, "--force", "--accept", wild, "--reject", sound)
    assert outcome.code == 0, outcome.err
    rows = csv.DictReader((bent / "gnss_residuals.csv").read_text().splitlines())
    verdicts = {int(row["name"]): row["verdict"] for row in rows}
    assert (verdicts[wild], verdicts[sound]) == ("accepted", "rejected")
    left = {"trajectory.tum", "map.ply", "georeference.json", "gnss_residuals.csv", "georeference.svg"}
    assert {path.name for path in bent.iterdir()} == left and reference.read(results) == (None, "")
    walk, keyframes = read_tum(bent / "trajectory.tum").positions, map_file.MapFile(bent / "map.ply")
    assert np.linalg.norm(walk - made.trajectory.positions, axis=1).max() > 0.01
    for k in (0, 30, 60):
        np.testing.assert_allclose(keyframes[k].T_odom_imu[:3, 3], walk[10 * k], atol=1e-6)


def test_a_map_is_not_bent_onto_itself(hemislam: Call, results: Path) -> None:
    files = ("--gnss", results / "fixes.csv", "--factors", "--force")
    outcome = hemislam("georeference", results, *files, "--out", results / "." / "")
    assert outcome.code == 2 and "give --out another folder" in outcome.err


def test_a_fix_cannot_be_both_accepted_and_rejected(hemislam: Call, results: Path) -> None:
    verdicts = ("--accept", 5, "--accept", 7, "--reject", 7)
    outcome = hemislam("georeference", results, "--gnss", results / "fixes.csv", *verdicts)
    assert outcome.code == 2 and "both name fix 7" in outcome.err
