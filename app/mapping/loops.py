"""The loop search in a process of its own, so that the frame loop never waits for it. If it dies, it is replaced."""

import os
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from app.child import Child, ChildDied, Link, RestartLimit
from app.slam.loops.keyframe_log import Follower, KeyframeLog
from app.slam.loops.messages import Added, Answer, Ask, Failure, LoopState, Reply
from app.slam.loops.types import LoopChange, LoopEdge, changed_by, difference

NICENESS: Final = 10
"""The frame loop comes first."""
MOST_DEATHS: Final = 3
"""A worker is replaced this many times; after that, loops stay as they are."""
GIVEN_UP: Final = "Loops are no longer looked for; restart to try again."
MOST_PENDING: Final = 4
"""Most requests sent to a new worker at a time, so that keyframes do not pile up in memory."""


class LoopProcess(Child):
    """A process that answers requests one by one, in order. Used by one thread."""

    def __init__(self) -> None:
        title = "The process that looks for loops"
        super().__init__(main, name="loops", title=title, fork=True, grace_s=0.0)
        self._edges: tuple[LoopEdge, ...] = ()

    def receive(self, timeout: float | None = None) -> Reply | None:
        """The reply to the oldest request that has none yet; None if there is none within the time (s).

        Raises:
            ChildDied: the reply will never come.
        """
        message: tuple[Reply, LoopChange | None] | None = super().receive(timeout)
        if message is None:
            return None
        reply, change = message
        if not isinstance(reply, LoopState) or change is None:
            return reply
        if any(change):
            self._edges = changed_by(change, self._edges)
        return replace(reply, edges=self._edges)


class RestartingLoops:
    """A `LoopClient` whose process, which `make` starts, is replaced when it dies."""

    def __init__(self, log: KeyframeLog, make: Callable[[], LoopProcess] = LoopProcess) -> None:
        self._make, self._log = make, log
        self._process, self._follower = make(), Follower(log)
        self._unsent: deque[Ask] = deque()
        self._sent: deque[Ask | None] = deque()  # None: a keyframe
        self._limit, self._given_up = RestartLimit(MOST_DEATHS), False
        self._lost = 0  # number of keyframes sent to the previous process
        self._alarms: list[str] = []

    def send(self, ask: Ask) -> None:
        self._unsent.append(ask)
        self._feed()

    def receive(self, timeout: float | None = None) -> Answer | None:
        while self._sent and not self._given_up:
            try:
                reply = self._process.receive(timeout)
            except ChildDied as error:
                self._replace(error)
                return None
            if reply is None:
                return None
            asked = self._sent.popleft()
            self._feed()
            if asked is not None and not isinstance(reply, Added):
                return reply
            if isinstance(reply, Failure):
                self._alarms.append(reply.text)
        if self._given_up and self._unsent:
            self._unsent.popleft()
            return Failure(GIVEN_UP)
        return None

    def take_alarms(self) -> list[str]:
        taken, self._alarms = self._alarms, []
        return taken

    def close(self) -> None:
        self._process.close()
        self._sent.clear()
        self._unsent.clear()

    @property
    def catching_up(self) -> bool:
        """Whether a new process still lacks keyframes that the previous one had."""
        return bool(self._unsent) and self._follower.length < max(self._lost, self._log.stored)

    def _feed(self) -> None:
        """Send the questions, each after the keyframes that the process lacks for it."""
        if self._given_up:
            return
        while self._unsent:
            target = self._unsent[0].target
            if self.catching_up and len(self._sent) >= MOST_PENDING:
                return
            keyframe = self._follower.next(target)
            self._sent.append(None if keyframe is not None else self._unsent[0])
            self._process.send(keyframe or self._unsent.popleft())

    def _replace(self, error: ChildDied) -> None:
        """Begin again with a new process, which gets all unanswered questions again."""
        self._given_up = not self._limit.allows()
        self._process.close()
        self._unsent.extendleft(reversed([ask for ask in self._sent if ask is not None]))
        self._sent.clear()
        if self._given_up:
            self._alarms.append(f"{error} Loops stay as they are from here on; restart to look for them again.")
            return
        self._alarms.append(f"{error} It is started again; loops follow once it has caught up.")
        self._process, self._lost, self._follower = self._make(), self._follower.length, Follower(self._log)
        self._feed()


def main(owner: Link) -> None:
    """The process: answers requests in their order."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    from app.slam.loops.backend import LoopBackend  # the owner does not need the solver
    from app.slam.loops.service import warm_up

    warm_up()
    backend = LoopBackend()
    edges: tuple[LoopEdge, ...] = ()
    while True:
        reply = backend.handle(owner.receive())
        if isinstance(reply, LoopState):
            change, edges = difference(edges, reply.edges), reply.edges
            owner.send((replace(reply, edges=()), change))
        else:
            owner.send((reply, None))
