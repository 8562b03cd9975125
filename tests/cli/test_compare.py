"""A mapped room compared with its exact shape. Tests app/cli/compare.py, app/ui/corners.py."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.export.map_file import MapFile
from app.georeference.reference import FILE, GeoReference
from app.mapping.kept import Measure
from app.server.chunks import thinned
from app.slam.ply import header
from app.ui.corners import meeting, snapped
from app.ui.measure_maths import meet, numbers, places
from tests.cli.conftest import ROOM

Call = Callable[..., Any]
LOW, HIGH = np.sort(ROOM * [-1, -1, 1], axis=0)
"""Corners of the room in the map, whose x points back there."""
XYZ = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")])


@pytest.fixture(scope="module")
def results(hemislam: Call, walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare") / "results"
    assert hemislam("run", walk, "--out", folder).code == 0
    return folder


def exact(n: int = 15_000) -> np.ndarray:
    """(6 n, 3) points exactly on the sides of the room."""
    rng, sides = np.random.default_rng(5), []
    for axis in range(3):
        for end in (LOW, HIGH):
            side = rng.uniform(LOW, HIGH, (n, 3))
            side[:, axis] = end[axis]
            sides.append(side)
    return np.concatenate(sides)


def write(path: Path, points: np.ndarray) -> Path:
    path.write_bytes(header(XYZ, len(points)) + points.astype("<f8").tobytes())
    return path


def test_the_map_of_a_room_lies_on_its_exact_walls(results: Path, hemislam: Call, tmp_path: Path) -> None:
    out = tmp_path / "apart.ply"
    outcome = hemislam("compare", results, write(tmp_path / "exact.ply", exact()), "--out", out)
    assert outcome.code == 0, outcome.err
    median, half, most = (float(line.split()[-2]) for line in outcome.out.splitlines()[:3])
    assert abs(median) < 0.3 and half < 0.5 and most < 2.0, "cm"
    assert b"property float distance" in out.read_bytes()[:400]


def test_georeferenced_results_are_compared_with_a_map_in_their_grid(
    results: Path, hemislam: Call, tmp_path: Path
) -> None:
    where = GeoReference("EPSG:32632", (500_000.0, 5_400_000.0, 300.0), ((0.0, -1, 0), (1, 0, 0), (0, 0, 1)), 0.9996)
    folder = shutil.copytree(results, tmp_path / "georeferenced")
    (folder / FILE).write_text(where.to_json())
    grid = write(tmp_path / "grid.ply", where.to_crs(exact()))
    for maps in ((folder, grid), (grid, folder)):
        outcome = hemislam("compare", *maps)
        assert outcome.code == 0, outcome.err
        median, half, _ = (float(line.split()[-2]) for line in outcome.out.splitlines()[:3])
        assert abs(median) < 1.0 and half < 1.0, "cm"
    assert "do not lie on each other" in hemislam("compare", results, grid).refused()


def test_what_is_no_map_is_refused(results: Path, hemislam: Call, tmp_path: Path) -> None:
    (tmp_path / "not.ply").write_text("nonsense")
    assert "damaged" in hemislam("compare", results, tmp_path / "not.ply").refused()
    assert "cannot be read" in hemislam("compare", tmp_path, results).refused()
    (tmp_path / "loop.ply").symlink_to(tmp_path / "loop.ply")
    assert "leads to itself" in hemislam("compare", results, results, "--out", tmp_path / "loop.ply").refused()
    away = write(tmp_path / "away.ply", exact(10) + 50.0)
    assert "do not lie on each other" in hemislam("compare", results, away).refused()
    few = write(tmp_path / "few.ply", exact(3))
    assert "too sparse" in hemislam("compare", results, few).refused()


def test_a_comparison_replaces_no_map_and_needs_a_folder_that_exists(
    results: Path, hemislam: Call, tmp_path: Path
) -> None:
    other = write(tmp_path / "other.ply", exact(10))
    for out, says in (
        (other, "a map to compare"),
        (results / "map.ply", "a map to compare"),
        (tmp_path / "nowhere" / "apart.ply", "cannot be written"),
        (tmp_path, "cannot be written"),
        (tmp_path / "changes.laz", "choose a .ply file"),
    ):
        assert says in hemislam("compare", results, other, "--out", out).refused()
    refused = hemislam("compare", "nothing.ply", other, "--out", "/proc/apart.ply").refused()
    assert "/proc/apart.ply cannot be written (" in refused, "before the maps are read"


@pytest.fixture(scope="module")
def mapped(results: Path) -> Any:
    """Chunks as the page has them, and poses of their keyframes."""
    file = MapFile(results / "map.ply")
    keyframes = [file[k] for k in range(len(file))]
    return tuple(thinned(one) for one in keyframes), np.array([one.T_odom_imu for one in keyframes])


def test_the_distance_of_two_corners_is_measured_to_a_centimetre_by_clicks_near_them(mapped: Any) -> None:
    chunks, poses = mapped
    eye, found = np.array([-0.5, 0.0, 0.0]), []
    corners = np.array([[LOW[0], y, HIGH[2]] for y in (LOW[1], HIGH[1])])
    for corner in corners:
        spot = meet(chunks, poses, eye, corner + np.array([0.1, 0.0, -0.1]) - eye, 0.03, ceilings=True)
        assert spot is not None
        found.append(snapped(chunks, poses, spot))
    at = places(Measure("width", tuple(found)), poses)
    assert at is not None
    measured = numbers(at, chunks, poses)
    assert measured.distance == pytest.approx(HIGH[1] - LOW[1], abs=0.01)
    assert measured.vertical == pytest.approx(0.0, abs=0.02)
    assert np.abs(at - corners)[:, :2].max() < 0.01, "two scans see too little of the ceiling there"


def test_a_click_on_a_wall_stays_where_it_is_but_for_the_noise(mapped: Any) -> None:
    chunks, poses = mapped
    spot = meet(chunks, poses, np.zeros(3), np.array([-1.0, 0.1, 0.0]), 0.03, ceilings=True)
    assert spot is not None
    before, after = (places(Measure("", (one,)), poses) for one in (spot, snapped(chunks, poses, spot)))
    assert before is not None and after is not None
    assert after[0, 0] == pytest.approx(LOW[0], abs=0.01) and np.linalg.norm(after - before) < 0.03


def test_a_corner_is_where_its_three_noisy_sides_meet() -> None:
    rng = np.random.default_rng(6)
    sides = rng.uniform(0.0, 1.0, (3, 300, 3))
    for axis in range(3):
        sides[axis, :, axis] = rng.normal(0.0, 0.005, 300)
    at = np.array([0.15, 0.2, 0.1])
    assert meeting(sides.reshape(-1, 3) - at) == pytest.approx(-at, abs=0.003)
    assert meeting(sides.reshape(-1, 3) - [0.6, 0.0, 0.0]) == pytest.approx([0.0, 0.0, 0.0], abs=0.003), "too far"


def test_an_edge_moves_a_click_across_and_not_along_it() -> None:
    rng = np.random.default_rng(3)
    wall, floor = rng.uniform(-0.5, 0.5, (2, 400, 3))
    wall[:, 0], floor[:, 2] = 0.2, -0.1
    assert meeting(np.concatenate([wall, floor])) == pytest.approx([0.2, 0.0, -0.1], abs=1e-6)
    assert meeting(rng.uniform(-0.5, 0.5, (40, 3))).tolist() == [0, 0, 0], "a bush has no edge"
    assert meeting(np.empty((0, 3))).tolist() == [0, 0, 0]
