"""The loop back end in a process of its own. The walks are short: what is found is tested in tests/slam/loops."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from app.child import Child, ChildDied, Link
from app.mapping.loop_process import LoopProcess
from app.slam import lie
from app.slam.loops.messages import Added, AddKeyframe, ApplyEdit, Ask, LoopState, Request, Target
from app.slam.loops.service import LoopService
from app.slam.loops.types import Add, Edits, Reject, difference, rows
from app.slam.sections import LoopsParams
from app.slam.types import NON_GROUND, Cloud, Keyframe

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


def test_it_answers_as_one_in_this_process_would(process: LoopProcess) -> None:
    far = rows(lie.transform(np.eye(3), np.array([0.5, 0.1, 0.0])))
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
    inline = LoopService()
    for request in requests:
        process.send(request)
    assert process.pending == len(requests)
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
    assert process.pending == 0
    assert process.receive() is None, "nothing is pending"


def test_sending_does_not_wait_for_a_stopped_process(process: LoopProcess) -> None:
    """Stopped, it takes nothing: far more than a pipe holds is handed over all the same, and answered afterwards."""
    os.kill(process.pid, signal.SIGSTOP)
    many = keyframes(12, points=60_000)  # 27 bytes each
    for keyframe in many:
        process.send(AddKeyframe(keyframe, PARAMS))
    assert process.receive(0.05) is None
    assert process.pending == len(many)
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
    owner = Child(_owner, name="owner", title="The owner")
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
    assert process.pending == 0
    assert process.receive() is None
