"""Measures in the map, by clicks. Tests app/ui/measure.py, app/ui/measure_maths.py."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.mapping.kept import Measure, Spot
from app.server.keeping import EditMeasure, KeepMeasure
from app.server.protocol import Chunk, Command, Snapshot
from app.slam import lie
from app.slam.types import NON_GROUND
from app.ui.measure import ANGLE, DISTANCE, POINT, STOP, MeasurePanel
from app.ui.measure_maths import as_csv, height, meet, numbers, places, words
from app.ui.widgets import View
from tests.ui.conftest import Browser, Wire, page_of, user_sets

RANDOM = np.random.default_rng(7)
SEEN_AT = lie.transform(lie.exp(np.array([0.1, -0.2, 1.0])), np.array([4.0, -1.0, 1.2]))
MOUNTED = lie.transform(lie.exp(np.array([0.0, 0.3, 0.0])), np.array([0.02, 0.0, -0.1]))
UP_AT_10 = np.array([0.0, 0.0, 10.0])


def level(x: float, z: float, n: int = 4000) -> np.ndarray:
    """(n, 3) of a floor of 4 m by 4 m around x."""
    return np.column_stack([RANDOM.uniform(x - 2, x + 2, n), RANDOM.uniform(-2, 2, n), np.full(n, z)])


def chunk_of(index: int, points: np.ndarray, label: int = NON_GROUND) -> Chunk:
    """Of points in the map, seen from `SEEN_AT`."""
    T, n = lie.inverse(SEEN_AT @ MOUNTED), len(points)
    local = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    labels = np.full(n, label, np.uint8)
    return Chunk(index, index, 0, local, labels, np.zeros(n, np.float32), np.zeros(n, np.uint16), MOUNTED)


POSES = np.tile(SEEN_AT, (4, 1, 1))
TABLE, FLOOR, CELLAR = (chunk_of(i, level(0.0, z), label) for i, (z, label) in enumerate([(0.8, 0), (0.0, 1), (-3, 1)]))
HOUSE = (TABLE, FLOOR, CELLAR)


def spot_at(position: Any, keyframe: int = 0) -> Spot:
    x, y, z = (lie.inverse(POSES[keyframe]) @ (*position, 1.0))[:3].tolist()
    return Spot(keyframe, (x, y, z))


def test_a_click_means_the_point_in_front_not_the_floor_behind_it() -> None:
    aim = np.array([0.6, -0.4, 0.8])
    met = meet(HOUSE, POSES, UP_AT_10, aim - UP_AT_10, 0.01, ceilings=True)
    assert met is not None and met.keyframe == 0
    (at,) = places(Measure("", (met,)), POSES)  # type: ignore[misc]
    assert at == pytest.approx(aim, abs=0.1) and at[2] == pytest.approx(0.8, abs=1e-4)


@pytest.mark.parametrize("far_m", [10.0, 3000.0])
def test_of_the_points_in_front_the_nearest_to_the_ray_is_meant_also_from_far_away(far_m: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.02]])
    eye = np.array([0.001, 0.0, far_m])  # orthographic views are made from far away
    met = meet((chunk_of(0, points),), POSES, eye, np.array([0.0, 0.0, -1.0]), 0.05 / far_m, ceilings=True)
    assert met is not None and places(Measure("", (met,)), POSES) == pytest.approx(points[:1], abs=1e-4)


def test_a_click_into_the_sky_and_what_is_behind_the_camera_mean_nothing() -> None:
    for direction in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)):
        assert meet(HOUSE, POSES, UP_AT_10, np.array(direction), 0.01, ceilings=True) is None


def test_heights_are_over_the_floor_below_and_not_over_the_cellar() -> None:
    assert height(np.array([0.5, 0.5, 0.8]), HOUSE, POSES) == pytest.approx(0.8, abs=1e-3)
    assert height(np.array([0.5, 0.5, -1.0]), HOUSE, POSES) == pytest.approx(2.0, abs=1e-3)
    assert height(np.array([0.5, 0.5, 0.0]), HOUSE, POSES) == pytest.approx(0.0, abs=1e-3)
    assert np.isnan(height(np.array([50.0, 0.0, 1.0]), HOUSE, POSES))


def test_a_room_of_3_by_4_by_12_metres_has_a_diagonal_of_13_and_right_angles() -> None:
    a, b, c = np.zeros(3), np.array([3.0, 4.0, 12.0]), np.array([3.0, 4.0, 0.0])
    found = numbers(np.stack([a, b]), (), POSES)
    assert (found.distance, found.horizontal, found.vertical) == pytest.approx((13.0, 5.0, 12.0))
    assert "13.000 m: 5.000 m horizontal, +12.000 m vertical" in words(np.stack([a, b]), found)
    assert ", 0.00 m above" in words(a[None], replace(found, height=-0.003)), "not -0.00"
    assert numbers(np.stack([a, c, b]), (), POSES).angle == pytest.approx(90.0)
    assert numbers(np.stack([a, b, 2 * b]), (), POSES).angle == pytest.approx(180.0)


def test_a_measure_moves_with_the_map_and_waits_for_its_keyframe() -> None:
    wall = Measure("wall", (spot_at((1.0, 2.0, 3.0), 2),))
    moved = POSES.copy()
    moved[2] = lie.transform(np.eye(3), np.array([0.5, 0.0, 0.0])) @ POSES[2]
    assert places(wall, moved) == pytest.approx(np.array([[1.5, 2.0, 3.0]]))
    assert places(wall, POSES[:2]) is None


def test_a_measure_is_not_put_on_another_keyframe_that_other_settings_made() -> None:
    wall = Measure("wall", (Spot(1, (0.0, 0.0, 0.0), 45),))
    assert places(wall, POSES, {0: 0, 1: 45}) is not None
    assert places(wall, POSES, {0: 0, 1: 49}) is None, "it would be somewhere else"
    assert places(replace(wall, spots=(Spot(1, (0.0, 0.0, 0.0)),)), POSES, {1: 49}) is not None, "of an older file"


def test_the_csv_has_a_row_for_each_spot() -> None:
    at = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    door = Measure("door, left", (spot_at(at[0]), spot_at(at[1])))
    head, first, second = as_csv([(door, at, numbers(at, (), POSES))]).splitlines()
    assert head.startswith("name,x_m,y_m,z_m,height_m,distance_m")
    assert first == '"door, left",0.0000,0.0000,0.0000,,5.0000,5.0000,0.0000,'
    assert second == '"door, left",3.0000,4.0000,0.0000,,,,,'


# --- the panel -----------------------------------------------------------------------------------
class Bench:
    """A panel on a house of one keyframe, and clicks from 10 m above it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.now = Snapshot(chunks=HOUSE, keyframe_poses=POSES)
        self.panel = MeasurePanel(page_of(server, self.sent.append, lambda: self.now))

    def click(self, x: float, y: float) -> None:
        direction = tuple(np.array([x, y, 0.8]) - UP_AT_10)
        client = SimpleNamespace(camera=SimpleNamespace(fov=1.0))
        event = SimpleNamespace(client=client, ray_origin=tuple(UP_AT_10), ray_direction=direction)
        self.panel.clicked(event)  # type: ignore[arg-type]
        self.panel.draw(self.now, View())

    def keep(self) -> None:
        """As the engine does."""
        for command in self.sent:
            assert isinstance(command, KeepMeasure)
            self.now = replace(self.now, measures=(*self.now.measures, command.measure))
        self.sent.clear()
        self.panel.draw(self.now, View())


@pytest.mark.parametrize(("kind", "clicks"), [(POINT, 1), (DISTANCE, 2), (ANGLE, 3)])
def test_a_measure_takes_as_many_clicks_as_it_needs_and_is_named(
    server: viser.ViserServer, kind: str, clicks: int
) -> None:
    bench = Bench(server)
    bench.click(0.0, 0.0)
    assert not bench.panel.picking and not bench.sent, "clicks are for others"
    bench.panel.begin(kind)
    for n in range(clicks):
        assert not bench.sent
        bench.click(0.5 * n, 0.3 * n * n)
    (command,) = bench.sent
    assert isinstance(command, KeepMeasure) and command.measure.name == f"{kind} 1"
    assert len(command.measure.spots) == clicks
    bench.keep()
    assert f"{kind} 1" in bench.panel._list.content and bench.panel._save.visible


def test_a_click_beside_the_map_is_not_taken_and_stop_ends_it(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.panel.begin(DISTANCE)
    bench.click(0.0, 0.0)
    bench.click(80.0, 0.0)
    assert not bench.sent and "Distance: click 1 more point of the map." in bench.panel._asked.content
    bench.panel.begin(STOP)
    bench.click(1.0, 0.0)
    assert not bench.sent and not bench.panel._asked.content


def test_while_the_map_is_hidden_the_panel_says_why_no_click_counts(server: viser.ViserServer) -> None:
    bench = Bench(server)
    for begin in (lambda: bench.panel.begin(POINT), lambda: bench.panel.begin(POINT, lambda *_: None)):
        begin()
        bench.panel.draw(bench.now, View(map=False))
        assert "The map is hidden" in bench.panel._asked.content
        bench.panel.draw(bench.now, View())
        assert "The map is hidden" not in bench.panel._asked.content
    bench.panel.begin(STOP)
    bench.panel.draw(bench.now, View(map=False))
    assert not bench.panel._asked.content


def test_the_active_tool_and_each_point_clicked_are_marked(server: viser.ViserServer, wire: Wire) -> None:
    bench = Bench(server)
    bench.panel.draw(bench.now, View())
    assert bench.panel._kinds.options == ("point", "distance", "angle")
    bench.panel.begin(ANGLE)
    bench.click(0.0, 0.0)
    bench.click(0.5, 0.0)
    assert bench.panel._kinds.options == ("point", "distance", "● angle", "stop")
    assert [m.props.text for m in wire.messages if type(m).__name__ == "LabelMessage"][-2:] == ["1", "2"]
    user_sets(bench.panel._kinds, "stop")
    assert not bench.panel.picking


@pytest.mark.parametrize(("kind", "clicks", "label"), [(POINT, 1, "point 1"), (DISTANCE, 2, "distance 1: 0.517 m")])
def test_the_label_in_the_scene_is_short(
    server: viser.ViserServer, wire: Wire, kind: str, clicks: int, label: str
) -> None:
    bench = Bench(server)
    bench.panel.begin(kind)
    for n in range(clicks):
        bench.click(0.5 * n, 0.0)
    bench.keep()
    assert [m.props.text for m in wire.messages if type(m).__name__ == "LabelMessage"][-1] == label


def test_a_long_name_leaves_its_number_on_the_label(server: viser.ViserServer, wire: Wire) -> None:
    bench = Bench(server)
    bench.panel._name.value = "the north-east corner of the old refectory " * 5
    bench.panel.begin(DISTANCE)
    bench.click(0.0, 0.0)
    bench.click(0.5, 0.0)
    bench.keep()
    label = [m.props.text for m in wire.messages if type(m).__name__ == "LabelMessage"][-1]
    assert label == "the north-east corner of the ol…: 0.517 m"


def test_a_measure_that_is_begun_is_not_ended_in_another_recording(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.panel.begin(DISTANCE)
    bench.click(0.0, 0.0)
    bench.now = replace(bench.now, session=bench.now.session + 1)
    bench.click(0.5, 0.0)
    assert not bench.sent and "Distance: click 1 more point of the map." in bench.panel._asked.content
    bench.click(0.0, 0.5)
    (command,) = bench.sent
    assert isinstance(command, KeepMeasure) and len(command.measure.spots) == 2


def test_a_measure_of_what_is_not_here_yet_is_still_counted(server: viser.ViserServer) -> None:
    bench = Bench(server)
    bench.panel.begin(POINT)
    bench.click(0.0, 0.0)
    bench.keep()
    bench.now = replace(bench.now, chunks=(), keyframe_poses=POSES[:0])
    bench.panel.draw(bench.now, View())
    assert "1 more on keyframes" in bench.panel._list.content


def test_a_click_that_is_met_while_stop_is_pressed_is_dropped(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(server)

    def meet_slowly(*_: Any, **__: Any) -> Spot:
        bench.panel.begin(STOP)
        return spot_at((0.0, 0.0, 0.8))

    monkeypatch.setattr("app.ui.measure.meet", meet_slowly)
    bench.panel.begin(POINT)
    bench.click(0.0, 0.0)
    assert not bench.sent and not bench.panel.spots


def test_a_cut_that_is_stopped_at_its_last_click_does_not_become_a_measure(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, taken = Bench(server), list[tuple[Spot, ...]]()

    class Pressed(dict[str, int]):
        def __getitem__(self, kind: str) -> int:
            bench.panel.begin(STOP)
            return 1

    bench.panel.begin(POINT, lambda spots, _: taken.append(spots))
    monkeypatch.setattr("app.ui.measure._SPOTS", Pressed())
    bench.panel._take(bench.panel._tool, spot_at((0.0, 0.0, 0.8)), bench.now)
    assert not bench.sent and len(taken) == 1


def test_a_number_that_a_deleted_measure_had_is_free_again_and_no_other(server: viser.ViserServer) -> None:
    bench, names = Bench(server), []
    bench.panel.begin(POINT)
    for deleted in (None, None, 0, None):
        if deleted is not None:
            bench.now = replace(bench.now, measures=bench.now.measures[1:])
        bench.click(0.0, 0.0)
        bench.keep()
        names.append(bench.now.measures[-1].name)
    assert names == ["point 1", "point 2", "point 1", "point 3"]


def test_the_list_deletes_a_measure_and_an_empty_list_is_not_there(server: viser.ViserServer, wire: Wire) -> None:
    bench = Bench(server)
    bench.panel.begin(POINT)
    bench.click(0.0, 0.0)
    bench.keep()
    (kept,) = bench.now.measures
    assert any("/measures/0" in name for name in wire.nodes("PointCloudMessage"))
    for word in (
        "delete 0 another, which a slow browser still shows",
        "delete 7 point 1",
        "delete",
        "delete 0 point 1",
    ):
        assert not bench.sent
        bench.panel._act(word, None)  # type: ignore[arg-type]
    assert 'data-hs="delete 0 point 1"' in bench.panel._list.content
    assert bench.sent == [EditMeasure(kept, "")]
    bench.now = replace(bench.now, measures=())
    bench.panel.draw(bench.now, View())
    assert not bench.panel._list.content and not bench.panel._save.visible


def test_a_measure_without_a_name_is_refused_in_words(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(server)
    bench.panel.begin(POINT)
    bench.click(0.0, 0.0)
    bench.keep()
    browser = Browser(server, monkeypatch)
    bench.panel._act("rename 0 point 1", browser)  # type: ignore[arg-type]
    user_sets(browser.added["name"], " ")
    browser.clicks("Rename")
    assert bench.sent == [] and "The name is empty" in browser.told[0]
    user_sets(browser.added["name"], "door ")
    browser.clicks("Rename")
    assert bench.sent == [EditMeasure(bench.now.measures[0], "door")] and len(browser.told) == 1
