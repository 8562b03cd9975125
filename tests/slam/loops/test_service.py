"""The loop back end as a function of its keyframes and of the request.

Tests app/slam/loops/keyframe_log.py, app/slam/loops/messages.py.
"""

import numpy as np
import pytest

from app.slam.keyframes import KeyframeStore
from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Accept, Add, Edits, Reject, Solve
from app.slam.loops.keyframe_log import KeyframeEntry, KeyframeLog
from app.slam.loops.messages import (
    Added,
    AddKeyframe,
    Answered,
    ApplyEdit,
    Ask,
    AskG2o,
    AskResiduals,
    Failure,
    Inspect,
    LoopState,
    Question,
    Target,
    TryOut,
)
from app.slam.loops.service import InlineLoops
from app.slam.loops.types import LoopDetail, Preview, Verdict, difference
from tests.slam.loops.conftest import PARAMS, Walked, same

ALL = 10_000
"""As many keyframes as there are."""


@pytest.fixture(scope="module")
def backend(walked: Walked) -> LoopBackend:
    backend = LoopBackend()
    for keyframe in walked.keyframes:
        assert backend.handle(AddKeyframe(keyframe, PARAMS)) == Added(keyframe.index + 1)
    return backend


def state(backend: LoopBackend, target: Target, *question: Question) -> LoopState:
    reply = backend.handle(Ask(target, *question))
    assert isinstance(reply, LoopState), reply
    return reply


def end(edits: Edits = Edits()) -> Target:  # noqa: B008 - a value
    return Target(ALL, edits, finished=True)


def test_corrections_take_odometry_to_the_map(walked: Walked, backend: LoopBackend) -> None:
    last = state(backend, end())
    assert last.finished
    assert last.count == len(walked.keyframes)
    odometry = np.array([keyframe.T_odom_imu for keyframe in walked.keyframes])
    np.testing.assert_allclose(last.corrections @ odometry, walked.poses[-1], atol=1e-9)
    assert not last.corrections.flags.writeable
    assert state(LoopBackend(), Target(0)).corrections.shape == (0, 4, 4)


def test_the_same_question_has_the_same_answer_whatever_was_asked_before(walked: Walked, backend: LoopBackend) -> None:
    half = walked.halfway
    edge = next(edge for edge in walked.edges[half - 1] if edge.verdict is Verdict.ACCEPTED)
    targets = (Target(half), Target(half, Edits((Reject(*edge.pair),))), end(), Target(half + 1))
    first = [state(backend, target) for target in targets]
    for target, before in reversed(list(zip(targets, first, strict=True))):
        after = state(backend, target)
        assert (after.count, after.finished, after.undo) == (before.count, before.finished, before.undo)
        assert after.corrections.tobytes() == before.corrections.tobytes()
        assert same(after.edges, before.edges)
    assert same(first[0].edges, walked.edges[half - 1])
    assert same(first[2].edges, walked.edges[-1])


def test_differences_of_states_add_up_to_all_edges(walked: Walked) -> None:
    backend, edges = LoopBackend(), {}
    before: LoopState | None = None
    for keyframe in walked.keyframes:
        backend.handle(AddKeyframe(keyframe, PARAMS))
        now = state(backend, Target(ALL))
        change = difference(before.edges if before else (), now.edges)
        assert change.gone == ()
        edges.update((edge.pair, edge.verdict) for edge in change.changed)
        assert edges == {edge.pair: edge.verdict for edge in now.edges}
        before = now
    assert Verdict.ACCEPTED in edges.values()
    backend.close()


def test_questions_change_nothing(backend: LoopBackend) -> None:
    before = state(backend, end())
    edge = next(edge for edge in before.edges if edge.verdict is Verdict.ACCEPTED)
    questions = (TryOut(Reject(*edge.pair)), Inspect(*edge.pair), AskResiduals(), TryOut(Solve()), AskG2o())
    replies = [backend.handle(Ask(end(), question)) for question in questions]
    assert [reply.question for reply in replies if isinstance(reply, Answered)] == list(questions)
    tried, inspected, residuals, solved, g2o = (reply.value for reply in replies if isinstance(reply, Answered))
    assert isinstance(tried, Preview) and isinstance(solved, Preview)
    assert tried.poses.shape == solved.poses.shape == (before.count, 4, 4)
    assert isinstance(inspected, LoopDetail)
    assert len(inspected.residuals) > 0
    assert isinstance(residuals, tuple) and isinstance(g2o, str)
    loops = sum(edge.counts for edge in before.edges)
    assert len(residuals) == before.count - 1 + loops
    assert g2o.count("\nEDGE_SE3:QUAT") == before.count - 1 + loops
    after = state(backend, end())
    assert after.corrections.tobytes() == before.corrections.tobytes()
    assert after.edges == before.edges
    assert after.undo == after.notices == ()


def test_an_edit_is_answered_by_what_became_of_it(backend: LoopBackend) -> None:
    before = state(backend, end())
    edge = next(edge for edge in before.edges if edge.verdict is Verdict.ACCEPTED)
    rejected = state(backend, end(), ApplyEdit(Reject(*edge.pair)))
    assert (edge.pair, Verdict.REJECTED) in {
        (e.pair, e.verdict) for e in difference(before.edges, rejected.edges).changed
    }
    assert rejected.undo == (Reject(*edge.pair),)
    undone = state(backend, end(Edits(rejected.undo).undo()))
    assert (undone.undo, undone.redo) == ((), rejected.undo)
    assert undone.corrections.tobytes() == before.corrections.tobytes()
    redone = state(backend, end(Edits(rejected.undo)))
    assert redone.corrections.tobytes() == rejected.corrections.tobytes()


def test_an_edit_that_waits_says_so(backend: LoopBackend) -> None:
    waiting = state(backend, end(), ApplyEdit(Accept(1, 2)))
    assert waiting.notices == ("Accept 1-2 waits until there is such a loop.",)
    assert state(backend, end()).notices == ()


def test_what_cannot_be_done_is_said_and_changes_nothing(walked: Walked, backend: LoopBackend) -> None:
    before = state(backend, end())
    questions: list[tuple[Question, str]] = [
        (ApplyEdit(Add(9, 2)), "older and a newer"),
        (TryOut(Accept(1, 2)), "no loop candidate"),
        (Inspect(0, 10_000), "of the"),
    ]
    for question, text in questions:
        reply = backend.handle(Ask(end(), question))
        assert isinstance(reply, Failure)
        assert text in reply.text
    reply = backend.handle(Ask(end(Edits((Accept(9, 2),)))))
    assert isinstance(reply, Failure) and "older and a newer" in reply.text
    few = LoopBackend()
    reply = few.handle(AddKeyframe(walked.keyframes[3], PARAMS))
    assert isinstance(reply, Failure) and "cannot follow" in reply.text
    few.close()
    after = state(backend, end())
    assert (after.count, after.undo) == (before.count, before.undo)
    assert after.corrections.tobytes() == before.corrections.tobytes()


def test_a_keyframe_at_a_known_index_replaces_it_and_all_later_ones_unless_it_is_the_same(walked: Walked) -> None:
    backend = LoopBackend()
    for keyframe in walked.keyframes[:6]:
        backend.handle(AddKeyframe(keyframe, PARAMS))
    assert backend.handle(AddKeyframe(walked.keyframes[3], PARAMS)) == Added(4)
    assert state(backend, Target(ALL)).count == 6
    other = PARAMS.model_copy(update={"min_time": PARAMS.min_time + 1})
    backend.handle(AddKeyframe(walked.keyframes[3], other))
    assert state(backend, Target(ALL)).count == 4
    backend.close()


def test_inline_loops_follow_the_log_and_answer_in_order(walked: Walked) -> None:
    store = KeyframeStore()
    log = KeyframeLog(store)
    loops = InlineLoops(log)
    assert loops.receive() is None
    for keyframe in walked.keyframes[:3]:
        store.append(keyframe)
        log.append(KeyframeEntry(keyframe.frame, keyframe.stamp_ns, PARAMS))
        loops.send(Ask(Target(keyframe.index + 1)))
    log.truncate(1)
    store.truncate(1)
    loops.send(Ask(Target(ALL)))
    store.append(walked.keyframes[1])
    log.append(KeyframeEntry(walked.keyframes[1].frame, 0, PARAMS))
    loops.send(Ask(Target(2)))
    replies = [loops.receive() for _ in range(5)]
    assert [reply.count for reply in replies if isinstance(reply, LoopState)] == [1, 2, 3, 3, 2]
    assert loops.receive() is None
    loops.close()
    store.close()
