import numpy as np
import pytest

from app.slam.loops.messages import (
    AddKeyframe,
    ApplyEdit,
    AskG2o,
    AskResiduals,
    Failure,
    Finish,
    G2o,
    GoTo,
    Inspect,
    Inspected,
    LoadCommands,
    LoopState,
    Redo,
    Request,
    Residuals,
    Tried,
    TryOut,
    Undo,
)
from app.slam.loops.service import InlineLoops, LoopService
from app.slam.loops.types import Accept, Add, Reject, Solve, Verdict
from tests.slam.loops.conftest import PARAMS, Walked


@pytest.fixture(scope="module")
def service(walked: Walked) -> LoopService:
    service = LoopService()
    for keyframe in walked.keyframes:
        state(service, AddKeyframe(keyframe, PARAMS))
    return service


def state(service: LoopService, request: Request) -> LoopState:
    reply = service.handle(request)
    assert isinstance(reply, LoopState), reply
    return reply


def test_corrections_take_odometry_to_the_map(walked: Walked, service: LoopService) -> None:
    last = state(service, Finish())
    assert last.finished
    assert last.count == last.known == len(walked.keyframes)
    odometry = np.array([keyframe.T_odom_imu for keyframe in walked.keyframes])
    np.testing.assert_allclose(last.corrections @ odometry, walked.poses[-1], atol=1e-9)
    assert not last.corrections.flags.writeable
    assert LoopService()._state().corrections.shape == (0, 4, 4)


def test_what_changed_adds_up_to_all_edges(walked: Walked) -> None:
    service, told = LoopService(), {}
    for keyframe in walked.keyframes:
        now = state(service, AddKeyframe(keyframe, PARAMS))
        told.update((edge.pair, edge.verdict) for edge in now.changed)
        assert told == {edge.pair: edge.verdict for edge in now.edges}
    assert Verdict.ACCEPTED in told.values()
    service.close()


def test_questions_change_nothing(walked: Walked, service: LoopService) -> None:
    before = state(service, Finish())
    edge = next(edge for edge in before.edges if edge.verdict is Verdict.ACCEPTED)
    replies = [
        service.handle(request)
        for request in (TryOut(Reject(*edge.pair)), Inspect(*edge.pair), AskResiduals(), TryOut(Solve()), AskG2o())
    ]
    assert [type(reply) for reply in replies] == [Tried, Inspected, Residuals, Tried, G2o]
    tried, inspected, residuals, solved, g2o = replies
    assert isinstance(tried, Tried)
    assert tried.command == Reject(*edge.pair)
    assert isinstance(inspected, Inspected)
    assert inspected.pair == edge.pair
    assert isinstance(residuals, Residuals)
    loops = sum(edge.counts for edge in before.edges)
    assert len(residuals.residuals) == before.count - 1 + loops
    assert isinstance(solved, Tried)
    assert solved.preview.poses.shape == (before.count, 4, 4)
    assert isinstance(g2o, G2o)
    assert g2o.text.count("\nEDGE_SE3:QUAT") == before.count - 1 + loops
    after = state(service, Finish())
    assert after.corrections.tobytes() == before.corrections.tobytes()
    assert after.edges == before.edges
    assert after.changed == after.undo == after.notices == ()


def test_overruling_is_answered_by_what_became_of_it(service: LoopService) -> None:
    before = state(service, Finish())
    edge = next(edge for edge in before.edges if edge.verdict is Verdict.ACCEPTED)
    rejected = state(service, ApplyEdit(Reject(*edge.pair)))
    assert [(e.pair, e.verdict) for e in rejected.changed] == [(edge.pair, Verdict.REJECTED)]
    assert rejected.undo == (Reject(*edge.pair),)
    undone = state(service, Undo())
    assert (undone.undo, undone.redo) == ((), rejected.undo)
    assert undone.corrections.tobytes() == before.corrections.tobytes()
    redone = state(service, Redo())
    assert redone.corrections.tobytes() == rejected.corrections.tobytes()
    loaded = state(service, LoadCommands(undone.undo, undone.redo))
    assert (loaded.undo, loaded.redo) == ((), rejected.undo)
    assert loaded.corrections.tobytes() == before.corrections.tobytes()
    state(service, LoadCommands(()))


def test_a_command_that_waits_says_so(service: LoopService) -> None:
    assert state(service, ApplyEdit(Accept(1, 2))).notices == ("Accept 1-2 waits until there is such a loop.",)
    assert state(service, Undo()).notices == ()
    state(service, LoadCommands(()))


def test_what_can_not_be_done_is_said_and_nothing_has_changed(walked: Walked, service: LoopService) -> None:
    before = state(service, Finish())
    for request, text in [
        (GoTo(10_000), "knows"),
        (AddKeyframe(walked.keyframes[3], PARAMS), "can not follow"),
        (Undo(), "no edit to undo"),
        (Redo(), "no edit to redo"),
        (ApplyEdit(Add(9, 2)), "older and a newer"),
        (LoadCommands((Accept(9, 2),)), "older and a newer"),
        (TryOut(Accept(1, 2)), "no loop candidate"),
        (Inspect(0, 10_000), "of the"),
    ]:
        reply = service.handle(request)
        assert isinstance(reply, Failure)
        assert text in reply.text
    after = state(service, Finish())
    assert (after.count, after.undo) == (before.count, before.undo)
    assert after.corrections.tobytes() == before.corrections.tobytes()


def test_forgetting_keeps_the_first_keyframes(walked: Walked) -> None:
    service = LoopService()
    for keyframe in walked.keyframes[:6]:
        state(service, AddKeyframe(keyframe, PARAMS))
    assert state(service, GoTo(4)).known == 6
    assert state(service, GoTo(3, forget=True)).known == 3
    assert isinstance(service.handle(GoTo(4)), Failure)
    begun = state(service, GoTo(0, forget=True))
    assert (begun.count, begun.known, begun.corrections.shape) == (0, 0, (0, 4, 4))
    service.close()


def test_inline_answers_wait_in_order(walked: Walked) -> None:
    loops = InlineLoops()
    assert loops.receive() is None
    for keyframe in walked.keyframes[:3]:
        loops.send(AddKeyframe(keyframe, PARAMS))
    assert loops.pending == 3
    replies = [loops.receive() for _ in range(3)]
    assert [reply.count for reply in replies if isinstance(reply, LoopState)] == [1, 2, 3]
    assert loops.pending == 0
    loops.close()
