"""Loops on the page: what is drawn, what is said, and which commands come of it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from app.server.folders import Folders
from app.server.protocol import InspectLoop, LoopsView, OverruleLoop, RedoLoop, Seek, TryLoop, UndoLoop
from app.slam import lie
from app.slam.loops import edits
from app.slam.loops.types import Accept, Add, Reject, SetWeight, Verdict
from app.ui.loops.inspector import CLOSE, SEEK
from app.ui.loops.kinds import Kind
from app.ui.loops.panel import LoopsPanel
from app.ui.workbench import Workbench
from tests.ui.conftest import SOMEONE, Clock, Wire, user_clicks, user_sets
from tests.ui.fake_loops import KEYFRAMES, LoopEngine

GOOD, WAITING = (12, 89), (34, 112)
OLDER, NEWER = "/map/submaps/older", "/map/submaps/newer"


class Page:
    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.clock = Clock()
        self.server = server
        self.engine = LoopEngine()
        self.workbench = Workbench(server, self.engine, Folders([folder]), now=self.clock)
        self.loops: LoopsPanel = self.workbench._loops
        self.draw()
        self.engine.sent.clear()

    def draw(self, seconds: float = 1.0) -> None:
        self.clock.now += seconds
        self.workbench.draw(self.engine.snapshot)

    def choose(self, pair: tuple[int, int] | None) -> None:
        self.loops.choose(pair)
        for _ in range(3):  # it is asked for, it is there, the map gives way
            self.draw()

    def node(self, name: str) -> Any:
        return self.server.scene._handle_from_node_name.get(name)

    def click_scene(self, origin: np.ndarray, towards: np.ndarray) -> None:
        event: Any = SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple(towards - origin))
        self.loops._clicked(event)

    def says(self, *html: str) -> bool:
        return all(part in self.loops._ledger.content for part in html)

    def edge(self, pair: tuple[int, int]) -> Any:
        return next(edge for edge in self.engine.snapshot.loops.edges if edge.pair == pair)


@pytest.fixture
def page(server: viser.ViserServer, tmp_path: Path) -> Page:
    return Page(server, tmp_path)


def rejected(page: Page) -> tuple[int, int]:
    edges = page.engine.snapshot.loops.edges
    return next(edge.pair for edge in edges if edge.verdict is Verdict.REJECTED and edge.evidence.overlap > 0)


# --- the scene -----------------------------------------------------------------------------------
def test_loops_that_were_turned_down_are_not_sent_until_asked_for(page: Page) -> None:
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
    page.loops._shown = frozenset(Kind)
    wire.clear()
    page.engine.publish(loops=LoopsView(edges=tuple(sorted(many, key=lambda e: e.pair))))
    page.draw()
    sent = [name for name in wire.nodes("LineSegmentsMessage") if name.startswith("/map/loops/")]
    assert 3 <= len(sent) == len(set(sent)) <= 8
    assert sum(len(page.node(name).points) for name in sent) == 2 * 600


def test_loops_move_with_their_keyframes(page: Page) -> None:
    before = page.node("/map/loops/accepted-in").points.copy()
    poses = page.engine.snapshot.keyframe_poses.copy()  # type: ignore[union-attr]
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
    assert page.engine.sent == [InspectLoop(GOOD)]


def test_a_click_at_an_arch_is_not_taken_for_a_point_of_the_scan(page: Page) -> None:
    poses = page.engine.snapshot.keyframe_poses
    assert poses is not None
    middle = poses[list(GOOD), :3, 3].mean(axis=0) + np.array([0.0, 0.0, 1.1])
    for eye, target, meant in (
        (middle + np.array([2.0, -6.0, 9.0]), middle, False),
        (np.array([12.0, 7.0, 50.0]), np.array([12.0, 7.0, 0.0]), True),
    ):
        page.workbench._study._clicked = None
        event: Any = SimpleNamespace(ray_origin=tuple(eye), ray_direction=tuple(target - eye))
        page.workbench._study._click(event)
        assert (page.workbench._study._clicked is not None) is meant


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


# --- the ledger ----------------------------------------------------------------------------------
def test_the_ledger_counts_and_lists_what_is_shown(page: Page) -> None:
    assert page.says("accepted 6", "candidate 3", "rejected 20", "by hand 0", "12–89")
    hidden = "–".join(str(index) for index in rejected(page))
    assert not page.says(hidden)
    page.loops._act("show rejected", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.says(hidden)


@pytest.mark.parametrize("column", ["overlap", "residual", "mahalanobis", "context"])
def test_a_column_s_head_sorts_by_it_and_again_the_other_way_with_what_is_unknown_last(page: Page, column: str) -> None:
    page.loops._shown = frozenset(Kind)
    value = {
        "overlap": lambda e: e.overlap,
        "residual": lambda e: e.residual_rms,
        "mahalanobis": lambda e: e.mahalanobis,
        "context": lambda e: e.context_distance,
    }[column]
    evidence = {edge.pair: edge.evidence for edge in page.engine.snapshot.loops.edges}
    for up in (True, False):
        page.loops._act(f"sort {column}", SOMEONE)  # type: ignore[arg-type]
        page.draw()
        content = page.loops._ledger.content
        words = [part.split('"')[0].split() for part in content.split('data-hs="choose ')[1:]]
        values = np.array([value(evidence[int(a), int(b)]) for a, b in words])
        known = values[np.isfinite(values)]
        assert len(values) == 29 and np.isnan(values[len(known) :]).all()
        assert (np.diff(known) >= 0).all() if up else (np.diff(known) <= 0).all()


def test_a_row_shows_its_loop_and_hides_it_again(page: Page) -> None:
    page.loops._act("choose 12 89", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.loops.chosen == GOOD and page.says('data-hs="choose 12 89" aria-selected="true"')
    page.loops._act("choose 12 89", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.loops.chosen is None
    assert page.engine.sent == [InspectLoop(GOOD), InspectLoop(None)]


def test_what_is_clicked_but_means_nothing_does_nothing(page: Page) -> None:
    page.choose(GOOD)
    page.engine.sent.clear()
    for word in ("", "show everything", "sort colour", "choose", "choose x y", "choose 1", "choose 0 1", "fly"):
        page.loops._act(word, SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.engine.sent == [] and page.loops.chosen == GOOD


def test_what_the_engine_says_is_text_and_never_html(page: Page) -> None:
    edge = replace(page.edge(GOOD), reason="<script>alert(1)</script>")
    page.engine.publish(loops=LoopsView(edges=(edge,)))
    page.choose(GOOD)
    assert "<script>" not in page.loops._ledger.content + page.loops._verdict._headline.content
    assert "&lt;script&gt;" in page.loops._verdict._headline.content


# --- one loop ------------------------------------------------------------------------------------
def in_map(page: Page, name: str) -> np.ndarray:
    node = page.node(name)
    R = Rotation.from_quat(np.asarray(node.wxyz)[[1, 2, 3, 0]]).as_matrix()
    return np.asarray(node.points, dtype=float) @ R.T + node.position


def test_the_submaps_lie_on_each_other_as_registered_and_apart_where_the_graph_had_them(page: Page) -> None:
    page.choose(GOOD)
    older = cKDTree(in_map(page, OLDER))
    fitted = np.median(older.query(in_map(page, NEWER))[0])
    user_sets(page.loops._inspector._laid, 0.0)
    page.draw()
    apart = np.median(older.query(in_map(page, NEWER))[0])
    assert fitted < 0.03 and apart > 3 * fitted


def test_the_older_submap_lies_where_the_map_has_its_keyframe(page: Page) -> None:
    page.choose(GOOD)
    engine = page.engine
    assert engine.snapshot.keyframe_poses is not None
    moved = engine.snapshot.keyframe_poses[GOOD[0]][:3, 3] - engine.truth[GOOD[0]][:3, 3]
    building = cKDTree(engine._points + moved)
    assert building.query(in_map(page, OLDER))[0].max() < 1e-3


def test_moving_the_slider_sends_a_pose_and_no_points(page: Page, wire: Wire) -> None:
    page.choose(GOOD)
    wire.clear()
    user_sets(page.loops._inspector._laid, 0.5)
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
    assert "84.0<small>cm</small>" in shown and "19<small>mm</small>" in shown and "61<small>%</small>" in shown
    slide = shown.split("slide</div>")[1].split("84.0")[0]
    overlap = shown.split("overlap</div>")[1].split("61")[0]
    assert "#ff6b6b" in slide and "#3ecf9a" in overlap
    assert "slides by 84 cm along the corridor" in page.loops._verdict._headline.content


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
    assert page.engine.sent[-1] == InspectLoop(None)


def test_a_page_with_a_chosen_loop_and_a_ghost_at_rest_sends_nothing(page: Page, wire: Wire) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    for _ in range(3):
        page.draw()
    wire.clear()
    page.draw()
    assert wire.messages == []


# --- overruling ----------------------------------------------------------------------------------
def test_a_rejected_loop_is_accepted_in_two_steps_with_a_ghost_between(page: Page) -> None:
    pair = rejected(page)
    page.choose(pair)
    page.engine.sent.clear()
    user_clicks(page.loops._verdict._accept)
    page.draw()
    assert page.engine.sent == [TryLoop(Accept(*pair))]
    tried = page.engine.snapshot.loops.tried
    assert tried is not None
    assert np.allclose(page.node("/map/ghost/path").points[:, 0], tried[1].poses[:-1, :3, 3], atol=1e-5)
    assert page.edge(pair).verdict is Verdict.REJECTED
    user_clicks(page.loops._proposal._commit)
    page.draw()
    assert page.engine.sent[1:3] == [OverruleLoop(Accept(*pair)), TryLoop(None)]
    assert page.edge(pair).verdict is Verdict.ACCEPTED
    assert page.node("/map/ghost/path") is None
    assert page.node("/map/loops/by-hand-in") is None  # it is the chosen one, drawn in white
    page.choose(None)
    assert page.node("/map/loops/by-hand-in").points.shape == (2, 2, 3)


def test_cancelling_leaves_all_as_it_was(page: Page) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    page.draw()
    page.loops._proposal.cancel()
    page.draw()
    assert not any(isinstance(command, OverruleLoop) for command in page.engine.sent)
    assert page.engine.sent[-1] == TryLoop(None)
    assert not page.loops._proposal._folder.visible and page.node("/map/ghost/path") is None


def test_before_a_decision_the_page_says_how_far_keyframes_move_and_which_factors_are_met_worst(page: Page) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    page.draw()
    now, tried = page.engine.snapshot, page.engine.snapshot.loops.tried
    assert tried is not None and now.keyframe_poses is not None
    moved = np.linalg.norm(tried[1].poses[:, :3, 3] - now.keyframe_poses[:, :3, 3], axis=1)
    words = page.loops._proposal._words.content
    assert f"{100 * moved.max():.1f} cm</b> (keyframe {moved.argmax()})" in words
    for residuals in (now.loops.residuals, tried[1].residuals):
        worst = max(residuals, key=lambda factor: factor.sigmas)
        assert f"loop {worst.pair[0]}–{worst.pair[1]}</td><td>{worst.sigmas:.2f}" in words


def test_nothing_can_be_committed_before_its_effect_is_known(page: Page) -> None:
    page.choose(GOOD)
    page.loops._proposal.command = Reject(*GOOD)  # asked, and the engine is still at it
    page.draw()
    assert page.loops._proposal._commit.disabled and "works out" in page.loops._proposal._words.content


def test_what_the_engine_refuses_is_told_where_it_was_asked(page: Page) -> None:
    page.loops._proposal.propose(Accept(0, 3))
    page.draw()
    assert "There is no loop candidate of keyframes 0 and 3" in page.loops._proposal._words.content
    assert page.loops._proposal._commit.disabled


def test_the_weight_is_tried_when_the_hand_rests(page: Page) -> None:
    page.choose(GOOD)
    page.engine.sent.clear()
    for weight in (2.0, 3.0, 4.0):
        user_sets(page.loops._verdict._weight, weight)
        page.draw(0.1)
    assert page.engine.sent == []
    page.draw(0.5)
    assert page.engine.sent == [TryLoop(SetWeight(*GOOD, 4.0))]
    user_clicks(page.loops._proposal._commit)
    page.draw()
    assert page.edge(GOOD).weight == 4.0 and page.loops._verdict._weight.value == 4.0


def test_choosing_another_loop_drops_what_was_being_considered(page: Page) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    page.draw()
    page.choose(WAITING)
    assert page.loops._proposal.command is None and TryLoop(None) in page.engine.sent


def test_undo_and_redo_say_what_they_would_do(page: Page) -> None:
    panel = page.loops._edits
    assert panel._undo.disabled and panel._redo.disabled and panel._save.disabled
    page.engine.send(OverruleLoop(Reject(*GOOD)))
    page.engine.send(OverruleLoop(Accept(*WAITING)))
    page.draw()
    assert panel._undo.label == "Undo: accept 34–112" and panel._redo.disabled
    user_clicks(panel._undo)
    page.draw()
    assert page.engine.sent[-1] == UndoLoop()
    assert panel._undo.label == "Undo: reject 12–89" and panel._redo.label == "Redo: accept 34–112"
    user_clicks(panel._redo)
    page.draw()
    assert page.engine.sent[-1] == RedoLoop() and panel._redo.disabled


def test_edits_are_saved_and_given_again(page: Page) -> None:
    commands = (Reject(*GOOD), Accept(*WAITING), Add(20, 97), SetWeight(20, 97, 0.5))
    for command in commands:
        page.engine.send(OverruleLoop(command))
    files: dict[str, bytes] = {}
    browser: Any = SimpleNamespace(send_file_download=lambda name, content, **_: files.update({name: content}))
    page.loops._edits._download(browser)
    assert edits.read(files["edits.yaml"].decode()) == commands
    page.engine.sent.clear()
    page.loops._edits._load(files["edits.yaml"], None)
    assert page.engine.sent == [OverruleLoop(command) for command in commands]


def test_a_file_that_can_not_be_used_changes_nothing_and_says_why(page: Page) -> None:
    told: list[str] = []
    browser: Any = SimpleNamespace(add_notification=lambda title, text, **_: told.append(text))
    page.loops._edits._load(b"- accept: [1, 2]\n- acept: [3, 4]\n", browser)
    assert page.engine.sent == [] and "entry 2" in told[0]


# --- tying by hand -------------------------------------------------------------------------------
def test_two_keyframes_are_picked_in_the_scene_and_tied_from_where_the_graph_has_them(page: Page) -> None:
    tie, poses = page.loops._tie, page.engine.snapshot.keyframe_poses
    assert poses is not None
    user_clicks(tie._pick)
    page.draw()
    assert len(page.node("/map/tie/keyframes").points) == KEYFRAMES
    for index in (140, 61):  # the newer one first
        page.click_scene(poses[index, :3, 3] + [0.4, -0.3, 6.0], poses[index, :3, 3])
        page.draw()
    assert tie.pair == (61, 140) and not tie.picking
    assert page.node("/map/tie/keyframes") is None
    user_clicks(tie._try)
    assert page.engine.sent == [TryLoop(Add(61, 140))]


def test_a_pair_that_makes_no_sense_is_not_sent(page: Page) -> None:
    tie = page.loops._tie
    for pair in ((5, 5), (9, 3), (3, KEYFRAMES)):
        tie.suggest_pair(pair)
        user_clicks(tie._try)
        assert tie._problem.visible
    assert page.engine.sent == []


def test_a_nudged_guess_is_tried_when_the_hand_rests_and_is_where_the_cloud_was_put(page: Page) -> None:
    tie, poses = page.loops._tie, page.engine.snapshot.keyframe_poses
    assert poses is not None
    tie.suggest_pair((20, 97))
    tie._nudge.value = True
    page.draw()
    page.draw()
    assert page.engine.sent == []  # it was only put there
    assert not page.node("/map/keyframes/3").visible
    gizmo = page.node("/map/tie/gizmo")
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
    tie, poses = page.loops._tie, page.engine.snapshot.keyframe_poses
    assert poses is not None
    tie.suggest_pair((20, 97))
    tie._nudge.value = True
    tie._register.value = False
    page.draw()
    tie.suggest()
    (command,) = [sent.command for sent in page.engine.sent if isinstance(sent, TryLoop)]
    assert isinstance(command, Add) and command.guess is not None and not command.register
    assert np.allclose(command.guess, lie.inverse(poses[20]) @ poses[97], atol=1e-6)


def test_a_loop_tied_by_hand_is_chosen_once_it_is_there(page: Page) -> None:
    page.loops._tie.suggest_pair((20, 97))
    page.loops._tie.suggest()
    page.draw()
    user_clicks(page.loops._proposal._commit)
    page.draw()
    page.draw()
    assert page.loops.chosen == (20, 97) and page.engine.sent[-1] == InspectLoop((20, 97))
    assert page.says("by hand 1")


def test_the_graph_s_worst_factors_are_listed_worst_first(page: Page) -> None:
    content = page.loops._factors.content
    shown = [float(row.split("</td><td>")[3].split("<")[0]) for row in content.split("<tr")[2:]]
    every = sorted((f.sigmas for f in page.engine.snapshot.loops.residuals), reverse=True)
    assert np.allclose(shown, every[: len(shown)], atol=0.006) and len(shown) >= 5
    assert f"{KEYFRAMES - 1} odometry and 6 loop factors" in content
