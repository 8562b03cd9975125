"""Adding a loop by hand: picking its keyframes, moving and trying its guess."""

import numpy as np
from scipy.spatial.transform import Rotation

from app.server.protocol import InspectLoop, TryLoop
from app.slam import lie
from app.slam.loops.edits import Add
from app.ui.loops.add_loop import _FIRST, _SECOND
from tests.ui.conftest import user_clicks
from tests.ui.fake_loops import KEYFRAMES
from tests.ui.loops.conftest import GOOD, Page


def test_two_keyframes_are_picked_in_the_scene_and_connected_from_where_the_graph_has_them(page: Page) -> None:
    added, poses = page.loops._add_loop, page.engine.snapshot.keyframe_poses
    assert poses is not None
    user_clicks(added._pick)
    page.draw()
    assert len(page.node("/map/add_loop/keyframes").points) == KEYFRAMES
    for index in (140, 61):  # the newer one first
        page.click_scene(poses[index, :3, 3] + [0.4, -0.3, 6.0], poses[index, :3, 3])
        page.draw()
    assert added.pair == (61, 140) and not added.picking
    assert page.node("/map/add_loop/keyframes") is None
    user_clicks(added._try)
    page.draw()
    assert page.engine.sent == [TryLoop(Add(61, 140))]


def test_a_picked_keyframe_that_is_gone_after_going_back_is_picked_anew(page: Page) -> None:
    added, poses = page.loops._add_loop, page.engine.snapshot.keyframe_poses
    user_clicks(added._pick)
    page.click_scene(poses[140, :3, 3] + [0.4, -0.3, 6.0], poses[140, :3, 3])
    page.draw()
    assert added._pick.label == _SECOND
    page.engine.publish(keyframe_poses=poses[:100])
    page.draw()
    assert added.picking and added._pick.label == _FIRST and len(page.node("/map/add_loop/keyframes").points) == 100


def test_picking_ends_with_the_session(page: Page) -> None:
    added, poses = page.loops._add_loop, page.engine.snapshot.keyframe_poses
    user_clicks(added._pick)
    page.click_scene(poses[61, :3, 3] + [0.4, -0.3, 6.0], poses[61, :3, 3])
    page.engine.publish(session=page.engine.snapshot.session + 1)
    page.draw()
    assert not added.picking and page.node("/map/add_loop/keyframes") is None


def test_a_pair_that_makes_no_sense_is_not_sent(page: Page) -> None:
    added = page.loops._add_loop
    for pair in ((5, 5), (9, 3), (3, KEYFRAMES)):
        added.suggest_pair(pair)
        user_clicks(added._try)
        assert added._problem.content
    assert page.engine.sent == []
    added.suggest_pair((3, 9))
    page.draw()
    assert not added._problem.content


def test_keyframes_that_cannot_be_nudged_are_refused_in_words(page: Page) -> None:
    added = page.loops._add_loop
    added.suggest_pair((9, 3))
    page.draw()
    assert not added._problem.content, "nothing is to be done with them yet"
    added._nudge.value = True
    page.draw()
    assert added._problem.content and not added.nudging
    added.suggest_pair((3, 9))
    page.draw()
    assert not added._problem.content and added.nudging


def test_a_nudged_guess_is_tried_when_the_hand_rests_and_is_where_the_cloud_was_put(page: Page) -> None:
    added, poses = page.loops._add_loop, page.engine.snapshot.keyframe_poses
    assert poses is not None
    added.suggest_pair((20, 97))
    added._nudge.value = True
    page.draw()
    page.draw()
    assert page.engine.sent == []  # it was only put there
    assert not page.node("/map/keyframes/3").visible
    gizmo = page.node("/map/add_loop/gizmo")
    assert np.allclose(gizmo.position, poses[97, :3, 3])
    turn = Rotation.from_euler("z", 0.3)
    x, y, z, w = turn.as_quat()
    gizmo.position, gizmo.wxyz = poses[97, :3, 3] + [0.5, 0.2, 0.0], (w, x, y, z)
    page.draw(0.1)
    assert page.engine.sent == []
    page.draw(0.5)
    page.draw(0.5)
    (command,) = [sent.command for sent in page.engine.sent if isinstance(sent, TryLoop)]
    assert isinstance(command, Add) and command.guess is not None
    nudged = poses[20] @ np.array(command.guess)  # where the guess puts the newer keyframe
    assert np.allclose(nudged[:3, 3], poses[97, :3, 3] + [0.5, 0.2, 0.0], atol=1e-6)
    assert np.allclose(nudged[:3, :3], turn.as_matrix() @ poses[97, :3, :3], atol=1e-6)


def test_an_untouched_gizmo_is_the_graph_s_own_guess(page: Page) -> None:
    added, poses = page.loops._add_loop, page.engine.snapshot.keyframe_poses
    assert poses is not None
    added.suggest_pair((20, 97))
    added._nudge.value = True
    added._register.value = False
    page.draw()
    added.suggest()
    page.draw()
    (command,) = [sent.command for sent in page.engine.sent if isinstance(sent, TryLoop)]
    assert isinstance(command, Add) and command.guess is not None and not command.register
    assert np.allclose(command.guess, lie.inverse(poses[20]) @ poses[97], atol=1e-6)


def test_a_loop_added_by_hand_is_chosen_once_it_arrives(page: Page) -> None:
    page.choose(GOOD)
    assert page.loops._evidence_folder.visible
    page.loops._add_loop.suggest_pair((20, 97))
    page.loops._add_loop.suggest()
    page.draw()
    assert not page.loops._evidence_folder.visible, "it is that of the chosen loop"
    user_clicks(page.loops._proposal._apply)
    page.draw()
    page.draw()
    assert page.loops.chosen == (20, 97) and InspectLoop((20, 97)) in page.engine.sent
    assert page.loops._evidence_folder.visible
    assert page.says("edited by you 1")
