"""Loop work beside the frames: keyframes go out, what was found comes back a fixed number of frames later.

Whoever does the work (`LoopClient`: in this process or in another) takes the time it takes; what was
found with a keyframe takes effect `loops.latency` frames after it, no sooner and no later. So the
poses shown never depend on the speed of the machine, and a frame waits only if the work is late.
What the user commands takes effect as soon as it is answered.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.slam.keyframes import KeyframeStore
from app.slam.loops.files import LoopResults
from app.slam.loops.known import KnownKeyframes
from app.slam.loops.messages import (
    AddKeyframe,
    AskG2o,
    Failure,
    Finish,
    G2o,
    GoTo,
    LoadCommands,
    LoopClient,
    LoopState,
    LoopWorkerDied,
    Reply,
    Request,
)
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.map_frame import MapFrame
from app.slam.params import LoopsParams
from app.slam.types import Keyframe

MOST_DEATHS = 3
"""So often the work is begun again when it dies; after that, loops stay as they are."""
GIVEN_UP = "Loops are no longer worked on; restart to try again."
MOST_PENDING = 4
"""Keyframes handed over again that wait at the worker's."""


@dataclass(slots=True)
class _Asked:
    """An answer that is outstanding.

    Attributes:
        keyframes: it is the state after so many of them, and takes effect when they are due; None:
            it answers the user. void: it is not waited for, or no longer; only failures are told.
    """

    request: Request
    keyframes: int | None
    void: bool = False


class LoopLine:
    """The loops of one walk, as they count at its newest frame.

    Args:
        client: makes who does the work; called again if that dies.
        keyframes: of the walk.
        params: in force at the start; `latency` is read only here.

    Attributes:
        state: in effect; None before the first. frame: where that lays odometry in the map.
    """

    def __init__(self, client: Callable[[], LoopClient], keyframes: KeyframeStore, params: LoopsParams) -> None:
        self.state: LoopState | None = None
        self.frame = MapFrame()
        self._answers: list[Reply] = []
        self._notices: list[str] = []
        self._alarms: list[str] = []
        self._make_client = client
        self._client = client()
        self._keyframes = keyframes
        self._params = params
        self._latency = params.latency
        self._known = KnownKeyframes()
        self._count = 0
        self._due = 0  # keyframes whose loops count at the newest frame
        self._in_effect = 0  # keyframes whose loops do; fewer only while the work is begun again
        self._finished = False
        self._asked: deque[_Asked] = deque()
        self._arrived: deque[tuple[int, LoopState]] = deque()
        self._news: list[LoopEdge] = []
        self._again: int | None = None  # the next keyframe to hand over again, after the work has died
        self._held: list[Request] = []  # the user's, until it has caught up
        self._deaths = 0
        self._elsewhere = False  # whoever does the work, in the walk: he is told where it is when he is needed

    # --- the walk --------------------------------------------------------------------------------
    def due(self, frame: int) -> tuple[LoopEdge, ...]:
        """Let take effect what must before this frame is processed, waiting for it if it is late.

        Returns:
            Candidates that are new by it or have another verdict.
        """
        self._due = min(self._known.until(frame - self._latency), self._count)
        self._take_due()
        while self._again is None and self._in_effect < self._due and self._receive(None):
            self._take_due()
        self.poll()
        news, self._news = tuple(self._news), []
        return news

    def add(self, keyframe: Keyframe, params: LoopsParams) -> None:
        """The walk has a new keyframe, or comes by a known one again."""
        index = self._count
        known = self._known.holds(index, keyframe.frame)
        self._count, self._finished = index + 1, False
        self._params = params
        if not known:
            self._known.put(keyframe, params)
        if self._again is None and known and index + 1 in self._known.states and not self._asked_for_state:
            self._arrived.append((index + 1, self._known.states[index + 1]))
            self._elsewhere = True
        elif self._again is None:
            self._ask(GoTo(index + 1) if known else AddKeyframe(keyframe, params), index + 1)

    def go_to(self, frame: int) -> None:
        """The walk went back, or forth again: `frame` is the next.

        Nothing waits here; the state follows with the next frame or `poll`.
        """
        self._finished = False
        commanded = False
        for asked in self._asked:
            asked.void = True
            if asked.keyframes is None and not isinstance(asked.request, Finish):
                self._known.forget_states()  # the user's command changes them all
                commanded = True
        self._arrived.clear()
        self._count = len(self._keyframes)
        self._due = min(self._known.until(frame - 1 - self._latency), self._count)
        if self._again is not None or self._count > len(self._known):  # or another engine's walk goes on here
            self._in_effect = -1
            self._begin_again()
            return
        if self._due == 0 and not commanded:
            self._known.remember(0, self._without_keyframes())
        wanted, states = range(self._due, self._count + 1), self._known.states
        if all(count in states for count in wanted):
            self._in_effect = self._due
            self._take(states[self._due])
            self._arrived.extend((count, states[count]) for count in wanted[1:])
            self._elsewhere = True
            return
        self._in_effect = -1
        for count in wanted:
            self._ask(GoTo(count), count)

    def forget_after(self, frame: int) -> None:
        """Keyframes after this frame will be others."""
        self._known.forget(max(self._known.until(frame), self._count))

    def never_go_back(self) -> None:
        """The walk only goes on: what would have to be known to go back is not kept."""
        self._known.states_bytes = 0

    def finish(self) -> None:
        """The walk has ended: look for loops of the last keyframes too, and let all take effect that comes."""
        self._finished = True
        if not self._given_up:
            self._ask(Finish(), None)

    def wait_ready(self) -> None:
        """Wait until the work can begin, so that no frame has to: a process of its own takes a second to start."""
        self._ask(GoTo(0), 0, void=True)
        self._settle()

    # --- the user --------------------------------------------------------------------------------
    def command(self, request: Request) -> None:
        """Ask on behalf of the user; `poll` until it is `idle` brings the answer."""
        self._ask(request, None)

    def poll(self) -> None:
        """Take in what has been answered, without waiting."""
        while self._asked and self._receive(0.0):
            pass
        self._hand_over_again()
        self._take_due()

    @property
    def idle(self) -> bool:
        """Whether every question of the user was answered and the state is that of this frame."""
        settled = self._again is None and all(asked.keyframes is not None for asked in self._asked)
        return settled and (self._in_effect >= 0 or self._given_up)

    # --- what there is ---------------------------------------------------------------------------
    @property
    def accepted(self) -> int:
        """Loops that count now."""
        edges = self.state.edges if self.state is not None else ()
        return sum(edge.verdict is Verdict.ACCEPTED for edge in edges)

    def take_notices(self) -> list[str]:
        """What the user should know, in sentences, since the last call."""
        taken, self._notices = self._notices, []
        return taken

    def take_alarms(self) -> list[str]:
        """The same of whoever does the work: what happened to it is no part of the walk."""
        taken, self._alarms = self._alarms, []
        return taken

    def take_answers(self) -> list[Reply]:
        """Replies to the user's questions since the last call."""
        taken, self._answers = self._answers, []
        return taken

    def results(self) -> LoopResults:
        """All that is written of loops, by all keyframes so far, whether in effect or not; waits for it."""
        self._ask(AskG2o(), None)
        self._settle()
        state = self._arrived[-1][1] if self._arrived else self.state
        texts = [answer.text for answer in self._answers if isinstance(answer, G2o)]
        self._answers = [answer for answer in self._answers if not isinstance(answer, G2o)]
        g2o = texts[-1] if texts else ""
        frame, edges = (MapFrame(), ()) if state is None else (self._lay(state), state.edges)
        return LoopResults(frame, self._known.stamps_ns(self._count), edges, g2o)

    def close(self) -> None:
        self._client.close()

    # --- the work --------------------------------------------------------------------------------
    @property
    def _asked_for_state(self) -> bool:
        """Whether the state of a keyframe is still outstanding."""
        return any(asked.keyframes is not None and not asked.void for asked in self._asked)

    @property
    def _given_up(self) -> bool:
        return self._deaths > MOST_DEATHS

    def _ask(self, request: Request, keyframes: int | None, *, void: bool = False) -> None:
        if self._given_up:
            if keyframes is None:
                self._answers.append(Failure(GIVEN_UP))
        elif self._again is not None and keyframes is None:
            self._held.append(request)
        else:
            if self._elsewhere and not isinstance(request, GoTo):
                count = request.keyframe.index if isinstance(request, AddKeyframe) else self._count
                self._send(GoTo(count), count, void=True)
            self._elsewhere = False
            self._send(request, keyframes, void=void)

    def _send(self, request: Request, keyframes: int | None, *, void: bool) -> None:
        self._asked.append(_Asked(request, keyframes, void))
        self._client.send(request)

    def _settle(self) -> None:
        """Wait until all that was asked is answered, begun again as often as it takes."""
        while self._asked or self._again is not None:
            self._receive(None)
            self._hand_over_again()

    def _receive(self, timeout: float | None) -> bool:
        """Take in one answer; whether there was one."""
        try:
            reply = self._client.receive(timeout)
        except LoopWorkerDied as error:
            self._died(error)
            return False
        if reply is None:
            return False
        asked = self._asked.popleft()
        if isinstance(reply, LoopState):
            self._notices += reply.notices
            if asked.void:
                pass
            elif asked.keyframes is None:
                self._news += [edge for _, state in self._arrived for edge in state.changed]
                self._arrived.clear()
                if reply.undo or not isinstance(asked.request, Finish):
                    self._known.forget_states()
                self._in_effect = reply.count
                self._take(reply)
            else:
                self._arrived.append((asked.keyframes, reply))
                if isinstance(asked.request, AddKeyframe) and any(one.since == reply.known for one in reply.undo):
                    self._known.forget_states()  # a command that is given again acts from here on, on all of them
                self._known.remember(asked.keyframes, reply)
        elif asked.keyframes is None:
            self._answers.append(reply)
        elif isinstance(reply, Failure):
            self._notices.append(reply.text)
        return True

    def _take_due(self) -> None:
        """Let take effect, one after the other, what has come and is due."""
        while self._arrived and self._in_effect < self._due:
            self._in_effect, state = self._arrived.popleft()
            self._take(state)

    def _without_keyframes(self) -> LoopState:
        """What the answer for none would be, so that nobody is asked for it and waited for."""
        undo, redo = (self.state.undo, self.state.redo) if self.state is not None else ((), ())
        nothing = np.empty((0, 4, 4))
        return LoopState(0, len(self._known), False, nothing, (), (), undo, redo, ())

    def _take(self, state: LoopState) -> None:
        self.state = state
        self.frame = self._lay(state)
        self._news += state.changed

    def _lay(self, state: LoopState) -> MapFrame:
        if (state.corrections == np.eye(4)).all():
            return self.frame if not len(self.frame.T_map_odom) else MapFrame()
        return MapFrame(self._known.stamps_ns(state.count), state.corrections)

    # --- when the work has died ------------------------------------------------------------------
    def _died(self, error: LoopWorkerDied) -> None:
        self._deaths += 1
        self._held[:0] = [asked.request for asked in self._asked if asked.keyframes is None]
        if self._finished and Finish() not in self._held:
            self._held.insert(0, Finish())  # it was done already
        self._asked.clear()
        self._arrived.clear()
        self._client.close()
        if self._given_up:
            self._alarms.append(f"{error} Loops stay as they are from here on; restart to look for them again.")
            lost = len(self._held) - self._held.count(Finish())
            self._answers += [Failure(GIVEN_UP)] * lost
            self._again, self._held = None, []
            return
        self._alarms.append(f"{error} It is started again; loops follow once it has caught up.")
        self._client = self._make_client()
        self._begin_again()

    def _begin_again(self) -> None:
        """Hand all keyframes over from the first on, while frames go on with the state that there is."""
        self._again, self._elsewhere = 0, False
        self._known.forget(self._count)  # those gone back over come again as new ones
        self._known.forget_states()
        commands = (self.state.undo, self.state.redo) if self.state is not None else ((), ())
        self._ask(GoTo(0), 0, void=True)
        self._ask(LoadCommands(*commands), 0, void=self._in_effect >= 0 or self._due > 0)
        self._hand_over_again()

    def _hand_over_again(self) -> None:
        """A few at a time, so that they do not pile up in memory. Those that count already change nothing."""
        while self._again is not None and self._client.pending < MOST_PENDING:
            if self._again >= min(self._count, len(self._keyframes)):
                self._again = None
                held, self._held = self._held, []
                for request in held:
                    if self._finished or not isinstance(request, Finish):  # the walk may have gone on since
                        self._ask(request, None)
                return
            keyframe = self._keyframes[self._again]
            if self._again == len(self._known):  # another engine had it
                self._known.put(keyframe, self._params)
            params = self._known.params(self._again)
            self._again += 1
            passed = self._again <= self._in_effect if self._in_effect >= 0 else self._again < self._due
            self._ask(AddKeyframe(keyframe, params), self._again, void=passed)
