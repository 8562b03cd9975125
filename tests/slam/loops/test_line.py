"""When what was found takes effect: at a frame that depends on nothing but the walk."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.slam.loops.line import MOST_DEATHS
from app.slam.loops.messages import (
    AddKeyframe,
    ApplyEdit,
    Failure,
    Undo,
)
from app.slam.loops.types import Accept, LoopEdit
from app.slam.params import LoopsParams
from tests.slam.loops.held_walk import EVERY, LATENCY, HeldWalk, shift_at


@pytest.fixture
def walk() -> Iterator[HeldWalk]:
    walk = HeldWalk()
    yield walk
    walk.store.close()


@pytest.mark.parametrize("speed", [0, 1, 100])
def test_a_loop_takes_effect_at_its_frame_however_fast_the_work_is(walk: HeldWalk, speed: int) -> None:
    for frame in range(40):
        walk.client.answered = speed
        news, shift = walk.step()
        assert shift == shift_at(frame)
        assert [e.newer for e in news] == ([shift - 1] if shift != shift_at(frame - 1) else [])
    assert bool(walk.client.waits) == (speed == 0)


def test_nobody_waits_for_work_that_is_done_in_time(walk: HeldWalk) -> None:
    for _ in range(30):
        walk.client.answered = 1
        walk.step()
    assert walk.client.waits == 0


@pytest.mark.parametrize("frame", [1, 7, 20, 28])
def test_gone_back_and_on_again_every_frame_is_as_it_was(walk: HeldWalk, frame: int) -> None:
    before = [walk.step() for _ in range(30)]
    sent = len(walk.client.added)
    walk.go_to(frame)
    again = [walk.step() for _ in range(frame, 30)]
    assert [shift for _, shift in again] == [shift for _, shift in before[frame:]]
    assert len(walk.client.added) == sent, "what is known is not handed over twice"


def test_a_step_back_waits_for_nobody(walk: HeldWalk) -> None:
    walk.client.answered = 100
    shifts = [walk.step()[1] for _ in range(30)]
    walk.line.poll()
    waits = walk.client.waits
    for frame in range(28, 15, -1):
        walk.go_to(frame)
        assert walk.line.frame.newest[0, 3] == shift_at(frame - 1)
        assert walk.step()[1] == shifts[frame]
    assert walk.client.waits == waits


@pytest.mark.parametrize("frame", [0, 1, LATENCY, LATENCY + 1])
def test_before_the_first_loop_counts_nobody_is_asked_for_it(walk: HeldWalk, frame: int) -> None:
    """Whoever does the work may still be busy with the end of the walk."""
    for _ in range(30):
        walk.client.answered = 10
        walk.step()
    walk.line.finish()
    waits, asked = walk.client.waits, len(walk.client.requests)
    walk.go_to(frame)
    assert walk.line.frame.newest[0, 3] == shift_at(frame - 1)
    assert walk.step()[1] == shift_at(frame)
    assert (walk.client.waits, len(walk.client.requests)) == (waits, asked)


def test_a_command_given_just_before_going_back_is_not_lost(walk: HeldWalk) -> None:
    for _ in range(30):
        walk.step()
    walk.line.command(ApplyEdit(Accept(0, 2)))
    walk.go_to(20)
    walk.step()
    assert walk.line.state is not None and walk.line.state.undo == (Accept(0, 2),)
    assert walk.line.frame.newest[0, 3] == shift_at(20)


def test_a_walk_that_goes_on_differently_hands_its_keyframes_over_anew(walk: HeldWalk) -> None:
    for _ in range(30):
        walk.step()
    walk.go_to(10)
    walk.line.forget_after(9)
    walk.client.added.clear()
    for _ in range(10, 20):
        walk.step()
    assert walk.client.added == [4, 5, 6]


def test_a_command_takes_effect_when_it_is_answered_and_holds(walk: HeldWalk) -> None:
    for _ in range(10):
        walk.step()
    walk.line.command(ApplyEdit(Accept(0, 2)))
    assert not walk.line.idle
    walk.client.answered = 10
    walk.line.poll()
    assert walk.line.idle and walk.line.state is not None
    assert walk.line.state.undo == (Accept(0, 2),)
    for _ in range(20):
        walk.step()
    assert walk.line.state.undo == (Accept(0, 2),)


def test_work_that_died_is_begun_again_with_all_keyframes_and_commands(walk: HeldWalk) -> None:
    for _ in range(20):
        walk.step()
    walk.line.command(ApplyEdit(Accept(0, 2)))
    walk.client.answered = 100
    walk.line.poll()
    walk.client.dead = True
    walk.line.poll()
    for _ in range(30):
        walk.step()
        walk.client.answered = 100
    assert len(walk.clients) == 2
    assert walk.client.added[:5] == [0, 1, 2, 3, 4]
    assert walk.line.state is not None and walk.line.state.undo == (Accept(0, 2),)
    assert walk.line.frame.newest[0, 3] == shift_at(walk.frame - 1)
    assert any("started again" in alarm for alarm in walk.line.take_alarms())


def test_work_that_keeps_dying_is_given_up_and_frames_go_on(walk: HeldWalk) -> None:
    for _ in range(60):
        walk.client.dead = True
        walk.step()
    assert len(walk.clients) == MOST_DEATHS + 1
    assert any("stay as they are" in alarm for alarm in walk.line.take_alarms())
    walk.line.command(ApplyEdit(Accept(0, 2)))
    assert any(isinstance(answer, Failure) for answer in walk.line.take_answers())


@pytest.mark.parametrize("death", range(1, 40, 4))
def test_whenever_the_work_dies_the_end_is_the_same_and_what_came_into_effect_stays(walk: HeldWalk, death: int) -> None:
    shifts = []
    for frame in range(40):
        if frame == death:
            walk.client.dead = True
        walk.client.answered = 100
        shifts.append(walk.step()[1])
    assert shifts == sorted(shifts), "the map does not go back to what it was before"
    walk.line.finish()
    results = walk.line.results()
    assert results.frame.newest[0, 3] == len(walk.store) == len(results.stamps_ns)
    assert results.g2o == f"graph of {len(walk.store)}"
    assert walk.client.added == list(range(len(walk.store)))
    assert walk.line.state is not None and walk.line.state.finished
    assert len(walk.clients) == 2


@pytest.mark.parametrize("moment", ["before the end", "at the end", "after it"])
def test_work_that_dies_at_the_end_of_the_walk_is_done_again(walk: HeldWalk, moment: str) -> None:
    for _ in range(20):
        walk.step()
    walk.client.dead = moment == "before the end"
    walk.line.finish()
    walk.client.dead |= moment == "at the end"
    walk.client.answered = 100
    walk.line.poll()
    walk.client.dead |= moment == "after it"
    results = walk.line.results()
    assert len(walk.clients) == 2
    assert walk.line.state is not None and walk.line.state.finished
    assert results.g2o == "graph of 7"


def test_what_the_user_asked_is_answered_by_whoever_comes_after_a_death(walk: HeldWalk) -> None:
    for _ in range(20):
        walk.step()
    walk.line.command(ApplyEdit(Accept(0, 2)))  # not answered yet
    walk.client.dead = True
    walk.line.poll()
    walk.line.command(ApplyEdit(Accept(0, 3)))  # while the keyframes are handed over again
    assert not walk.line.idle
    while not walk.line.idle:
        walk.client.answered = 100
        walk.line.poll()  # no frame need come for it
    assert walk.line.state is not None and walk.line.state.undo == (Accept(0, 2), Accept(0, 3))
    asked = [request for request in walk.client.requests if isinstance(request, AddKeyframe | ApplyEdit)]
    assert asked[-2:] == [ApplyEdit(Accept(0, 2)), ApplyEdit(Accept(0, 3))], "once all keyframes are there"
    assert walk.line.frame.newest[0, 3] == 7, "a command acts on all there is"


def test_keyframes_handed_over_again_are_looked_at_with_the_parameters_of_then(walk: HeldWalk) -> None:
    given = [LoopsParams(min_time=10.0 + k) for k in range(10)]
    for frame in range(30):
        walk.step(given[frame // EVERY])
    walk.client.dead = True
    walk.line.results()
    assert len(walk.clients) == 2
    assert walk.client.params == given


def test_going_back_while_keyframes_are_handed_over_again(walk: HeldWalk) -> None:
    for _ in range(40):
        walk.step()
    walk.client.dead = True
    walk.line.poll()
    walk.go_to(23)
    for _ in range(30):
        walk.client.answered = 1
        walk.step()
    while not walk.line.idle:
        walk.client.answered = 100
        walk.line.poll()
    walk.step()
    assert walk.line.frame.newest[0, 3] == shift_at(walk.frame - 1)
    assert walk.line.take_alarms() == ["It is gone. It is started again; loops follow once it has caught up."]
    assert walk.line.take_notices() == []


def test_work_given_up_answers_that_at_once_and_nobody_waits_for_it(walk: HeldWalk) -> None:
    for _ in range(10):
        walk.step()
    walk.line.command(Undo())
    for _ in range(MOST_DEATHS + 1):
        walk.client.dead = True
        walk.line.poll()
    assert [type(answer) for answer in walk.line.take_answers()] == [Failure]
    walk.go_to(5)
    walk.step()
    assert walk.line.idle
    walk.line.results()


ACTIONS = st.lists(
    st.sampled_from(["step", "step", "answer", "poll", "die", "back", "differently", "command"]), max_size=60
)


@settings(max_examples=150, deadline=None)
@given(ACTIONS)
def test_whatever_happens_the_end_is_that_of_the_walk_and_no_command_is_lost(actions: list[str]) -> None:
    walk, commands = HeldWalk(), list[LoopEdit]()
    for number, action in enumerate(actions):
        match action:
            case "step":
                walk.step()
            case "answer":
                walk.client.answered += 2
            case "poll":
                walk.line.poll()
            case "die":
                walk.client.dead = len(walk.clients) <= MOST_DEATHS
            case "back" | "differently":
                walk.go_to(walk.frame // 2)
                if action == "differently":
                    walk.line.forget_after(walk.frame - 1)
                walk.step()
            case "command":
                commands.append(Accept(0, number + 1))
                walk.line.command(ApplyEdit(commands[-1]))
    walk.line.finish()
    results = walk.line.results()
    assert results.g2o == f"graph of {len(walk.store)}"
    assert walk.client.count == len(walk.store) == len(results.stamps_ns)
    assert walk.line.idle
    assert walk.line.state is not None
    assert walk.line.state.undo == tuple(commands)
    assert walk.line.state.finished
    assert walk.line.state.count == len(walk.store)
    walk.store.close()
