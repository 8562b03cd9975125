"""A studied frame: its colours, the point that a click selects, and the values shown for it.

Tests app/ui/study_maths.py.
"""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from app.server.protocol import Seek, SetParams, StepFrame
from app.slam.params import Params
from app.slam.study import vertices
from app.slam.types import Matches, StepResult
from app.ui.colours import NOTHING
from app.ui.study import StudyPanel
from app.ui.study_maths import (
    AS_MAP,
    HEADROOM,
    MOST_POINTS,
    RESIDUAL,
    STUDY_MODES,
    curve,
    describe,
    nearest_to_ray,
    pick,
    study_colours,
    study_legend,
)
from app.ui.widgets import View
from tests.ui.conftest import SOMEONE, Clock, Wire, page_of, user_sets
from tests.ui.fake_engine import HEIGHT, FakeEngine

ENGINE = FakeEngine(columns=40)
FRAME = ENGINE.result(20, Params())
SIGMA = Params().ground.sigma


def with_matches(result: StepResult) -> StepResult:
    """Every 10th point was looked up: five found nothing, the next three were too far off, the rest lie 2 cm off."""
    points = result.cloud.points[::10]
    residuals = np.full(len(points), -0.02, np.float32)
    residuals[:8] = np.nan
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    normals[:5] = 0
    matches = Matches(points, residuals, normals, points.copy())
    return replace(result, registration=replace(result.registration, matches=matches))


MATCHED = with_matches(FRAME)


# --- colours -------------------------------------------------------------------------------------
def test_numbers_are_in_the_unit_of_the_legend() -> None:
    ring = STUDY_MODES["ring"].values(FRAME)
    assert ring.min() == 0 and ring.max() == 31
    down = FRAME.ground.down
    lowest = int(np.argmax(FRAME.cloud.points @ down / np.linalg.norm(FRAME.cloud.points, axis=1)))
    assert np.argmin(STUDY_MODES["angle to down"].values(FRAME)) == lowest
    floor = FRAME.cloud.labels > 0
    assert np.median(STUDY_MODES["distance to plane"].values(FRAME)[floor]) < 5  # cm: the corridor's floor is flat
    assert np.nanmax(STUDY_MODES[RESIDUAL].values(MATCHED)) == pytest.approx(20.0)
    for by, unit in (("angle to down", "°"), ("distance to plane", "cm"), (RESIDUAL, "mm")):
        assert unit in study_legend(FRAME, by)


@pytest.mark.parametrize("by", STUDY_MODES)
def test_every_point_shown_has_a_colour(by: str) -> None:
    colours = study_colours(MATCHED, by)
    assert colours.shape == (len(STUDY_MODES[by].points(MATCHED)), 3)
    assert len(np.unique(colours, axis=0)) > 1


def test_points_without_a_plane_are_grey() -> None:
    colours = study_colours(MATCHED, RESIDUAL)
    assert (colours[:8] == NOTHING).all() and (colours[8:] != NOTHING).any(axis=1).all()


def test_before_the_map_there_are_no_residuals_to_show() -> None:
    assert len(STUDY_MODES[RESIDUAL].points(FRAME)) == 0 == len(study_colours(FRAME, RESIDUAL))


# --- the threshold -------------------------------------------------------------------------------
def test_the_curve_sorts_points_as_the_labels_do() -> None:
    drawn = curve(FRAME, SIGMA)
    ground = int(np.count_nonzero(FRAME.cloud.labels))
    assert drawn.points_under == ground and drawn.points_under + drawn.points_over == len(FRAME.cloud)
    assert len(drawn.range) <= MOST_POINTS + 2 and (np.diff(drawn.range) >= 0).all()
    np.testing.assert_allclose(drawn.threshold, 100 * SIGMA * drawn.range)
    assert (drawn.under[np.isfinite(drawn.under)] < drawn.threshold[np.isfinite(drawn.under)]).all()
    over = np.isfinite(drawn.over)
    assert (drawn.over[over] >= drawn.threshold[over]).all()
    assert (drawn.over[over] < HEADROOM * drawn.threshold[-1]).all()
    assert not (np.isfinite(drawn.under) & over).any()


def test_without_a_plane_the_curve_has_no_points() -> None:
    blind = replace(FRAME, ground=replace(FRAME.ground, centroid=np.full(3, np.nan)))
    drawn = curve(blind, SIGMA)
    assert drawn.points_under == drawn.points_over == 0 and len(drawn.threshold) == len(drawn.under)


# --- a point -------------------------------------------------------------------------------------
@given(st.integers(0, len(FRAME.cloud) - 1), st.floats(0.5, 20.0))
def test_a_click_on_a_point_means_it_or_one_before_it(index: int, back: float) -> None:
    points = FRAME.cloud.points.astype(float)
    camera = np.array([-1.0, 0.4, 0.0]) - back * np.array([0.1, 0.0, 1.0])
    found = nearest_to_ray(FRAME.cloud.points, camera, points[index] - camera)
    assert found is not None
    ray = (points[index] - camera) / np.linalg.norm(points[index] - camera)
    towards = points[found] - camera
    assert towards @ ray <= np.linalg.norm(points[index] - camera) + 1e-3
    assert np.degrees(np.arccos(min(towards @ ray / np.linalg.norm(towards), 1.0))) < 0.4


def test_a_click_into_the_void_or_at_what_is_behind_means_nothing() -> None:
    points = np.array([[0, 0, 5], [0, 0, -5]], np.float32)
    assert nearest_to_ray(points, np.zeros(3), np.array([1.0, 0, 0])) is None
    assert nearest_to_ray(points, np.zeros(3), np.array([0, 0.001, 1.0])) == 0
    assert nearest_to_ray(np.empty((0, 3), np.float32), np.zeros(3), np.ones(3)) is None


def test_a_point_of_the_floor_shows_its_numbers() -> None:
    index = int(np.flatnonzero(FRAME.cloud.labels > 0)[100])
    picked = pick(FRAME, index, SIGMA, 12)
    assert picked.threshold == pytest.approx(SIGMA * picked.range)
    assert abs(picked.distance) < picked.threshold
    assert picked.range * np.cos(picked.angle) == pytest.approx(HEIGHT, abs=0.15)
    text = describe(FRAME, picked)
    for part in ("angle to down", "°", "threshold", "cm", "12 points within", "mm", "none"):
        assert part in text


def test_the_map_s_plane_is_that_of_the_nearest_point_looked_up() -> None:
    assert "no plane in the map" in describe(MATCHED, pick(MATCHED, 0, SIGMA, 8))
    assert "not used" in describe(MATCHED, pick(MATCHED, 60, SIGMA, 8))
    assert "-20.0" in describe(MATCHED, pick(MATCHED, 200, SIGMA, 8))


def test_a_file_says_of_a_point_what_the_panel_does() -> None:
    table = vertices(MATCHED)
    for index in range(0, len(table), 37):
        picked, row = pick(MATCHED, index, SIGMA, 8), table[index]
        assert row["distance"] == pytest.approx(picked.distance, abs=1e-6, nan_ok=True)
        assert row["angle"] == pytest.approx(np.degrees(picked.angle), abs=1e-4)
        residuals = MATCHED.registration.matches.residuals  # type: ignore[union-attr]
        residual = residuals[picked.match] if picked.match >= 0 else np.nan
        assert row["residual"] == pytest.approx(residual, nan_ok=True)
        assert row["residual_away"] == pytest.approx(picked.away, nan_ok=True)
    assert np.isfinite(table["residual"]).any() and np.isnan(table["residual"]).any()


# --- the panel -----------------------------------------------------------------------------------
CLOUD = "/map/study/cloud"


class Bench:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.clock, self.engine, self.server = Clock(), engine, server
        self.offset = np.array([5.0, -2.0, 1.0])
        server.scene.add_frame("/map", position=self.offset)
        self.panel = StudyPanel(
            page_of(server, snapshot=lambda: engine.snapshot, now=self.clock, offset=lambda: self.offset)
        )

    def draw(self, seconds: float = 1.0) -> None:
        self.clock.now += seconds
        self.panel.draw(self.engine.snapshot, View())

    def click(self, index: int) -> None:
        """As if somebody clicked on a point of the newest frame, from 3 m above the sensor."""
        result = self.engine.snapshot.result
        assert result is not None
        T = result.T_map_imu @ result.state.T_imu_lidar
        point = T[:3, :3] @ result.cloud.points[index] + T[:3, 3] + self.offset
        camera = T[:3, 3] + self.offset + [0, 0, 1.0]
        event: Any = viser.SceneClickEvent(SOMEONE, 0, tuple(camera), tuple(point - camera), (0.5, 0.5), None)  # type: ignore[arg-type]
        self.panel.clicked(event)

    @property
    def nodes(self) -> set[str]:
        return {name for name in self.server.scene._handle_from_node_name if name.startswith("/map/study/")}


@pytest.fixture
def bench(server: viser.ViserServer, engine: FakeEngine) -> Bench:
    engine.send(StepFrame(8))
    bench = Bench(server, engine)
    bench.draw()
    return bench


def test_the_frame_is_drawn_in_place_of_the_scan_while_it_has_colours_of_its_own(bench: Bench) -> None:
    assert bench.nodes == set() and bench.panel.seen(View()) == View()
    user_sets(bench.panel._by, "angle to down")
    bench.draw()
    assert bench.nodes == {CLOUD}
    assert bench.panel.seen(View()) == View(scan=False)
    user_sets(bench.panel._alone, True)
    assert bench.panel.seen(View()) == View(scan=False, map=False)
    user_sets(bench.panel._by, AS_MAP)
    bench.draw()
    assert bench.nodes == set()


def test_a_clicked_point_is_marked_and_reported_until_another_frame_comes(bench: Bench) -> None:
    bench.click(300)
    bench.draw()
    assert bench.panel._picked is not None and "ring" in bench.panel._point.content
    assert {"/map/study/point", "/map/study/neighbours", "/map/study/patch"} <= bench.nodes
    bench.engine.send(SetParams({"ground.sigma": 0.2}))
    bench.engine.publish(result=pickle.loads(pickle.dumps(bench.engine.snapshot.result)))  # as from another process
    bench.draw()
    assert bench.panel._picked.threshold == pytest.approx(0.2 * bench.panel._picked.range)
    bench.engine.send(Seek(3))
    bench.draw()
    assert bench.panel._picked is None and bench.nodes == set()
    assert "click a point" in bench.panel._point.content


def test_more_neighbours_are_marked_at_once(bench: Bench) -> None:
    bench.click(300)
    bench.draw()
    user_sets(bench.panel._neighbours, 40)
    bench.draw()
    assert "40 points within" in bench.panel._point.content


def test_clicks_while_playing_mean_nothing(bench: Bench) -> None:
    bench.engine.publish(transport=replace(bench.engine.snapshot.transport, playing=True))
    bench.click(300)
    bench.draw()
    assert bench.panel._picked is None


def test_the_curve_waits_for_a_pause(bench: Bench) -> None:
    before = bench.panel._plot.data[0]
    bench.engine.send(StepFrame(1))
    bench.engine.publish(transport=replace(bench.engine.snapshot.transport, playing=True))
    bench.draw()
    assert bench.panel._plot.data[0] is before
    bench.engine.publish(transport=replace(bench.engine.snapshot.transport, playing=False))
    bench.draw()
    assert bench.panel._plot.data[0] is not before


def test_at_rest_nothing_is_sent(bench: Bench, wire: Wire) -> None:
    user_sets(bench.panel._by, "distance to plane")
    bench.click(300)
    bench.draw()
    wire.clear()
    bench.draw()
    assert wire.messages == []


def test_a_frame_is_downloaded_by_who_asked(bench: Bench) -> None:
    class Browser:
        def __init__(self) -> None:
            self.files: list[tuple[str, bytes]] = []

        def send_file_download(self, name: str, content: bytes, **_: object) -> None:
            self.files.append((name, content))

    browser = Browser()
    for kind in ("PLY", "PCD"):
        bench.panel._download(kind, browser)  # type: ignore[arg-type]
    (ply, first), (pcd, second) = browser.files
    assert (ply, pcd) == ("hall_bpearl-frame-000007.ply", "hall_bpearl-frame-000007.pcd")
    assert first.startswith(b"ply\n") and second.startswith(b"# .PCD v0.7 - hemislam frame 7")
