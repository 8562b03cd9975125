"""A and B on one page: the differences in numbers, plots and the scene, and the commands sent.

Tests app/ui/compare_maths.py.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

from app.sensors.live.status import LiveState
from app.server.folders import Folders
from app.server.fork import Workspace
from app.server.protocol import Notice, Progress, Saved, Seek, SetParams, Snapshot, StepFrame
from app.slam.map_frame import MapFrame
from app.slam.types import GROUND, NON_GROUND, SEED, Cloud
from app.ui.compare_maths import (
    A_COLOUR,
    B_COLOUR,
    COLUMNS,
    Labelled,
    common_frames,
    difference,
    ground_difference,
    how,
    thinned,
    turn,
)
from app.ui.nodes import PATH_COLOUR
from app.ui.workbench import Workbench
from tests.ui.conftest import Clock, Wire, finish, user_clicks, user_sets
from tests.ui.fake_engine import FakeEngine
from tests.ui.fake_forks import DRIFT_M, TURN_DEG, workspace


# --- numbers -------------------------------------------------------------------------------------
def test_frames_are_those_of_the_same_moment_also_if_one_run_lost_some() -> None:
    stamps = 0.1 * np.arange(10)
    in_a, in_b = common_frames(stamps, stamps[:7])
    assert in_a.tolist() == in_b.tolist() == list(range(7))
    in_a, in_b = common_frames(np.delete(stamps, 3), np.delete(stamps, 6))
    np.testing.assert_array_equal(np.delete(stamps, 3)[in_a], np.delete(stamps, 6)[in_b])
    assert len(in_a) == 8


def test_an_angle_between_orientations_is_that_of_scipy() -> None:
    a, b = (Rotation.random(50, random_state=seed) for seed in (1, 2))
    vectors = a.as_rotvec(), b.as_rotvec()
    np.testing.assert_allclose(turn(*vectors), np.degrees((a.inv() * b).magnitude()), atol=1e-9)
    vectors[0][3] = np.nan
    assert np.flatnonzero(np.isnan(turn(*vectors))).tolist() == [3]


def test_a_run_that_is_levelled_since_it_has_ended_does_not_lie_apart_from_one_that_goes_on() -> None:
    """As B, forked where A went back to: the same poses, of which A's are turned about the map's origin."""
    stamps, walked = 0.1 * np.arange(50), np.random.default_rng(1).uniform(-30, 30, (50, 3))
    turns = {f"turn_{axis}": np.zeros(50) for axis in "xyz"}
    b = Snapshot(trajectory=walked, series={"stamp_s": stamps, "total_ms": stamps, "error_m": stamps, **turns})
    level = MapFrame.levelling(np.array([0.05, -0.03, -9.8]))
    a = replace(b, trajectory=walked @ level.newest[:3, :3].T, adjustment=level)
    assert np.linalg.norm(a.trajectory - b.trajectory, axis=1).max() > 0.1
    assert difference(a, b, since=20).position_m == pytest.approx(np.zeros(30), abs=1e-9)


def cloud(labels: list[int], offsets: list[int]) -> Cloud:
    n = len(labels)
    return Cloud(
        np.zeros((n, 3), np.float32), np.array(labels, np.uint8), np.zeros(n, np.float32), np.zeros(n, np.uint16),
        np.array(offsets, np.int32),
    )  # fmt: skip


def test_a_seed_is_ground_and_points_are_found_by_their_moment() -> None:
    a = cloud([NON_GROUND, GROUND, GROUND, NON_GROUND], [0, 1, 2, 3])
    b = cloud([NON_GROUND, SEED, NON_GROUND, SEED], [0, 1, 2, 3])
    expected = [Labelled.NEITHER, Labelled.BOTH, Labelled.ONLY_A, Labelled.ONLY_B]
    assert ground_difference(a, b).tolist() == expected
    nearer = cloud([SEED, NON_GROUND, SEED], [3, 2, 1])
    assert ground_difference(a, nearer).tolist() == [Labelled.ALONE, *expected[1:]]


def test_a_spike_stays_however_long_the_walk_and_what_is_unknown_is_left_out() -> None:
    values = np.zeros(10_000)
    values[7_777] = 5.0
    values[:100] = np.nan
    stamps, drawn = thinned(np.arange(10_000.0), values)
    assert len(stamps) == len(drawn) == COLUMNS and drawn.max() == 5.0 and stamps[0] == 100.0
    assert all(len(column) == 1 for column in thinned(np.empty(0), np.empty(0)))


# --- the page ------------------------------------------------------------------------------------
class Page:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine, folder: Path) -> None:
        self.clock, self.engine = Clock(), engine
        self.forks: Workspace = workspace(engine, folder)
        self.workbench = Workbench(server, self.forks, Folders([folder]), now=self.clock)
        self.panel, self.sides = self.workbench._compare, self.workbench._sides

    def draw(self, seconds: float = 1.0) -> None:
        self.clock.now += seconds
        self.workbench.draw(self.forks.snapshot)

    def both_at(self, frame: int) -> None:
        eventually(lambda: (b := self.forks.other) is not None and b.transport.frame == frame)
        self.draw()
        self.draw()

    @property
    def b(self) -> FakeEngine:
        side = self.forks._sides[1]
        assert side is not None
        return side.engine  # type: ignore[return-value]


def eventually(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Somebody:
    """A browser that reads."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def add_notification(self, title: str, text: str, **_: object) -> None:
        self.told.append(text)


def chooses(handle: object, value: str) -> Somebody:
    somebody = Somebody()
    handle._impl.value = value  # type: ignore[attr-defined]
    for callback in handle._impl.update_cb:  # type: ignore[attr-defined]
        finish(callback(viser.GuiEvent(client=somebody, client_id=0, target=handle)))  # type: ignore[arg-type]
    return somebody


@pytest.fixture
def page(server: viser.ViserServer, engine: FakeEngine, tmp_path: Path) -> Iterator[Page]:
    engine.send(Seek(20))
    page = Page(server, engine, tmp_path)
    page.draw()
    yield page
    if page.forks.other is not None:
        page.forks.discard()


SCAN, PATH = "/map/compare_lidar/scan", "/map/compare_path/0"


def test_without_a_fork_the_page_says_what_one_is_for(page: Page, wire: Wire) -> None:
    assert "Fork here" in page.panel._status.content and page.panel._fork.visible
    assert not page.panel._what.visible and not page.sides._choice.visible
    assert not any(titled.visible for titled, _ in page.panel._plots)
    page.draw()
    wire.clear()
    page.draw()
    assert wire.messages == []


def test_a_live_source_cannot_be_forked_and_the_page_says_what_to_do(page: Page, engine: FakeEngine) -> None:
    engine.publish(live=LiveState())
    page.draw()
    assert page.panel._fork.disabled and page.panel._open.disabled
    assert "fork its recording" in page.panel._status.content
    engine.publish(live=None)
    page.draw()
    assert not page.panel._fork.disabled and not page.panel._open.disabled


def test_a_fork_is_asked_for_and_what_is_set_next_is_set_in_it(page: Page) -> None:
    user_sets(page.panel._name, "wide <b>")
    user_clicks(page.panel._fork)
    page.both_at(20)
    assert page.panel._what.visible and not page.panel._fork.visible and page.sides._choice.value == "B"
    assert "B · wide &lt;b&gt;" in page.panel._status.content and "forked at frame 20" in page.panel._status.content
    user_sets(page.workbench._parameters._widgets["ground.alpha"][0].handle, 33.0)
    assert page.b.sent[-1] == SetParams({"ground.alpha": 33.0})
    assert not any(isinstance(command, SetParams) for command in page.engine.sent)
    page.draw(5.0)
    control = page.workbench._parameters._widgets["ground.alpha"][0].handle
    assert control.value == 33.0
    user_sets(page.sides._choice, "A")
    page.draw(5.0)
    assert control.value == page.engine.snapshot.params.ground.alpha != 33.0
    user_sets(control, 44.0)
    assert page.engine.sent[-1] == SetParams({"ground.alpha": 44.0})


def test_a_value_typed_for_b_is_never_sent_to_a(page: Page) -> None:
    page.forks.fork("")
    page.both_at(20)
    user_sets(page.sides._choice, "B")
    page.draw()
    user_sets(page.workbench._parameters._widgets["map.spacing"][0].handle, 0.33)
    page.forks.discard()
    page.workbench._parameters._now = lambda: time.monotonic() + 10
    page.draw()
    page.draw()
    assert not any(isinstance(command, SetParams) for command in page.engine.sent)


def test_the_drift_and_the_turn_are_reported_and_plotted_over_time(page: Page) -> None:
    page.forks.fork("")
    page.engine.send(Seek(60))
    page.both_at(60)
    page.draw()
    told = page.panel._numbers.content
    assert f"{100 * DRIFT_M * 40:.1f}<small>cm" in told and f"{TURN_DEG:.2f}<small>°" in told
    (apart, turned, took, wrong) = (chart.data for _, chart in page.panel._plots)
    assert len(apart) == 2 and len(took) == len(wrong) == 3
    np.testing.assert_allclose(apart[0], 0.1 * np.arange(20, 61), atol=1e-9)
    np.testing.assert_allclose(apart[1], 100 * DRIFT_M * np.arange(41), atol=1e-9)
    np.testing.assert_allclose(turned[1], [0.0] + [TURN_DEG] * 40, atol=1e-6)
    assert all(titled.visible for titled, _ in page.panel._plots)


def test_b_s_trajectory_is_blue_from_the_fork_on(page: Page, wire: Wire, server: viser.ViserServer) -> None:
    page.forks.fork("")
    wire.clear()
    page.engine.send(Seek(30))
    page.both_at(30)
    assert PATH in wire.nodes("LineSegmentsMessage")
    node = server.scene._handle_from_node_name[PATH]
    assert node.points.shape == (10, 2, 3) and A_COLOUR == PATH_COLOUR != B_COLOUR
    assert np.unique(node.colors.reshape(-1, 3), axis=0).tolist() == [list(B_COLOUR)]
    page.forks.discard()
    page.draw()
    assert PATH not in server.scene._handle_from_node_name


def test_the_scan_shows_who_calls_a_point_ground(page: Page, server: viser.ViserServer) -> None:
    nodes = server.scene._handle_from_node_name
    page.forks.fork("", {"ground.sigma": 0.15})
    page.both_at(20)
    a, b = page.forks.snapshot.result, page.forks.other.result  # type: ignore[union-attr]
    assert a is not None and b is not None
    more = int(np.count_nonzero((a.cloud.labels == NON_GROUND) & (b.cloud.labels != NON_GROUND)))
    assert more > 0
    blue = (nodes[SCAN].colors == B_COLOUR).all(axis=1)
    assert nodes["/map/compare_lidar"].visible and not nodes["/map/sensor/lidar/scan"].visible
    assert int(np.count_nonzero(blue)) == more and f">{more:,}<" in page.panel._numbers.content
    user_sets(page.panel._by_ground, False)
    page.draw()
    assert not nodes["/map/compare_lidar"].visible and nodes["/map/sensor/lidar/scan"].visible


def test_whose_ground_it_is_is_shown_though_the_scene_is_drawn_after_the_panel(page: Page) -> None:
    page.forks.fork("", {"ground.sigma": 0.15})
    eventually(lambda: (b := page.forks.other) is not None and b.transport.frame == 20)
    page.panel._scene_changes._at = page.clock.now + 1.0  # the scene was drawn just now, without B
    page.draw()
    assert page.panel._numbers.content and "only in A" not in page.panel._numbers.content
    page.draw()
    assert "only in A" in page.panel._numbers.content


def test_while_b_lags_the_newest_frame_that_both_have_is_shown(page: Page, server: viser.ViserServer) -> None:
    page.forks.fork("")
    page.both_at(20)
    page.forks._ended.set()  # B is led no more
    for _ in range(3):
        page.engine.send(StepFrame(1))
        page.draw()
    assert "3 frames behind" in page.panel._status.content
    assert page.panel._pair is not None and page.panel._pair[0].index == 20
    for _ in range(20):
        page.engine.send(StepFrame(1))
        page.draw()
    assert page.panel._pair is None
    assert server.scene._handle_from_node_name["/map/sensor/lidar/scan"].visible


def test_swapped_b_is_drawn_whole_and_a_follows(page: Page) -> None:
    user_sets(page.panel._name, "wide")
    page.forks.fork("wide", {"ground.sigma": 0.15})
    page.engine.send(Seek(40))
    page.both_at(40)
    chooses(page.panel._what, "swap")
    page.draw()
    page.draw()
    assert "A · wide" in page.panel._status.content and "B · main" in page.panel._status.content
    (block,) = page.workbench._scene._trajectory._blocks
    path = np.concatenate((block.points[:1, 0], block.points[:, 1]))
    np.testing.assert_allclose(path, page.forks.snapshot.trajectory, rtol=0, atol=1e-3)
    page.forks.send(StepFrame(1))
    eventually(lambda: page.engine.snapshot.transport.frame == 41)
    assert "hall_bpearl-main.hemislam" in chooses(page.panel._what, "keep").told[0]


def test_keep_says_where_the_file_is_and_errors_are_shown(page: Page, tmp_path: Path) -> None:
    page.forks.fork("wide")
    page.both_at(20)
    told = chooses(page.panel._what, "keep").told
    assert str(tmp_path / "hall_bpearl-wide.hemislam") in told[0] and (tmp_path / "hall_bpearl-wide.hemislam").exists()
    page.draw()
    assert page.panel._fork.visible and page.sides._choice.visible is False
    assert "no fork" in chooses(page.panel._what, "discard").told[0]
    user_sets(page.workbench._parameters._widgets["ground.alpha"][0].handle, 31.0)
    assert page.engine.sent[-1] == SetParams({"ground.alpha": 31.0}), "without a fork all is A's"


def test_what_is_opened_as_b_is_not_called_a_fork(page: Page, tmp_path: Path) -> None:
    page.forks.fork("wide")
    page.both_at(20)
    page.forks.open(page.forks.keep())
    page.both_at(20)
    assert "opened side by side" in page.panel._status.content and "forked at" not in page.panel._status.content


def test_a_fork_made_elsewhere_is_kept_under_its_own_name_not_that_of_the_last(page: Page, tmp_path: Path) -> None:
    page.forks.fork("wide")
    page.both_at(20)
    assert chooses(page.panel._what, "swap").told == [] and page.forks.names == ("wide", "main")
    page.draw()
    assert page.panel._name.value == "main"
    chooses(page.panel._what, "keep")
    page.draw()
    assert page.panel._name.value == "", "the name is no longer that of B"
    page.forks.fork("trial 6")
    page.both_at(20)
    assert page.panel._name.value == "trial 6"
    chooses(page.panel._what, "keep")
    assert (tmp_path / "hall_bpearl-trial-6.hemislam").exists()


def test_the_page_says_how_b_is_doing(page: Page) -> None:
    a = page.engine.snapshot
    recording = a.recording
    assert recording is not None and how(a, a) == ("", "")
    assert "is not affected" in how(a, replace(a, engine_alive=False))[0]
    assert how(a, replace(a, progress=Progress("Going to frame 20", 0.5)))[0] == "Going to frame 20 · 50 %"
    assert "starting" in how(a, replace(a, recording=None))[0]
    assert "another recording" in how(replace(a, recording=replace(recording, path=Path("/x.mcap"))), a)[0]
    broken = replace(a, notices=(Notice(1, "error", "it broke"), Notice(2, "error", "disk full")))
    assert "disk full" in how(a, broken)[0]
    assert how(a, replace(broken, saved=(Saved(Path("out"), "disk full"),)))[0] == "B: it broke"
    ended = replace(a, transport=replace(a.transport, frame=5, finished=True))
    assert how(a, ended)[0] == "B is 15 frames behind, where its part of the recording ends."


def test_a_page_with_a_fork_at_rest_sends_nothing(page: Page, wire: Wire) -> None:
    page.forks.fork("")
    page.both_at(20)
    for _ in range(4):
        page.draw()
    wire.clear()
    page.draw()
    assert wire.messages == []
