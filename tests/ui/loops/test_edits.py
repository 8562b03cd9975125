"""Loop edits: proposed, shown as a ghost, applied, undone, saved and loaded again."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.server.protocol import EditLoop, RedoLoop, TryLoop, UndoLoop
from app.slam.errors import HemislamError
from app.slam.loops import edit_files
from app.slam.loops.edits import Accept, Add, Reject, SetWeight
from app.slam.loops.types import Verdict
from app.ui.loops.edits import enlarged
from tests.ui.conftest import BusyThreads, browser_sends, user_clicks, user_sets
from tests.ui.loops.conftest import GOOD, OLDER, WAITING, Page, rejected


def shift(page: Page, poses: np.ndarray) -> float:
    """m, by which the keyframe that differs most does."""
    present = page.engine.snapshot.keyframe_poses
    assert present is not None
    return float(np.linalg.norm(poses[:, :3, 3] - present[:, :3, 3], axis=1).max())


def test_a_chosen_loop_shows_what_the_other_verdict_would_move(page: Page) -> None:
    page.choose(GOOD)
    now, tried = page.engine.snapshot, page.engine.snapshot.loops.tried
    assert tried is not None and tried[0] == Reject(*GOOD)
    moved = np.linalg.norm(tried[1].poses[:, :3, 3] - now.keyframe_poses[:, :3, 3], axis=1)
    words = page.loops._verdict._words.content
    assert f"{100 * moved.max():.1f} cm</b> (keyframe {moved.argmax()})" in words
    for residuals in (now.loops.residuals, tried[1].residuals):
        worst = max(residuals, key=lambda factor: factor.sigmas)
        assert f"{worst.sigmas:.1f} σ (loop {worst.pair[0]}–{worst.pair[1]})" in words
    (_, name), *_ = page.loops._proposal.ghost.key
    assert name.startswith("path if you reject 12–89")
    assert len(page.node("/map/ghost/path").points) == len(now.keyframe_poses) - 1
    page.choose(None)
    assert page.node("/map/ghost/path") is None and page.engine.sent[-1] == TryLoop(None)


def test_small_shifts_are_enlarged_to_be_seen() -> None:
    def up(metres: float) -> np.ndarray:
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, metres]])

    assert [enlarged(up(metres), 30.0) for metres in (0.001, 0.05, 0.4, 1.2)] == [0, 10, 2, 1]


def test_a_rejected_loop_is_accepted_at_once(page: Page) -> None:
    pair = rejected(page)
    page.choose(pair)
    user_clicks(page.loops._verdict._accept)
    page.draw()
    assert EditLoop(Accept(*pair)) in page.engine.sent
    assert page.edge(pair).verdict is Verdict.ACCEPTED
    assert page.node("/map/loops/edited-in") is None  # it is the chosen one, drawn in white
    page.choose(None)
    assert page.node("/map/loops/edited-in").points.shape == (2, 2, 3)


def test_after_an_edit_the_map_is_shown_with_the_path_before_it_and_what_moved_beside_undo(page: Page) -> None:
    proposal, inspector = page.loops._proposal, page.loops._inspector
    page.choose(GOOD)
    before = page.engine.snapshot.keyframe_poses
    assert inspector.alone and before is not None
    user_clicks(page.loops._verdict._reject)
    for _ in range(3):
        page.draw()
    verdict, moved = page.loops._verdict, f"{100 * shift(page, before):.1f} cm"
    assert f"Rejected 12–89</b>; keyframes moved by up to <b>{moved}" in verdict._words.content
    assert verdict._undo.visible and not (verdict._accept.visible or verdict._reject.visible)
    assert proposal.ghost.key[0][1].startswith("path before the edit")
    assert not inspector.alone and page.node(OLDER) is None and page.loops.chosen == GOOD
    user_sets(inspector._alone, True)
    page.draw()
    assert page.node(OLDER) is not None, "the submaps can be had again"
    user_sets(inspector._alone, False)
    user_clicks(verdict._undo)
    for _ in range(3):
        page.draw()
    assert UndoLoop() in page.engine.sent
    assert f"Loop 12–89 is accepted again</b>; keyframes moved back by up to <b>{moved}" in verdict._words.content
    assert verdict._reject.visible and not verdict._undo.visible
    assert inspector.alone and page.node(OLDER) is not None, "its submaps are shown again"
    page.choose(WAITING)
    page.draw()
    assert "Accept 34–112" in verdict._words.content
    assert inspector.alone and not proposal.ghost.key[0][1].startswith("path before")


def test_after_a_redo_the_loop_is_not_said_to_be_as_it_was_before(page: Page) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    page.draw()
    said = page.loops._verdict._words.content
    assert "Rejected 12–89" in said
    page.engine.send(UndoLoop())
    page.draw()
    assert "Loop 12–89 is accepted again" in page.loops._verdict._words.content
    page.engine.send(RedoLoop())
    page.draw()
    assert page.edge(GOOD).verdict is Verdict.REJECTED and page.loops._verdict._words.content == said
    page.engine.send(UndoLoop())
    page.draw()
    assert "Loop 12–89 is accepted again" in page.loops._verdict._words.content


def test_the_last_edit_can_be_undone_though_another_loop_is_looked_at(page: Page) -> None:
    page.choose(GOOD)
    user_clicks(page.loops._verdict._reject)
    page.draw()
    page.choose(WAITING)
    page.draw()
    assert page.loops._proposal._done.visible and not page.loops._verdict._undo.visible
    user_clicks(page.loops._proposal._undo)
    page.draw()
    assert page.edge(GOOD).verdict is Verdict.ACCEPTED


def test_cancelling_leaves_all_as_it_was(page: Page) -> None:
    page.loops._proposal.propose(SetWeight(*GOOD, 4.0))
    page.draw()
    page.loops._proposal.cancel()
    page.draw()
    assert not any(isinstance(command, EditLoop) for command in page.engine.sent)
    assert page.engine.sent[-1] == TryLoop(None)
    assert not page.loops._proposal._folder.visible and page.node("/map/ghost/path") is None


def test_nothing_can_be_applied_before_its_effect_is_known(page: Page) -> None:
    page.choose(GOOD)
    page.engine.send = lambda command: None  # type: ignore[method-assign]  # it is still at it
    page.loops._proposal._send = page.engine.send
    page.loops._proposal.propose(SetWeight(*GOOD, 4.0))
    page.draw()
    assert page.loops._proposal._apply.disabled and "Computing" in page.loops._proposal._words.content


def test_the_engine_s_refusal_is_shown_in_the_proposal(page: Page) -> None:
    page.loops._proposal.propose(SetWeight(0, 3, 2.0))
    page.draw()
    page.draw()
    assert "There is no loop candidate of keyframes 0 and 3" in page.loops._proposal._words.content
    assert page.loops._proposal._apply.disabled


def test_the_weight_is_tried_when_the_hand_rests(page: Page) -> None:
    page.choose(GOOD)
    page.engine.sent.clear()
    for weight in (2.0, 3.0, 4.0):
        user_sets(page.loops._verdict._weight, weight)
        page.draw(0.1)
    assert page.engine.sent == []
    page.draw(0.5)
    page.draw()
    assert page.engine.sent == [TryLoop(SetWeight(*GOOD, 4.0))]
    user_clicks(page.loops._proposal._apply)
    page.draw()
    assert page.edge(GOOD).weight == 4.0 and page.loops._verdict._weight.value == 4.0


def test_a_weight_set_just_before_the_page_draws_is_tried(
    server: viser.ViserServer, page: Page, busy: BusyThreads
) -> None:
    page.choose(GOOD)
    page.engine.sent.clear()
    browser_sends(server, page.loops._verdict._weight, 4.0)
    page.draw()
    busy.catch_up()
    page.draw()
    assert TryLoop(SetWeight(*GOOD, 4.0)) in page.engine.sent


def test_choosing_another_loop_drops_what_was_being_considered(page: Page) -> None:
    page.choose(GOOD)
    page.loops._proposal.propose(SetWeight(*GOOD, 4.0))
    page.draw()
    page.choose(WAITING)
    assert page.loops._proposal.command is None and page.engine.sent[-1] == TryLoop(Accept(*WAITING))


def test_undo_and_redo_say_what_they_would_do(page: Page) -> None:
    panel = page.loops._edits
    assert panel._undo.disabled and panel._redo.disabled and panel._save.disabled
    page.engine.send(EditLoop(Reject(*GOOD)))
    page.engine.send(EditLoop(Accept(*WAITING)))
    page.draw()
    assert panel._undo.label == "Undo: accept 34–112" and panel._redo.disabled
    user_clicks(panel._undo)
    page.draw()
    assert UndoLoop() in page.engine.sent
    assert panel._undo.label == "Undo: reject 12–89" and panel._redo.label == "Redo: accept 34–112"
    user_clicks(panel._redo)
    page.draw()
    assert page.engine.sent[-1] == RedoLoop() and panel._redo.disabled


def test_edits_are_saved_and_loaded_again(page: Page) -> None:
    commands = (Reject(*GOOD), Accept(*WAITING), Add(20, 97), SetWeight(20, 97, 0.5))
    for command in commands:
        page.engine.send(EditLoop(command))
    files: dict[str, bytes] = {}
    browser: Any = SimpleNamespace(send_file_download=lambda name, content, **_: files.update({name: content}))
    page.loops._edits._download(browser)
    assert edit_files.read(files["edits.yaml"].decode()) == commands
    page.engine.sent.clear()
    page.loops._edits._load(files["edits.yaml"])
    assert page.engine.sent == [EditLoop(command) for command in commands]


def test_a_file_that_can_not_be_used_changes_nothing_and_says_why(page: Page) -> None:
    with pytest.raises(HemislamError, match="entry 2"):
        page.loops._edits._load(b"- accept: [1, 2]\n- acept: [3, 4]\n")
    assert page.engine.sent == []
