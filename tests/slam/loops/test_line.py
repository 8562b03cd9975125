"""When what was found takes effect: at a frame that depends on nothing but the walk."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.slam.keyframes import KeyframeStore
from app.slam.loops.line import MOST_DEATHS, LoopLine
from app.slam.loops.messages import (
    AddKeyframe,
    AskG2o,
    Failure,
    Finish,
    G2o,
    GoTo,
    LoadCommands,
    LoopState,
    LoopWorkerDied,
    Overrule,
    Reply,
    Request,
    Undo,
)
from app.slam.loops.types import Accept, Command, Evidence, LoopEdge, Verdict
from app.slam.params import Loops
from app.slam.types import Cloud, Keyframe

LOOPS = Loops()
LATENCY = 5
EVERY = 3  # frames between keyframes


class Client:
    """Finds with every keyframe a loop that shifts the map by as many metres as there are keyframes.

    Answers once `answered` is raised, or at once when somebody waits for it.
    """

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.added: list[int] = []
        self.params: list[Loops] = []
        self.count = self.known = 0
        self.answered = 0
        self.waits = 0
        self.dead = False
        self._pending: deque[Reply] = deque()
        self._commands: tuple[Command, ...] = ()

    @property
    def pending(self) -> int:
        return len(self._pending)

    def send(self, request: Request) -> None:
        self.requests.append(request)
        match request:
            case AddKeyframe(keyframe, params):
                assert keyframe.index == self.count, "keyframes come in their order"
                self.count += 1
                self.known = max(self.known, self.count)
                self.added.append(keyframe.index)
                self.params.append(params)
            case GoTo(count, _):
                assert count <= self.known
                self.count = count
            case Overrule(command):
                self._commands = (*self._commands, command)
            case LoadCommands(commands, _):
                self._commands = commands
            case AskG2o():
                self._pending.append(G2o(f"graph of {self.count}"))
                return
        self._pending.append(replace(state(self.count, self._commands), finished=isinstance(request, Finish)))

    def receive(self, timeout: float | None = None) -> Reply | None:
        if self.dead:
            raise LoopWorkerDied("It is gone.")
        if not self._pending:
            return None
        if timeout is None:
            self.waits += 1
        elif not self.answered:
            return None
        else:
            self.answered -= 1
        return self._pending.popleft()

    def close(self) -> None:
        pass


def state(count: int, commands: tuple[Command, ...] = ()) -> LoopState:
    shifted = np.tile(np.eye(4), (count, 1, 1))
    shifted[:, 0, 3] = count
    found = (edge(count - 1),) if count else ()
    return LoopState(count, count, False, shifted, found, found, commands, (), ())


def edge(newer: int) -> LoopEdge:
    return LoopEdge(0, newer, newer, np.eye(4), np.eye(6), Verdict.ACCEPTED, "it fits", Evidence())


class Walk:
    """Every third frame is a keyframe; the first is frame 0."""

    def __init__(self) -> None:
        self.store = KeyframeStore()
        self.clients: list[Client] = []
        self.line = LoopLine(self._client, self.store, Loops(latency=LATENCY))
        self.frame = 0

    def _client(self) -> Client:
        self.clients.append(Client())
        return self.clients[-1]

    @property
    def client(self) -> Client:
        return self.clients[-1]

    def step(self, params: Loops = LOOPS) -> tuple[tuple[LoopEdge, ...], float]:
        """The next frame: loops that came into effect, and the map's shift."""
        news = self.line.due(self.frame)
        if self.frame % EVERY == 0:
            keyframe = a_keyframe(len(self.store), self.frame)
            self.store.append(keyframe)
            self.line.add(keyframe, params)
        self.frame += 1
        return news, float(self.line.frame.newest[0, 3])

    def go_to(self, frame: int) -> None:
        self.frame = frame
        self.store.truncate(-(-frame // EVERY))
        self.line.go_to(frame)


def a_keyframe(index: int, frame: int) -> Keyframe:
    none = Cloud(*(np.zeros(shape, dtype) for shape, dtype in CLOUD))
    return Keyframe(index, frame, 100 * frame, np.eye(4), np.eye(4), np.eye(6), none)


CLOUD = (((0, 3), np.float32), (0, np.uint8), (0, np.float32), (0, np.uint16), (0, np.int32))


@pytest.fixture
def walk() -> Iterator[Walk]:
    walk = Walk()
    yield walk
    walk.store.close()


def shift_at(frame: int) -> int:
    """Keyframes that are `LATENCY` frames past at a frame."""
    return 0 if frame < LATENCY else (frame - LATENCY) // EVERY + 1


@pytest.mark.parametrize("speed", [0, 1, 100])
def test_a_loop_takes_effect_at_its_frame_however_fast_the_work_is(walk: Walk, speed: int) -> None:
    for frame in range(40):
        walk.client.answered = speed
        news, shift = walk.step()
        assert shift == shift_at(frame)
        assert [e.newer for e in news] == ([shift - 1] if shift != shift_at(frame - 1) else [])
    assert bool(walk.client.waits) == (speed == 0)


def test_nobody_waits_for_work_that_is_done_in_time(walk: Walk) -> None:
    for _ in range(30):
        walk.client.answered = 1
        walk.step()
    assert walk.client.waits == 0


@pytest.mark.parametrize("frame", [1, 7, 20, 28])
def test_gone_back_and_on_again_every_frame_is_as_it_was(walk: Walk, frame: int) -> None:
    before = [walk.step() for _ in range(30)]
    sent = len(walk.client.added)
    walk.go_to(frame)
    again = [walk.step() for _ in range(frame, 30)]
    assert [shift for _, shift in again] == [shift for _, shift in before[frame:]]
    assert len(walk.client.added) == sent, "what is known is not handed over twice"


def test_a_step_back_waits_for_nobody(walk: Walk) -> None:
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
def test_before_the_first_loop_counts_nobody_is_asked_for_it(walk: Walk, frame: int) -> None:
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


def test_a_command_given_just_before_going_back_is_not_lost(walk: Walk) -> None:
    for _ in range(30):
        walk.step()
    walk.line.command(Overrule(Accept(0, 2)))
    walk.go_to(20)
    walk.step()
    assert walk.line.state is not None and walk.line.state.undo == (Accept(0, 2),)
    assert walk.line.frame.newest[0, 3] == shift_at(20)


def test_a_walk_that_goes_on_differently_hands_its_keyframes_over_anew(walk: Walk) -> None:
    for _ in range(30):
        walk.step()
    walk.go_to(10)
    walk.line.forget_after(9)
    walk.client.added.clear()
    for _ in range(10, 20):
        walk.step()
    assert walk.client.added == [4, 5, 6]


def test_a_command_takes_effect_when_it_is_answered_and_holds(walk: Walk) -> None:
    for _ in range(10):
        walk.step()
    walk.line.command(Overrule(Accept(0, 2)))
    assert not walk.line.idle
    walk.client.answered = 10
    walk.line.poll()
    assert walk.line.idle and walk.line.state is not None
    assert walk.line.state.undo == (Accept(0, 2),)
    for _ in range(20):
        walk.step()
    assert walk.line.state.undo == (Accept(0, 2),)


def test_work_that_died_is_begun_again_with_all_keyframes_and_commands(walk: Walk) -> None:
    for _ in range(20):
        walk.step()
    walk.line.command(Overrule(Accept(0, 2)))
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


def test_work_that_keeps_dying_is_given_up_and_frames_go_on(walk: Walk) -> None:
    for _ in range(60):
        walk.client.dead = True
        walk.step()
    assert len(walk.clients) == MOST_DEATHS + 1
    assert any("stay as they are" in alarm for alarm in walk.line.take_alarms())
    walk.line.command(Overrule(Accept(0, 2)))
    assert any(isinstance(answer, Failure) for answer in walk.line.take_answers())


@pytest.mark.parametrize("death", range(1, 40, 4))
def test_whenever_the_work_dies_the_end_is_the_same_and_what_came_into_effect_stays(walk: Walk, death: int) -> None:
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
def test_work_that_dies_at_the_end_of_the_walk_is_done_again(walk: Walk, moment: str) -> None:
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


def test_what_the_user_asked_is_answered_by_whoever_comes_after_a_death(walk: Walk) -> None:
    for _ in range(20):
        walk.step()
    walk.line.command(Overrule(Accept(0, 2)))  # not answered yet
    walk.client.dead = True
    walk.line.poll()
    walk.line.command(Overrule(Accept(0, 3)))  # while the keyframes are handed over again
    assert not walk.line.idle
    while not walk.line.idle:
        walk.client.answered = 100
        walk.line.poll()  # no frame need come for it
    assert walk.line.state is not None and walk.line.state.undo == (Accept(0, 2), Accept(0, 3))
    asked = [request for request in walk.client.requests if isinstance(request, AddKeyframe | Overrule)]
    assert asked[-2:] == [Overrule(Accept(0, 2)), Overrule(Accept(0, 3))], "once all keyframes are there"
    assert walk.line.frame.newest[0, 3] == 7, "a command acts on all there is"


def test_keyframes_handed_over_again_are_looked_at_with_the_parameters_of_then(walk: Walk) -> None:
    given = [Loops(min_time=10.0 + k) for k in range(10)]
    for frame in range(30):
        walk.step(given[frame // EVERY])
    walk.client.dead = True
    walk.line.results()
    assert len(walk.clients) == 2
    assert walk.client.params == given


def test_going_back_while_keyframes_are_handed_over_again(walk: Walk) -> None:
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


def test_work_given_up_answers_that_at_once_and_nobody_waits_for_it(walk: Walk) -> None:
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
    walk, commands = Walk(), list[Command]()
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
                walk.line.command(Overrule(commands[-1]))
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
