"""Found loops take effect at a frame that depends only on the session."""

from collections.abc import Iterator

import pytest

from app.slam.loops.edits import Accept, Edits
from app.slam.loops.messages import ApplyEdit, Failure
from app.slam.sections import LoopsParams
from tests.slam.loops.held_session import LATENCY, HeldSession, shift_at


@pytest.fixture
def session() -> Iterator[HeldSession]:
    session = HeldSession()
    yield session
    session.store.close()


@pytest.mark.parametrize("speed", [0, 1, 100])
def test_a_loop_takes_effect_at_its_frame_however_fast_the_work_is(session: HeldSession, speed: int) -> None:
    for frame in range(40):
        session.worker.answered = speed
        news, shift = session.step()
        assert shift == shift_at(frame)
        assert [e.newer for e in news] == ([shift] if shift != shift_at(frame - 1) else [])
    assert bool(session.worker.waits) == (speed == 0)


@pytest.mark.parametrize("frame", [1, 7, 20, 28])
def test_gone_back_and_on_again_every_frame_is_as_it_was(session: HeldSession, frame: int) -> None:
    before = [session.step() for _ in range(30)]
    sent = len(session.worker.added)
    session.go_to(frame)
    again = [session.step() for _ in range(frame, 30)]
    assert [shift for _, shift in again] == [shift for _, shift in before[frame:]]
    assert [len(news) for news, _ in again[1:]] == [len(news) for news, _ in before[frame + 1 :]]
    assert len(session.worker.added) == sent, "known keyframes are not sent twice"


def test_a_step_back_never_waits(session: HeldSession) -> None:
    session.worker.answered = 100
    shifts = [session.step()[1] for _ in range(30)]
    session.loops.poll()
    waits = session.worker.waits
    for frame in range(28, 15, -1):
        session.go_to(frame)
        assert session.shift == shift_at(frame - 1)
        assert session.step()[1] == shifts[frame]
    assert session.worker.waits == waits


@pytest.mark.parametrize("frame", [0, 1, LATENCY, LATENCY + 1])
def test_before_the_first_loop_counts_the_worker_is_not_asked(session: HeldSession, frame: int) -> None:
    """It may still be busy with the end of the session."""
    for _ in range(30):
        session.worker.answered = 10
        session.step()
    session.loops.finish()
    waits, asked = session.worker.waits, len(session.worker.requests)
    session.go_to(frame)
    assert session.shift == shift_at(frame - 1)
    assert session.step()[1] == shift_at(frame)
    assert (session.worker.waits, len(session.worker.requests)) == (waits, asked)


def test_no_frame_waits_while_the_session_is_too_short_for_a_loop(session: HeldSession) -> None:
    """Keyframes are 30 s apart here: between two of them there can be a loop after 15 s, but not after 100 s."""
    patient = LoopsParams(latency=LATENCY, min_time=100.0)
    while session.worker.waits == 0:
        session.step(patient)
    assert len(session.store) > 4, "the worker is first waited for when the fifth keyframe is due"
    assert session.worker.added[:5] == [0, 1, 2, 3, 4], "but it was sent them all, so that it is not late then"
    assert session.shift == 4


def test_an_edit_made_just_before_going_back_is_not_lost(session: HeldSession) -> None:
    for _ in range(30):
        session.step()
    session.loops.command(ApplyEdit(Accept(0, 2)))
    session.go_to(20)
    session.step()
    assert session.loops.state is not None and session.loops.state.undo == (Accept(0, 2),)
    assert session.shift == shift_at(20)


def test_a_session_that_goes_on_differently_sends_its_keyframes_again(session: HeldSession) -> None:
    for _ in range(30):
        session.step()
    session.go_to(10)
    session.loops.forget_after(9)
    session.worker.added.clear()
    for _ in range(10, 20):
        session.step()
    assert session.worker.added == [4, 5, 6]


def test_an_edit_takes_effect_when_it_is_answered_and_holds(session: HeldSession) -> None:
    for _ in range(10):
        session.step()
    session.loops.command(ApplyEdit(Accept(0, 2)))
    assert not session.loops.idle
    session.until_idle()
    assert session.loops.state is not None
    assert session.loops.state.undo == (Accept(0, 2),)
    assert session.shift == len(session.store) - 1, "an edit acts on all there is"
    for _ in range(20):
        session.step()
    assert session.loops.state.undo == (Accept(0, 2),)


def test_edits_given_without_waiting_are_applied_in_their_order(session: HeldSession) -> None:
    for request in (ApplyEdit(Accept(0, 1)), ApplyEdit(Accept(0, 2)), Edits.undo, Edits.undo, Edits.redo):
        session.loops.command(request)
        session.step()
    session.until_idle()
    assert session.loops.state is not None
    assert (session.loops.state.undo, session.loops.state.redo) == ((Accept(0, 1),), (Accept(0, 2),))
    session.loops.command(lambda _: Edits())
    session.loops.command(Edits.undo)
    session.until_idle()
    assert session.loops.take_answers() == [Failure("There is no edit to undo.")]


def test_results_hold_all_keyframes_whether_in_effect_or_not(session: HeldSession) -> None:
    for _ in range(20):
        session.step()
    assert session.shift < 6
    results = session.loops.results()
    assert results.frame.newest[0, 3] == len(results.stamps_ns) - 1 == 6
    assert results.g2o == "graph of 7"
    session.loops.finish()
    session.loops.results()
    assert session.loops.state is not None and session.loops.state.finished
    assert session.shift == 6, "at its end all takes effect"


def test_a_session_that_never_goes_back_keeps_no_past_states(session: HeldSession) -> None:
    session.loops.never_go_back()
    for frame in range(60):
        session.worker.answered = 10
        assert session.step()[1] == shift_at(frame)
    assert len(session.loops._states) <= LATENCY


@pytest.mark.parametrize("speed", [0, 1, 100])
@pytest.mark.parametrize("frames", [100, 70])  # 34 keyframes; 24, after which a state is asked for
def test_if_only_results_are_wanted_no_frame_waits_for_a_slow_search_and_they_are_the_same(
    frames: int, speed: int
) -> None:
    others = []
    for only_results in (False, True):
        session = HeldSession()
        if only_results:
            session.loops.only_results()
        for _ in range(frames):
            session.worker.answered = speed
            session.step()
            if only_results:
                assert not session.worker.waits and session.shift == 0.0
        session.loops.finish()
        results = session.loops.results()
        others.append(
            (results.frame.newest.tobytes(), results.stamps_ns.tobytes(), results.g2o, results.edges[-1].pair)
        )
        session.store.close()
    assert others[0] == others[1]


def test_if_only_results_are_wanted_frames_wait_before_keyframes_pile_up() -> None:
    session = HeldSession()
    session.loops.only_results()
    most = 0
    for _ in range(600):
        session.step()
        most = max(most, session.worker.pending)
    assert session.worker.waits
    assert most < 100
    session.store.close()
