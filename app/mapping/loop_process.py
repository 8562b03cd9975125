"""The loop back end in a process of its own, so that the frame loop never waits for it."""

import os
from dataclasses import replace
from typing import Final

from app.child import Child, Link
from app.slam.loops.messages import LoopState, Reply, Request
from app.slam.loops.types import LoopChange, LoopEdge, changed_by, difference

NICENESS: Final = 10
"""The frame loop comes first."""
_ONE_THREAD: Final = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "NUMBA", "OPENBLAS", "MKL")}
"""More threads would compete with the frame loop for the cores."""


class LoopProcess:
    """A `LoopWorker` whose back end runs in a process of its own. Used by one thread."""

    def __init__(self) -> None:
        self._child = Child(
            main, name="loops", title="The process that looks for loops", environment=_ONE_THREAD, grace_s=0.0
        )
        self._pending = 0
        self._edges: tuple[LoopEdge, ...] = ()

    @property
    def pid(self) -> int:
        return self._child.pid

    @property
    def pending(self) -> int:
        """Requests whose replies were not received yet."""
        return self._pending

    def send(self, request: Request) -> None:
        """Send a request, whose arrays must not change any more. Never waits, not even if the process is dead."""
        self._pending += 1
        self._child.send(request)

    def receive(self, timeout: float | None = None) -> Reply | None:
        """The answer to the oldest request that has none yet; None if there is none within the time (s).

        None at once if nothing is pending; `timeout` None waits without a limit.

        Raises:
            ChildDied: it will never come.
        """
        if not self._pending:
            return None
        message: tuple[Reply, LoopChange | None] | None = self._child.receive(timeout)
        if message is None:
            return None
        self._pending -= 1
        reply, change = message
        if not isinstance(reply, LoopState) or change is None:
            return reply
        if any(change):
            self._edges = changed_by(change, self._edges)
        return replace(reply, edges=self._edges)

    def close(self) -> None:
        """End the process; pending requests are dropped."""
        self._child.close()
        self._pending = 0


def main(owner: Link) -> None:
    """The process: answers requests in their order."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    from app.slam.loops.service import LoopService, warm_up  # the owner does not need the solver

    warm_up()
    service = LoopService()
    edges: tuple[LoopEdge, ...] = ()
    while True:
        reply = service.handle(owner.receive())
        if isinstance(reply, LoopState):
            change, edges = difference(edges, reply.edges), reply.edges
            owner.send((replace(reply, edges=()), change))
        else:
            owner.send((reply, None))
