"""The loop back end behind one method, and the client that runs it in the caller's own process."""

from collections import deque
from collections.abc import Mapping

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops.backend import LoopBackend
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
    Reply,
    Request,
    Residuals,
    Tried,
    TryOut,
    Undo,
)
from app.slam.loops.types import LoopEdge, Pair


class LoopService:
    """Answers requests, one after the other; deterministic."""

    def __init__(self) -> None:
        self._backend = LoopBackend()
        self._told: Mapping[Pair, LoopEdge] = {}

    def handle(self, request: Request) -> Reply:
        """The answer. What can not be done gives a `Failure`, never an exception."""
        try:
            return self._handle(request)
        except HemislamError as error:
            return Failure(str(error))

    def close(self) -> None:
        self._backend.close()

    def _handle(self, request: Request) -> Reply:
        backend = self._backend
        match request:
            case AddKeyframe(keyframe, params):
                backend.add(keyframe, params)
            case GoTo(count, forget):
                backend.go_to(count)
                if forget:
                    backend.forget()
            case Finish():
                backend.finish()
            case ApplyEdit(command):
                backend.apply(command)
            case Undo():
                backend.undo()
            case Redo():
                backend.redo()
            case LoadCommands(commands, redo):
                backend.load(commands, redo)
            case TryOut(command):
                return Tried(command, backend.preview(command))
            case Inspect(older, newer):
                return Inspected((older, newer), backend.detail(older, newer))
            case AskResiduals():
                return Residuals(backend.factor_residuals())
            case AskG2o():
                return G2o(backend.g2o())
        return self._state()

    def _state(self) -> LoopState:
        backend = self._backend
        edges = backend.by_pair
        changed = tuple(edge for pair, edge in edges.items() if _differs(edge, self._told.get(pair)))
        self._told = edges
        corrections = backend.corrections
        corrections.setflags(write=False)
        return LoopState(
            count=len(backend),
            known=backend.known,
            finished=backend.finished,
            corrections=corrections,
            edges=tuple(edges.values()),
            changed=changed,
            undo=backend.commands,
            redo=backend.undone,
            notices=backend.take_notices(),
        )


class InlineLoops:
    """Answers at once, in this process."""

    def __init__(self) -> None:
        self._service = LoopService()
        self._replies: deque[Reply] = deque()

    @property
    def pending(self) -> int:
        return len(self._replies)

    def send(self, request: Request) -> None:
        self._replies.append(self._service.handle(request))

    def receive(self, timeout: float | None = None) -> Reply | None:
        return self._replies.popleft() if self._replies else None

    def close(self) -> None:
        self._service.close()


def _differs(edge: LoopEdge, before: LoopEdge | None) -> bool:
    if edge is before:
        return False
    return (
        before is None
        or (edge.verdict, edge.weight) != (before.verdict, before.weight)
        or not np.array_equal(edge.T_older_newer, before.T_older_newer)
    )
