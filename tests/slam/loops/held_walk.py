"""A walk whose loop work is done by a client that the test holds back, lets answer, and kills."""

from collections import deque
from dataclasses import replace

import numpy as np

from app.slam.keyframes import KeyframeStore
from app.slam.loops.line import LoopLine
from app.slam.loops.messages import (
    AddKeyframe,
    ApplyEdit,
    AskG2o,
    Finish,
    G2o,
    GoTo,
    LoadCommands,
    LoopState,
    LoopWorkerDied,
    Reply,
    Request,
)
from app.slam.loops.types import Evidence, LoopEdge, LoopEdit, Measured, Verdict
from app.slam.params import LoopsParams
from app.slam.types import Cloud, Keyframe

LOOPS = LoopsParams()
LATENCY = 5
EVERY = 3  # frames between keyframes


class Client:
    """Finds with every keyframe a loop that shifts the map by as many metres as there are keyframes.

    Answers once `answered` is raised, or at once when somebody waits for it.
    """

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.added: list[int] = []
        self.params: list[LoopsParams] = []
        self.count = self.known = 0
        self.answered = 0
        self.waits = 0
        self.dead = False
        self._pending: deque[Reply] = deque()
        self._commands: tuple[LoopEdit, ...] = ()

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
            case ApplyEdit(command):
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


def state(count: int, commands: tuple[LoopEdit, ...] = ()) -> LoopState:
    shifted = np.tile(np.eye(4), (count, 1, 1))
    shifted[:, 0, 3] = count
    found = (edge(count - 1),) if count else ()
    return LoopState(count, count, False, shifted, found, found, commands, (), ())


def edge(newer: int) -> LoopEdge:
    measured = Measured(np.eye(4), np.eye(6), Evidence())
    return LoopEdge(0, newer, newer, measured, Verdict.ACCEPTED, "it fits")


class HeldWalk:
    """Every third frame is a keyframe; the first is frame 0."""

    def __init__(self) -> None:
        self.store = KeyframeStore()
        self.clients: list[Client] = []
        self.line = LoopLine(self._client, self.store, LoopsParams(latency=LATENCY))
        self.frame = 0

    def _client(self) -> Client:
        self.clients.append(Client())
        return self.clients[-1]

    @property
    def client(self) -> Client:
        return self.clients[-1]

    def step(self, params: LoopsParams = LOOPS) -> tuple[tuple[LoopEdge, ...], float]:
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


def shift_at(frame: int) -> int:
    """Keyframes that are `LATENCY` frames past at a frame."""
    return 0 if frame < LATENCY else (frame - LATENCY) // EVERY + 1
