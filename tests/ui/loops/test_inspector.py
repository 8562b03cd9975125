"""Everything about one loop: its submaps in the scene, its numbers, its frame."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from app.server.protocol import InspectLoop, Seek, TryLoop
from app.ui.html import panel
from app.ui.loops.inspector import CLOSE, SEEK
from tests.ui.conftest import SOMEONE, Wire, user_clicks, user_sets
from tests.ui.loops.conftest import GOOD, NEWER, OLDER, Page


def in_map(page: Page, name: str) -> np.ndarray:
    node = page.node(name)
    R = Rotation.from_quat(np.asarray(node.wxyz)[[1, 2, 3, 0]]).as_matrix()
    return np.asarray(node.points, dtype=float) @ R.T + node.position


def test_the_submaps_lie_on_each_other_as_registered_and_apart_where_the_graph_had_them(page: Page) -> None:
    page.choose(GOOD)
    older = cKDTree(in_map(page, OLDER))
    fitted = np.median(older.query(in_map(page, NEWER))[0])
    user_sets(page.loops._inspector._share, 0.0)
    page.draw()
    apart = np.median(older.query(in_map(page, NEWER))[0])
    assert fitted < 0.03 and apart > 3 * fitted


def test_the_older_submap_lies_where_the_map_has_its_keyframe(page: Page) -> None:
    page.choose(GOOD)
    engine = page.engine
    moved = engine.snapshot.keyframe_poses[GOOD[0]][:3, 3] - engine.truth[GOOD[0]][:3, 3]
    building = cKDTree(engine._points + moved)
    assert building.query(in_map(page, OLDER))[0].max() < 1e-3


def test_moving_the_slider_sends_a_pose_and_no_points(page: Page, wire: Wire) -> None:
    page.choose(GOOD)
    wire.clear()
    user_sets(page.loops._inspector._share, 0.5)
    page.draw(0.01)
    assert wire.nodes("PointCloudMessage") == []
    assert NEWER in wire.nodes("SetPositionMessage")


def test_the_map_gives_way_to_the_two_submaps_unless_told_to_stay(page: Page) -> None:
    assert page.node("/map/keyframes/3").visible
    page.choose(GOOD)
    assert not page.node("/map/keyframes/3").visible
    user_sets(page.loops._inspector._alone, False)
    page.draw()
    assert page.node("/map/keyframes/3").visible
    page.loops._go(CLOSE, SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.node(OLDER) is None and page.node(NEWER) is None


def test_numbers_have_units_and_are_red_beyond_their_limits(page: Page) -> None:
    pair = next(e.pair for e in page.engine.snapshot.loops.edges if e.evidence.slide > 0.5)
    page.choose(pair)
    shown = page.loops._inspector._evidence.content
    assert "840<small>mm</small>" in shown and "19<small>mm</small>" in shown and "61<small>%</small>" in shown
    slide = shown.split("slide</div>")[1].split("840")[0]
    overlap = shown.split("overlap</div>")[1].split("61")[0]
    assert "--hs-bad" in slide and "--hs-good" in overlap
    assert "slides by 84 cm along the corridor" in page.loops._verdict._reason.content


def test_the_loop_s_frame_is_that_at_which_it_was_decided(page: Page) -> None:
    page.choose(GOOD)
    page.loops._go(SEEK, SOMEONE)  # type: ignore[arg-type]
    assert page.engine.sent[-1] == Seek(6 * (GOOD[1] + 8))


def test_a_loop_that_is_gone_after_going_back_is_no_longer_chosen(page: Page) -> None:
    page.choose(GOOD)
    left = tuple(edge for edge in page.engine.snapshot.loops.edges if edge.pair != GOOD)
    page.engine.publish(loops=replace(page.engine.snapshot.loops, edges=left))
    page.draw()
    assert page.loops.chosen is None and page.node(OLDER) is None
    assert InspectLoop(None) in page.engine.sent and page.engine.sent[-1] == TryLoop(None)


def test_a_page_with_a_chosen_loop_and_a_ghost_at_rest_sends_nothing(page: Page, wire: Wire) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    for _ in range(3):
        page.draw()
    wire.clear()
    page.draw()
    assert wire.messages == []


def test_a_loop_that_another_is_in_the_graph_for_says_which(page: Page) -> None:
    edge = next(edge for edge in page.engine.snapshot.loops.edges if edge.counts)
    other = replace(edge, represented_by=(12, 340))
    assert "corrects the map" not in panel("loops.reason", edge, (0, 0, 0))
    assert "the nearby loop 12–340 corrects the map for both" in panel("loops.reason", other, (0, 0, 0))


def test_the_legend_names_the_loops_and_the_two_submaps(page: Page) -> None:
    page.draw()
    names = [name for _, name in page.loops.keys(page.engine.snapshot, light=False)]
    assert names == ["accepted loop", "candidate loop"], "rejected ones are hidden at first"
    page.choose(GOOD)
    page.draw()
    assert [name for _, name in page.loops.keys(page.engine.snapshot, light=False)][:3] == [
        "keyframe 12",
        "keyframe 89",
        "chosen loop 12–89",
    ]
