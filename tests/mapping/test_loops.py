"""A loop worker that dies is replaced by one that is sent what it lacks; nothing is lost by it."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.mapping.loops import MOST_DEATHS, MOST_PENDING
from app.slam.keyframes import KeyframeStore
from app.slam.loops.messages import AddKeyframe, ApplyEdit, Failure
from app.slam.loops.types import Accept, LoopEdit
from app.slam.sections import LoopsParams
from tests.slam.loops.held_session import EVERY, HeldSession, a_keyframe, shift_at


@pytest.fixture
def session() -> Iterator[HeldSession]:
    session = HeldSession()
    yield session
    session.store.close()


def test_a_new_worker_is_sent_all_keyframes_and_edits(session: HeldSession) -> None:
    for _ in range(20):
        session.step()
    session.loops.command(ApplyEdit(Accept(0, 2)))
    session.until_idle()
    session.worker.dead = True
    for _ in range(30):
        session.step()
        session.worker.answered = 100
    assert len(session.workers) == 2
    assert session.worker.added[:5] == [0, 1, 2, 3, 4]
    assert session.loops.state is not None and session.loops.state.undo == (Accept(0, 2),)
    assert session.shift == shift_at(session.frame - 1)
    assert session.loops.take_alarms() == [
        "The worker ended unexpectedly (signal 9, SIGKILL). It is started again; loops follow once it has caught up."
    ]
    assert session.loops.take_notices() == []


def test_a_worker_that_keeps_dying_is_given_up_and_frames_go_on(session: HeldSession) -> None:
    for _ in range(60):
        session.worker.dead = True
        session.step()
    assert len(session.workers) == MOST_DEATHS + 1
    assert any("stay as they are" in alarm for alarm in session.loops.take_alarms())
    session.loops.command(ApplyEdit(Accept(0, 2)))
    session.loops.poll()
    assert session.loops.idle
    assert [type(answer) for answer in session.loops.take_answers()] == [Failure]
    session.go_to(5)
    session.step()
    assert session.loops.idle
    session.loops.results()
    assert len(session.loops.take_notices()) == 1, "it is said once"


@pytest.mark.parametrize("death", range(1, 40, 4))
def test_whenever_it_dies_the_end_is_the_same_and_what_came_into_effect_stays(session: HeldSession, death: int) -> None:
    shifts = []
    for frame in range(40):
        if frame == death:
            session.worker.dead = True
        session.worker.answered = 100
        shifts.append(session.step()[1])
    assert shifts == sorted(shifts), "the map does not go back to what it was before"
    session.loops.finish()
    results = session.loops.results()
    assert results.frame.newest[0, 3] == len(session.store) == len(results.stamps_ns)
    assert results.g2o == f"graph of {len(session.store)}"
    assert session.worker.added == list(range(len(session.store)))
    assert session.loops.state is not None and session.loops.state.finished
    assert len(session.workers) == 2


@pytest.mark.parametrize("moment", ["before the end", "at the end", "after it"])
def test_a_worker_that_dies_at_the_end_of_the_session_does_it_again(session: HeldSession, moment: str) -> None:
    for _ in range(20):
        session.step()
    session.worker.dead = moment == "before the end"
    session.loops.finish()
    session.worker.dead |= moment == "at the end"
    session.worker.answered = 100
    session.loops.poll()
    session.worker.dead |= moment == "after it"
    results = session.loops.results()
    assert len(session.workers) == 2
    assert session.loops.state is not None and session.loops.state.finished
    assert results.g2o == "graph of 7"


def test_questions_of_the_user_are_answered_by_the_next_worker(session: HeldSession) -> None:
    for _ in range(20):
        session.step()
    session.loops.command(ApplyEdit(Accept(0, 2)))  # not answered yet
    session.worker.dead = True
    session.loops.poll()
    session.loops.command(ApplyEdit(Accept(0, 3)))  # while the keyframes are sent again
    assert not session.loops.idle
    session.until_idle()
    assert session.loops.state is not None and session.loops.state.undo == (Accept(0, 2), Accept(0, 3))
    edits = [number for number, request in enumerate(session.worker.requests) if "ApplyEdit" in repr(request)]
    assert len(edits) == 2
    assert not any(isinstance(request, AddKeyframe) for request in session.worker.requests[edits[0] :])
    assert session.shift == 7, "an edit acts on all there is"


def test_keyframes_that_are_sent_again_have_the_parameters_of_then(session: HeldSession) -> None:
    params = [LoopsParams(min_time=10.0 + k) for k in range(10)]
    for frame in range(30):
        session.step(params[frame // EVERY])
    session.worker.dead = True
    session.loops.results()
    assert len(session.workers) == 2
    assert session.worker.params == params


def test_frames_do_not_wait_while_keyframes_are_sent_again_a_few_at_a_time(session: HeldSession) -> None:
    for _ in range(60):
        session.step()
    session.worker.dead = True
    session.loops.poll()
    for _ in range(10):
        session.step()
    assert len(session.workers) == 2
    assert session.worker.waits == 0
    assert session.worker.pending == MOST_PENDING


def test_going_back_while_keyframes_are_sent_again(session: HeldSession) -> None:
    for _ in range(40):
        session.step()
    session.worker.dead = True
    session.loops.poll()
    session.go_to(23)
    for _ in range(30):
        session.worker.answered = 1
        session.step()
    session.until_idle()
    session.step()
    assert session.shift == shift_at(session.frame - 1)
    assert session.loops.take_notices() == []


def test_a_session_that_another_engine_began_goes_on_without_waiting() -> None:
    store = KeyframeStore()
    for index in range(20):
        store.append(a_keyframe(index, EVERY * index))
    session = HeldSession(store)
    session.go_to(EVERY * 20)
    session.step()
    assert session.worker.waits == 0
    session.until_idle()
    assert session.worker.added == list(range(21))
    assert session.shift == shift_at(session.frame - 1)
    store.close()


ACTIONS = st.lists(
    st.sampled_from(["step", "step", "answer", "poll", "die", "back", "differently", "edit"]), max_size=60
)


@settings(max_examples=150, deadline=None)
@given(ACTIONS)
def test_whatever_happens_the_end_is_that_of_the_session_and_no_edit_is_lost(actions: list[str]) -> None:
    session, edits = HeldSession(), list[LoopEdit]()
    for number, action in enumerate(actions):
        match action:
            case "step":
                session.step()
            case "answer":
                session.worker.answered += 2
            case "poll":
                session.loops.poll()
            case "die":
                session.worker.dead = len(session.workers) <= MOST_DEATHS
            case "back" | "differently":
                session.go_to(session.frame // 2)
                if action == "differently":
                    session.loops.forget_after(session.frame - 1)
                session.step()
            case "edit":
                edits.append(Accept(0, number + 1))
                session.loops.command(ApplyEdit(edits[-1]))
    session.loops.finish()
    results = session.loops.results()
    assert results.g2o == f"graph of {len(session.store)}"
    assert len(results.stamps_ns) == len(session.store)
    assert session.loops.idle
    assert session.loops.state is not None
    assert session.loops.state.undo == tuple(edits)
    assert session.loops.state.finished
    assert session.loops.state.count == len(session.store)
    session.store.close()
