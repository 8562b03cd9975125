"""Loops in the scene: which arches are drawn, where, and which one a click selects."""

from dataclasses import replace

import numpy as np
import pytest

from app.server.protocol import InspectLoop, LoopsView
from app.slam.loops.types import Verdict
from app.ui.loops.words import KINDS
from tests.ui.conftest import SOMEONE, Wire
from tests.ui.loops.conftest import GOOD, Page


def test_rejected_loops_are_not_sent_until_asked_for(page: Page) -> None:
    assert page.node("/map/loops/accepted-in").points.shape == (12, 2, 3)
    assert page.node("/map/loops/candidate-out").points.shape == (6, 2, 3)
    assert page.node("/map/loops/rejected-out") is None
    page.loops._act("show rejected", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.node("/map/loops/rejected-out").points.shape == (40, 2, 3)
    page.loops._act("show rejected", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.node("/map/loops/rejected-out") is None


def test_an_arch_goes_from_keyframe_to_keyframe_over_a_knob_above_both(page: Page) -> None:
    legs, poses = page.node("/map/loops/accepted-in").points, page.engine.snapshot.keyframe_poses
    assert poses is not None
    first = page.engine.snapshot.loops.edges[0]
    accepted = min(e.pair for e in page.engine.snapshot.loops.edges if e.verdict is Verdict.ACCEPTED)
    assert first.pair <= accepted
    assert np.allclose(legs[0, 0], poses[accepted[0], :3, 3], atol=1e-5)
    assert np.allclose(legs[1, 1], poses[accepted[1], :3, 3], atol=1e-5)
    assert np.allclose(legs[0, 1], legs[1, 0])
    assert legs[0, 1, 2] > max(legs[0, 0, 2], legs[1, 1, 2]) + 0.5


def test_however_many_loops_there_are_a_few_nodes_draw_them(page: Page, wire: Wire) -> None:
    edges = page.engine.snapshot.loops.edges
    many = [replace(edges[k % len(edges)], older=k % 60, newer=70 + k // 60) for k in range(600)]
    page.loops._shown = frozenset(KINDS)
    wire.clear()
    page.engine.publish(loops=LoopsView(edges=tuple(sorted(many, key=lambda e: e.pair))))
    page.draw()
    sent = [name for name in wire.nodes("LineSegmentsMessage") if name.startswith("/map/loops/")]
    assert 3 <= len(sent) == len(set(sent)) <= 8
    assert sum(len(page.node(name).points) for name in sent) == 2 * 600


def test_loops_move_with_their_keyframes(page: Page) -> None:
    before = page.node("/map/loops/accepted-in").points.copy()
    poses = page.engine.snapshot.keyframe_poses.copy()
    poses[:, 1, 3] += 2.0
    page.engine.publish(keyframe_poses=poses)
    page.draw()
    assert np.allclose(page.node("/map/loops/accepted-in").points - before, [0, 2, 0], atol=1e-5)


def test_a_click_in_the_scene_chooses_the_loop_it_points_at(page: Page) -> None:
    poses = page.engine.snapshot.keyframe_poses
    assert poses is not None
    page.workbench._scene._root.position = np.array([5.0, -3.0, 0.5])  # as it is while the sensor is followed
    middle = poses[list(GOOD), :3, 3].mean(axis=0) + np.array([5.0, -3.0, 1.1])
    page.click_scene(middle + np.array([2.0, -6.0, 9.0]), middle)
    page.draw()
    assert page.loops.chosen == GOOD
    assert InspectLoop(GOOD) in page.engine.sent


def test_a_click_at_an_arch_is_not_taken_for_a_point_of_the_scan(page: Page) -> None:
    poses = page.engine.snapshot.keyframe_poses
    assert poses is not None
    middle = poses[list(GOOD), :3, 3].mean(axis=0) + np.array([0.0, 0.0, 1.1])
    for eye, target, meant in (
        (middle + np.array([2.0, -6.0, 9.0]), middle, False),
        (np.array([12.0, 7.0, 50.0]), np.array([12.0, 7.0, 0.0]), True),
    ):
        page.workbench._study._click = None
        page.click_scene(eye, target)
        assert (page.workbench._study._click is not None) is meant


def test_a_click_while_measuring_or_painting_is_neither_for_loops_nor_for_pins(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    monkeypatch.setattr(page.workbench._notes, "clicked", asked.append)
    middle = page.engine.snapshot.keyframe_poses[list(GOOD), :3, 3].mean(axis=0) + np.array([0.0, 0.0, 1.1])
    eye = middle + np.array([2.0, -6.0, 9.0])
    page.workbench._measure.begin("point")
    page.click_scene(eye, middle)
    assert page.workbench._measure._click is not None
    page.workbench._measure.begin("stop")
    page.workbench._brush.choose("ground")
    page.click_scene(eye, middle)
    assert page.loops.chosen is None and page.workbench._study._click is None and not asked
    page.workbench._brush.choose("off")
    page.click_scene(eye, middle)
    assert page.loops.chosen == GOOD and len(asked) == 1


def test_a_click_beside_all_loops_and_one_on_what_is_hidden_choose_nothing(page: Page) -> None:
    poses = page.engine.snapshot.keyframe_poses
    assert poses is not None
    page.click_scene(np.array([12.0, 7.0, 50.0]), np.array([12.0, 7.0, 0.0]))
    assert page.loops.chosen is None
    page.loops._shown = frozenset()
    page.draw()
    middle = poses[list(GOOD), :3, 3].mean(axis=0)
    page.click_scene(middle + np.array([0, 0, 5.0]), middle)
    assert page.loops.chosen is None
