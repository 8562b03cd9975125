"""Sections of a room of known size and profiles of bent walks, as PIL, ezdxf and an XML reader see them.

Tests app/export/section.py, app/export/section_files.py, app/export/box.py.
"""

from pathlib import Path
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from PIL import Image
from test_las import UTM
from test_plan import FLOOR, HIGH, LOW, room
from test_results import frame, keyframe

from app.export.box import Box
from app.export.exports import of_formats, save_results
from app.export.points import Choice
from app.export.results import Results
from app.export.section import along_path, strides
from app.georeference.reference import GeoReference
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.frames import Frame
from app.slam.run_log import RunLog
from app.slam.types import NON_GROUND

ACROSS = Box((-4.0, -0.5, -2.0), (4.0, 0.5, 2.0))
"""Cuts both short walls, the floor and the table, not the short wall."""


def points_of(path: Path) -> dict[str, np.ndarray]:
    """(n, 2) by layer, as another program reads them."""
    space = ezdxf.readfile(path).modelspace()
    return {
        name: np.array([tuple(one.dxf.location)[:2] for one in space if one.dxf.layer == name])
        for name in ("points", "ground")
    }


def test_a_box_holds_what_a_rotation_matrix_says() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-5, 5, (4000, 3))
    box = Box.around((1.0, -0.5, 0.2), (4.0, 2.0, 3.0), 30.0)
    turned = (points - [1.0, -0.5, 0.2]) @ np.array([[3**0.5 / 2, -0.5, 0], [0.5, 3**0.5 / 2, 0], [0, 0, 1]])
    inside = (np.abs(turned) <= [2.0, 1.0, 1.5]).all(axis=1)
    np.testing.assert_array_equal(box.holds(points), inside)
    np.testing.assert_array_equal(box.holds(points.astype(np.float32)), inside)
    assert 50 < inside.sum() < 400 and Box.around((0, 0, 0), (1, 1, 1), 350.0).turn == -10.0


def test_a_box_without_sense_is_refused() -> None:
    with pytest.raises(HemislamError, match="empty"):
        Box((0.0, 0, 0), (1.0, 1, float("nan")))
    with pytest.raises(HemislamError, match="turned"):
        Box((0.0, 0, 0), (1.0, 1, 1), 1e9)


def test_a_map_that_control_points_have_levelled_has_their_heights(tmp_path: Path) -> None:
    """A map tilted by 1° along x, where a metre of chainage is 17.5 mm of height."""
    results = room()
    rows = tuple(map(tuple, lie.from_rpy_degrees((0.0, -1.0, 0.0)).tolist()))
    results.where = GeoReference("EPSG:32632", (456_789.0, 5_432_100.0, 300.0), rows)  # type: ignore[arg-type]
    results.choice = Choice(box=ACROSS)
    save_results(tmp_path, results, of_formats(["section"]))
    floor = points_of(tmp_path / "section.dxf")["ground"]
    expected = 300.0 + np.cos(np.radians(1)) * FLOOR + np.sin(np.radians(1)) * (floor[:, 0] - 4.0)
    np.testing.assert_allclose(floor[:, 1], expected, atol=1e-3)


@pytest.mark.parametrize("on_earth", [False, True])
def test_a_section_shows_floor_walls_and_table_to_a_millimetre(tmp_path: Path, on_earth: bool) -> None:
    results = room(UTM if on_earth else None)
    results.choice = Choice(box=ACROSS)
    save_results(tmp_path, results, of_formats(["section"]))
    up = UTM.to_crs(np.zeros((1, 3)))[0, 2] if on_earth else 0.0
    found = points_of(tmp_path / "section.dxf")
    floor, rest = found["ground"] - [4.0, up], found["points"] - [4.0, up]
    np.testing.assert_allclose(floor[:, 1], FLOOR, atol=1e-3)
    np.testing.assert_allclose([rest[:, 0].min(), rest[:, 0].max()], [LOW[0], HIGH[0]], atol=1e-3)
    assert rest[:, 1].max() == pytest.approx(FLOOR + 2.48, abs=1e-3)
    table = rest[np.abs(rest[:, 0] - 0.5) < 0.4]
    np.testing.assert_allclose(table[:, 1], FLOOR + 0.7, atol=1e-3)
    tree = ElementTree.parse(tmp_path / "section.svg")
    dots = next(one for one in tree.iter() if one.get("id") == "ground").get("d", "")
    first = np.array(dots.split("h0")[0].removeprefix("M").split(), float)
    np.testing.assert_allclose(first * [1, -1] - [4.0, up], floor[0], atol=6e-4)
    numbers = [float(one.text) for one in tree.iter() if one.get("text-anchor") == "end" and one.text]
    assert len(numbers) >= 2 and np.ptp(numbers) <= 2.48, "heights can be read off"
    picture = np.asarray(Image.open(tmp_path / "section.png"))
    assert (picture.sum(axis=2) < 300).any() and picture.shape[1] == 6.02 / 0.02 + 130


def test_a_turned_box_is_seen_from_its_own_front(tmp_path: Path) -> None:
    results = room()
    results.choice = Choice(box=Box.around((0.0, 0.0, 0.0), (8.0, 0.2, 4.0), 90.0))
    save_results(tmp_path, results, of_formats(["section"]))
    at = points_of(tmp_path / "section.dxf")["points"][:, 0] - 4.0
    np.testing.assert_allclose([at.min(), at.max()], [LOW[1], HIGH[1]], atol=1e-3)


def walked(turns: list[tuple[float, float]]) -> Results:
    """Along a polyline in steps of 1 cm, with a pole of 2 m every metre, 0.2 m to its left."""
    ends = np.array(turns)
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    s = np.arange(0, lengths.sum(), 0.01)
    path = np.column_stack([np.interp(s, [0, *lengths.cumsum()], ends[:, k]) for k in range(2)])
    frames = [Frame.of(frame(k)) for k in range(len(path))]
    for one, place in zip(frames, path, strict=True):
        one.position[:] = [*place, 1.0]
    ahead = np.gradient(path, axis=0) / 0.01
    feet = (path + 0.2 * np.column_stack([-ahead[:, 1], ahead[:, 0]]))[50::100]
    poles = np.array([(*foot, z) for foot in feet for z in np.arange(0.01, 2, 0.02)])
    one = keyframe(0, poles.tolist(), [NON_GROUND] * len(poles))
    T = one.T_odom_imu @ one.T_imu_lidar
    one.cloud.points[:] = (poles - T[:3, 3]) @ T[:3, :3]
    return Results(RunLog(frames), [one], room().info)


def test_a_profile_has_the_poles_along_a_bent_walk_at_their_chainage(tmp_path: Path) -> None:
    results = walked([(0, 0), (10, 0), (10, 8), (0, 8)])
    results.choice = Choice(slab=0.6)
    save_results(tmp_path, results, of_formats(["profile"]))
    found = points_of(tmp_path / "profile.dxf")["points"]
    chainage = np.unique(found[:, 0].round(2))
    np.testing.assert_allclose(chainage, np.arange(0.5, 28, 1.0)[: len(chainage)], atol=0.02)
    assert len(chainage) == 28 or len(chainage) == 27
    assert found[:, 1].min() == pytest.approx(0.01, abs=1e-3) and found[:, 1].max() == pytest.approx(1.99, abs=1e-3)


def test_what_lies_beside_a_path_is_at_the_nearest_place_of_each_passage() -> None:
    """There and back on straight lines 0.4 m apart: what is expected is plain geometry."""
    there = np.column_stack([np.arange(0, 10.01, 0.5), np.zeros(21)])
    back = np.column_stack([np.arange(10, -0.01, -0.5), np.full(21, 0.4)])
    points = np.random.default_rng(0).uniform((-1, -1), (9, 1.4), (500, 2))
    which, along, aside = along_path(points, np.concatenate([there, back]), 0.3)
    for index in range(len(points)):
        x, y = points[index]
        expected = [(x, y)] if x > 0 and abs(y) <= 0.3 else []
        expected += [(20.4 - x, 0.4 - y)] if x > 0 and abs(0.4 - y) <= 0.3 else []
        got = np.column_stack([along, aside])[which == index]
        np.testing.assert_allclose(got, np.reshape(expected, (-1, 2)), atol=1e-9)
    assert len(which) > len(np.unique(which)), "between there and back a point is beside both"


def test_a_bend_leaves_no_gap_on_its_outer_side() -> None:
    path = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]])
    angle = np.radians(np.arange(271, 360))
    outer = path[1] + 0.2 * np.column_stack([np.cos(angle), np.sin(angle)])
    which, along, aside = along_path(outer, path, 0.3)
    assert len(which) == len(outer)
    np.testing.assert_allclose(along, 5.0, atol=1e-9)
    np.testing.assert_allclose(aside, -0.2, atol=1e-9)


def test_a_walker_who_sways_walks_no_longer_way() -> None:
    s = np.arange(0, 50, 0.05)
    path = strides(np.column_stack([s, 0.02 * np.sin(2 * np.pi * s / 0.7)]))
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(50, rel=0.005)


def test_a_slab_without_points_or_walk_is_reported(tmp_path: Path) -> None:
    results = room()
    with pytest.raises(HemislamError, match="choose a box first"):
        save_results(tmp_path, results, of_formats(["section"]))
    results.choice = Choice(box=Box((90.0, 90, 90), (91.0, 91, 91)))
    with pytest.raises(HemislamError, match="no points in the box"):
        save_results(tmp_path, results, of_formats(["section"]))
    standing = Results(RunLog(results.log.frames[:1]), results.keyframes, results.info)
    with pytest.raises(HemislamError, match=r"shorter than 0\.5 m"):
        save_results(tmp_path, standing, of_formats(["profile"]))
    assert not list(tmp_path.iterdir())
    with pytest.raises(HemislamError, match="slab"):
        Choice(slab=0.0)
