"""The loop search in a worker that may die: it is replaced by a new one, which is sent what it lacks."""

from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from app.child import ChildDied, RestartLimit
from app.mapping.loop_process import LoopProcess
from app.slam.loops.keyframe_log import Follower, KeyframeLog
from app.slam.loops.messages import Added, Answer, Ask, Failure, Reply, Request

MOST_DEATHS: Final = 3
"""A worker is replaced this many times; after that, loops stay as they are."""
GIVEN_UP: Final = "Loops are no longer looked for; restart to try again."
MOST_PENDING: Final = 4
"""Requests that a new worker is sent at a time, so that keyframes do not pile up in memory."""


class LoopWorker(Protocol):
    """Answers requests one by one, in order; for example a process."""

    @property
    def pending(self) -> int:
        """Requests whose replies were not received yet."""

    def send(self, request: Request) -> None:
        """Hand a request over. Never waits for the answer."""

    def receive(self, timeout: float | None = None) -> Reply | None:
        """The reply to the oldest pending request; None if there is none within the time (s).

        Raises:
            ChildDied: there will be no answer.
        """

    def close(self) -> None:
        """Release all resources; pending requests are dropped."""


class RestartingLoops:
    """A `LoopClient` whose worker is replaced when it dies.

    Args:
        log: the keyframes that it follows. make: makes a worker.
    """

    def __init__(self, log: KeyframeLog, make: Callable[[], LoopWorker] = LoopProcess) -> None:
        self._make, self._log = make, log
        self._worker, self._follower = make(), Follower(log)
        self._unsent: deque[Ask] = deque()
        self._sent: deque[Ask | None] = deque()  # None: a keyframe
        self._limit, self._given_up = RestartLimit(MOST_DEATHS), False
        self._lost = 0  # keyframes that the worker before had been sent
        self._alarms: list[str] = []

    def send(self, ask: Ask) -> None:
        self._unsent.append(ask)
        self._feed()

    def receive(self, timeout: float | None = None) -> Answer | None:
        while self._sent and not self._given_up:
            try:
                reply = self._worker.receive(timeout)
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
        self._worker.close()

    @property
    def catching_up(self) -> bool:
        """Whether a new worker has yet to be sent what the one before had."""
        return bool(self._unsent) and self._follower.length < max(self._lost, self._log.stored)

    def _feed(self) -> None:
        """Send the questions, each after the keyframes that the worker lacks for it."""
        if self._given_up:
            return
        while self._unsent:
            target = self._unsent[0].target
            if self.catching_up and self._worker.pending >= MOST_PENDING:
                return
            keyframe = self._follower.next(target)
            self._sent.append(None if keyframe is not None else self._unsent[0])
            self._worker.send(keyframe or self._unsent.popleft())

    def _replace(self, error: ChildDied) -> None:
        """Begin again with a new worker: what was not answered is asked again."""
        self._given_up = not self._limit.allows()
        self._worker.close()
        self._unsent.extendleft(reversed([ask for ask in self._sent if ask is not None]))
        self._sent.clear()
        if self._given_up:
            self._alarms.append(f"{error} Loops stay as they are from here on; restart to look for them again.")
            return
        self._alarms.append(f"{error} It is started again; loops follow once it has caught up.")
        self._worker, self._lost, self._follower = self._make(), self._follower.length, Follower(self._log)
        self._feed()
