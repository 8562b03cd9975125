"""A session whose loop search runs in a worker that the test can hold back, let answer, and kill."""

from collections import deque

import numpy as np

from app.child import ChildDied
from app.mapping.loops import RestartingLoops
from app.slam.keyframes import KeyframeStore
from app.slam.loops.edits import Edits
from app.slam.loops.keyframe_log import KeyframeLog
from app.slam.loops.messages import Added, AddKeyframe, Answered, ApplyEdit, AskG2o, LoopState, Reply, Request
from app.slam.loops.schedule import LoopSchedule
from app.slam.loops.types import Evidence, LoopEdge, Verdict
from app.slam.sections import LoopsParams
from app.slam.types import Cloud, Keyframe

LOOPS = LoopsParams()
LATENCY = 5
EVERY = 3  # frames between keyframes


class Worker:
    """Finds with every keyframe but the first a loop that shifts the map by as many metres as there are before it.

    Answers once `answered` is raised, or at once when somebody waits for it.
    """

    def __init__(self) -> None:
        self.requests: list[Request] = []
        self.params: list[LoopsParams] = []  # of the keyframes that it holds
        self.added: list[int] = []
        self.answered = 0
        self.waits = 0
        self.dead = False
        self._pending: deque[Reply] = deque()

    @property
    def pending(self) -> int:
        return len(self._pending)

    def send(self, request: Request) -> None:
        self.requests.append(request)
        assert len(self.requests) < 10_000, "questions never end"
        if isinstance(request, AddKeyframe):
            index = request.keyframe.index
            assert index <= len(self.params), "keyframes come in their order"
            del self.params[index:]
            self.params.append(request.params)
            self.added.append(index)
            self._pending.append(Added(len(self.params)))
            return
        count = min(request.target.count, len(self.params))
        edits = request.target.edits
        match request.question:
            case AskG2o():
                self._pending.append(Answered(request.question, f"graph of {count}"))
                return
            case ApplyEdit(edit):
                edits = Edits((*edits.done, edit))
        self._pending.append(state(count, edits, finished=request.target.finished))

    def receive(self, timeout: float | None = None) -> Reply | None:
        if self.dead:
            raise ChildDied("The worker", -9)
        if not self._pending:
            return None
        if timeout is None:
            self.waits += 1
        elif not self.answered:
            return None
        elif not isinstance(self._pending[0], Added):
            self.answered -= 1
        return self._pending.popleft()

    def close(self) -> None:
        pass


def state(count: int, edits: Edits, *, finished: bool) -> LoopState:
    shifted = np.tile(np.eye(4), (count, 1, 1))
    shifted[:, 0, 3] = count - 1
    return LoopState(count, finished, shifted, (edge(count - 1),) if count > 1 else (), edits.done, edits.undone)


def edge(newer: int) -> LoopEdge:
    return LoopEdge(0, newer, newer, np.eye(4), np.eye(6), Evidence(), Verdict.ACCEPTED, "it fits")


class HeldSession:
    """Every third frame is a keyframe, 30 s after the one before; the first is frame 0."""

    def __init__(self, store: KeyframeStore | None = None) -> None:
        self.store = KeyframeStore() if store is None else store
        self.workers: list[Worker] = []
        self.loops = LoopSchedule(self._client, self.store, LoopsParams(latency=LATENCY))
        self.frame = 0

    def _client(self, log: KeyframeLog) -> RestartingLoops:
        return RestartingLoops(log, self._worker)

    def _worker(self) -> Worker:
        self.workers.append(Worker())
        return self.workers[-1]

    @property
    def worker(self) -> Worker:
        return self.workers[-1]

    @property
    def shift(self) -> float:
        """m, of the map."""
        return float(self.loops.frame.newest[0, 3])

    def step(self, params: LoopsParams = LOOPS) -> tuple[tuple[LoopEdge, ...], float]:
        """The next frame: loops that came into effect, and the map's shift."""
        news = self.loops.due(self.frame)
        if self.frame % EVERY == 0:
            keyframe = a_keyframe(len(self.store), self.frame)
            self.store.append(keyframe)
            self.loops.add(keyframe, params)
        self.frame += 1
        return news, self.shift

    def go_to(self, frame: int) -> None:
        self.frame = frame
        self.store.truncate(-(-frame // EVERY))
        self.loops.go_to(frame)

    def until_idle(self) -> None:
        """No frame need come for it."""
        while not self.loops.idle:
            self.worker.answered = 100
            self.loops.poll()


def a_keyframe(index: int, frame: int) -> Keyframe:
    none = Cloud(*(np.zeros(shape, dtype) for shape, dtype in CLOUD))
    return Keyframe(index, frame, 10**10 * frame, np.eye(4), np.eye(4), np.eye(6), none)


CLOUD = (((0, 3), np.float32), (0, np.uint8), (0, np.float32), (0, np.uint16), (0, np.int32))


def shift_at(frame: int) -> int:
    """Keyframes after the first that are `LATENCY` frames past at a frame."""
    return max(0, (frame - LATENCY) // EVERY)
