"""Loops are searched in a process. If it dies, it is replaced by another one, which gets the missing data."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.child import Child, ChildDied, Link
from app.mapping.loops import MOST_DEATHS, MOST_PENDING, LoopProcess
from app.slam import lie
from app.slam.keyframes import KeyframeStore
from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Accept, Add, Edits, LoopEdit, Reject, rows
from app.slam.loops.messages import Added, AddKeyframe, ApplyEdit, Ask, Failure, LoopState, Request, Target
from app.slam.loops.types import difference
from app.slam.sections import LoopsParams
from app.slam.types import NON_GROUND, Cloud, Keyframe
from tests.slam.loops.held_session import EVERY, HeldSession, a_keyframe, shift_at

PARAMS = LoopsParams(submap_keyframes=1, min_time=1.0, support=0)
PATIENCE_S = 60.0


def keyframes(count: int = 8, points: int = 4000) -> tuple[Keyframe, ...]:
    """To and fro in a room with a pillar."""
    rng = np.random.default_rng(1)
    walls = rng.uniform(-4.0, 4.0, (points, 3)) * [1.0, 0.7, 0.4]
    side = rng.integers(0, 3, points)
    walls[np.arange(points), side] = np.array([4.0, 2.8, 1.6])[side] * rng.choice([-1.0, 1.0], points)
    walls[: points // 10] = rng.uniform(0.0, 1.0, (points // 10, 3)) * [0.4, 0.4, 3.0] + [1.0, 0.5, -1.6]
    out = []
    for index in range(count):
        x = abs(index - count // 2) * 0.5
        cloud = Cloud(
            (walls - [x, 0.0, 0.0]).astype(np.float32), np.full(points, NON_GROUND, np.uint8),
            np.zeros(points, np.float32), np.zeros(points, np.uint16), np.zeros(points, np.int32),
        )  # fmt: skip
        T = lie.transform(np.eye(3), np.array([x, 0.0, 0.0]))
        out.append(Keyframe(index, 10 * index, index * 1_000_000_000, T, np.eye(4), np.eye(6) * 1e-6, cloud))
    return tuple(out)


@pytest.fixture
def process() -> Iterator[LoopProcess]:
    process = LoopProcess()
    yield process
    process.close()


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False


def until_gone(pid: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while alive(pid):
        assert time.monotonic() < deadline, "it still lives"
        time.sleep(0.02)


@pytest.fixture(params=["a fork", "a new interpreter"])
def either(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[LoopProcess]:
    """As on Linux, and as on systems that cannot fork."""
    if request.param == "a new interpreter":
        monkeypatch.setattr("app.child.fork_context", lambda module: multiprocessing.get_context("spawn"))
    process = LoopProcess()
    yield process
    process.close()


def test_it_answers_as_one_in_this_process_would(either: LoopProcess) -> None:
    process, far = either, rows(lie.transform(np.eye(3), np.array([0.5, 0.1, 0.0])))
    add, reject = Add(1, 5, far, register=False), Reject(1, 5)
    requests: list[Request] = []
    for keyframe in keyframes():
        requests += [AddKeyframe(keyframe, PARAMS), Ask(Target(keyframe.index + 1))]
    requests += [Ask(Target(8, finished=True)), Ask(Target(8, finished=True), ApplyEdit(add))]
    requests += [
        Ask(Target(8, Edits((add,))), ApplyEdit(reject)),
        Ask(Target(8, Edits((add,), (reject,)))),
        Ask(Target(8)),
    ]
    requests += [Ask(Target(4)), Ask(Target(5)), Ask(Target(5), ApplyEdit(Reject(3, 3)))]
    inline = LoopBackend()
    for request in requests:
        process.send(request)
    found = 0
    for request in requests:
        theirs, ours = process.receive(PATIENCE_S), inline.handle(request)
        assert type(theirs) is type(ours)
        if isinstance(theirs, LoopState) and isinstance(ours, LoopState):
            found = max(found, len(ours.edges))
            assert theirs.corrections.tobytes() == ours.corrections.tobytes()
            assert difference(theirs.edges, ours.edges) == ((), ())
            assert (theirs.count, theirs.finished, theirs.undo, theirs.redo, theirs.notices) == (
                *(ours.count, ours.finished, ours.undo, ours.redo, ours.notices),
            )
        else:
            assert theirs == ours
    assert found > 1


def test_sending_does_not_wait_for_a_stopped_process(process: LoopProcess) -> None:
    """Stopped, it takes nothing: far more than a pipe holds is handed over all the same, and answered afterwards."""
    os.kill(process.pid, signal.SIGSTOP)
    many = keyframes(12, points=60_000)  # 27 bytes each
    for keyframe in many:
        process.send(AddKeyframe(keyframe, PARAMS))
    assert process.receive(0.05) is None
    os.kill(process.pid, signal.SIGCONT)
    for count in range(1, len(many) + 1):
        reply = process.receive(PATIENCE_S)
        assert reply == Added(count)


def test_a_killed_process_is_noticed_and_another_one_can_take_over(process: LoopProcess) -> None:
    walk = keyframes(4)
    process.send(AddKeyframe(walk[0], PARAMS))
    assert process.receive(PATIENCE_S) is not None
    process.send(AddKeyframe(walk[1], PARAMS))
    os.kill(process.pid, signal.SIGKILL)
    process.send(AddKeyframe(walk[2], PARAMS))
    with pytest.raises(ChildDied, match="signal 9"):
        for _ in range(3):  # an answer may have come before
            process.receive(PATIENCE_S)
    with pytest.raises(ChildDied):
        process.receive(PATIENCE_S)
    second = LoopProcess()
    for keyframe in walk:
        second.send(AddKeyframe(keyframe, PARAMS))
    counts = [reply.count for reply in (second.receive(PATIENCE_S) for _ in walk) if isinstance(reply, Added)]
    assert counts == [1, 2, 3, 4]
    second.close()
    assert not alive(second.pid)


def _owner(owner: Link) -> None:
    process = LoopProcess()
    process.send(AddKeyframe(keyframes(1)[0], PARAMS))
    reply = process.receive(PATIENCE_S)
    owner.send((process.pid, reply.count if isinstance(reply, Added) else -1))
    time.sleep(10 * PATIENCE_S)


def test_a_child_can_own_it_and_it_ends_when_that_child_is_killed() -> None:
    owner = Child(_owner, name="owner", title="The owner", fork=True)
    pid, count = owner.receive(PATIENCE_S)
    assert count == 1
    assert alive(pid)
    owner.close(timeout=0)
    until_gone(pid)


def test_closing_ends_it_even_while_it_works(process: LoopProcess) -> None:
    for keyframe in keyframes(12, points=60_000):
        process.send(AddKeyframe(keyframe, PARAMS))
    process.close()
    assert not alive(process.pid)


# --- a process that dies ---
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
    assert results.frame.newest[0, 3] == len(session.store) - 1 == len(results.stamps_ns) - 1
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
    assert session.shift == 6, "an edit acts on all there is"


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
        assert session.loops.edits.done == tuple(edits), "answered or not"
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
