"""Decide when the loops that were found take effect.

The client looks for loops in parallel to the frames, at its own speed. The loops of a keyframe take effect exactly
`loops.latency` frames after it, so the poses shown never depend on the speed of the machine. A frame waits only if an
answer is late, and never before the session is long enough for a loop, since a client takes seconds to start. A request
of the user takes effect as soon as it is answered.
"""

import contextlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.log import Cursor
from app.slam.loops.edits import Edits, check
from app.slam.loops.files import LoopResults, tied_pauses
from app.slam.loops.keyframe_log import KeyframeEntry, KeyframeLog
from app.slam.loops.messages import (
    Answer,
    Answered,
    ApplyEdit,
    Ask,
    AskG2o,
    AskState,
    Failure,
    LoopClient,
    LoopState,
    Question,
    Target,
)
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.map_frame import MapFrame
from app.slam.sections import LoopsParams
from app.slam.types import I64, Keyframe

UserRequest = Question | Callable[[Edits], Edits]
"""A question of the user, or a change of the edits, such as `Edits.undo`, which may raise HemislamError."""
EVERY: Final = 8
"""If no frame needs a state earlier, one is requested after this many keyframes, which are sent together."""
MOST_AHEAD: Final = 8
"""With this many unanswered questions, frames wait in any case, so that keyframes do not pile up in memory."""
STATES: Final = 512
"""States that are kept, so that going back need not solve the graph again."""
LEFT_OUT: Final = "Edits of loops are left out: with the new settings they would change loops of other keyframes."


@dataclass(frozen=True, slots=True, order=True)
class Moment:
    """A state of the session: its number of keyframes, and whether it ends there."""

    count: int
    finished: bool = False


@dataclass(frozen=True, slots=True)
class _Asked:
    """A question without an answer yet.

    Attributes:
        user: whether the user waits for it. edits: the edits that it leads to; None: it leaves them as they are.
        version: of the keyframe log. visit: counts how often the session had gone to another frame.
    """

    moment: Moment
    user: bool
    edits: Edits | None
    version: int
    visit: int


class LoopSchedule:
    """The loops of one session, as they count at its newest frame.

    Args:
        client: makes the client that follows a log of keyframes and looks for loops.
        keyframes: of the session.
        params: in force at the start. `latency` is read only here.

    Attributes:
        state: in effect; None before the first. frame: where that places odometry in the map.
    """

    def __init__(
        self, client: Callable[[KeyframeLog], LoopClient], keyframes: KeyframeStore, params: LoopsParams
    ) -> None:
        self.state: LoopState | None = None
        self.frame = MapFrame()
        self._log = KeyframeLog(keyframes)
        self._client = client(self._log)
        self._params = self._start = params
        self._edits = Edits()
        self._finished = False
        self._at_end = False  # if true, nothing takes effect before the results
        self._most_states = STATES
        self._states: dict[Moment, LoopState] = {}  # with the present edits
        self._wanted = Moment(0)  # what should be in effect
        self._shown: Moment | None = self._wanted  # what is in effect; None if that is with other edits
        self._asked: deque[_Asked] = deque()
        self._requests: deque[UserRequest] = deque()  # of the user, not yet sent
        self._visit = 0
        self._reported: tuple[LoopEdge, ...] | None = ()  # candidates at the frame before; None after going elsewhere
        self._answers: list[Answer] = []
        self._notices: list[str] = []
        self._said: set[str] = set()

    # --- the session -----------------------------------------------------------------------------
    def due(self, frame: int) -> tuple[LoopEdge, ...]:
        """Put into effect what is due before this frame is processed, and wait for it if it is late.

        Returns:
            Candidates that are new since the frame before or have another verdict.
        """
        if self._at_end:
            while len(self._asked) >= MOST_AHEAD and self._receive(None):
                pass
            self.poll()
            return ()
        self._wait_for_wanted()
        if self._reported is None:
            self._reported = self.edges
        due = min(self._log.until(frame - self._start.latency), self._log.count)
        if due > self._wanted.count:
            self._wanted = Moment(due)
            self._wait_for_wanted()
        self.poll()
        before, self._reported = self._reported, self.edges
        if before is self._reported:
            return ()
        verdicts = {edge.pair: edge.verdict for edge in before}
        return tuple(edge for edge in self._reported if verdicts.get(edge.pair) is not edge.verdict)

    def add(self, keyframe: Keyframe, params: LoopsParams) -> None:
        """The session has a new keyframe, or comes to a known one again."""
        self._finished, self._params = False, params
        if not self._log.holds(keyframe):
            self._forget(keyframe.index)
            self._log.append(KeyframeEntry(keyframe.frame, keyframe.stamp_ns, params, keyframe.resumed_ns))
        self._ask_next()

    def go_to(self, frame: int) -> None:
        """The session went to another frame: `frame` is the next.

        Never waits; the state follows with the next frame or `poll`.
        """
        self._finished = False
        self._visit += 1
        self._requests = deque(request for request in self._requests if not isinstance(request, AskState))
        self._log.take_stored(self._params)
        self._wanted = Moment(min(self._log.until(frame - 1 - self._start.latency), self._log.count))
        self._reported = None
        if self._editing:
            self._forget_states()
        self._take_wanted()
        self._ask_next()

    def forget_after(self, frame: int) -> None:
        """Keyframes after this frame will be different ones."""
        self._forget(max(self._log.until(frame), self._log.count))

    def never_go_back(self) -> None:
        """The session only goes forward, so no past states are kept."""
        self._most_states = 0

    def only_results(self) -> None:
        """Nobody looks at loops before `results`: until then nothing takes effect, and frames do not wait for it."""
        self._at_end, self._most_states = True, 0

    def finish(self) -> None:
        """The session has ended: look for loops at the last keyframes too, and put all that is found into effect."""
        self._finished = True
        self._requests.append(AskState())
        self._ask_next()

    # --- the user --------------------------------------------------------------------------------
    def command(self, request: UserRequest) -> None:
        """Ask on behalf of the user, or change the edits; `poll` until it is `idle` brings the answer."""
        self._requests.append(request)
        self._ask_next()

    def leave_out(self, count: int) -> None:
        """Take out the edits that name later keyframes than the first `count`: others will take their place."""
        if self.edits.among(count) != self.edits:
            self.command(lambda edits: edits.among(count))
            self._notices.append(LEFT_OUT)

    def poll(self) -> None:
        """Take in what has been answered, without waiting."""
        while self._asked and self._receive(0.0):
            pass
        self._take_wanted()

    @property
    def idle(self) -> bool:
        """Whether every question of the user was answered and the state is that of this frame."""
        if self._requests or any(asked.user for asked in self._asked):
            return False
        return self._shown == self._wanted or not self._asked

    @property
    def edits(self) -> Edits:
        """The user's edits, including those that are requested but not yet in effect."""
        edits = next((asked.edits for asked in self._asked if asked.edits is not None), self._edits)
        for request in self._requests:
            with contextlib.suppress(HemislamError):
                edits = _after(edits, request)
        return edits

    # --- results --------------------------------------------------------------------------------
    @property
    def edges(self) -> tuple[LoopEdge, ...]:
        """All candidates in effect."""
        return self.state.edges if self.state is not None else ()

    @property
    def accepted(self) -> int:
        """Loops that count now."""
        return sum(edge.verdict is Verdict.ACCEPTED for edge in self.edges)

    def take_notices(self) -> list[str]:
        """Notices for the user since the last call."""
        taken, self._notices = self._notices, []
        return taken

    @property
    def tied_ns(self) -> I64:
        """(m,) ends of the pauses that accepted loops in effect span."""
        edges, count = (self.state.edges, self.state.count) if self.state else ((), 0)
        return tied_pauses(edges, self._log.stamps_ns(count), self.frame.pauses_ns)

    def take_alarms(self) -> list[str]:
        """Failures of the loop search itself since the last call, in sentences; a session file does not keep them."""
        return self._client.take_alarms()

    def take_answers(self) -> list[Answer]:
        """Answers to the user's questions since the last call."""
        taken, self._answers = self._answers, []
        return taken

    def results(self) -> LoopResults:
        """All that files hold about loops, with all keyframes so far, whether in effect or not. Waits for it."""
        if self._at_end:
            self.command(AskState())
        self.command(AskG2o())
        self._settle()
        state = self._states.get(Moment(self._log.count, self._finished), self.state)
        graphs = [answer for answer in self._answers if isinstance(answer, Answered) and answer.question == AskG2o()]
        self._answers = [answer for answer in self._answers if answer not in graphs]
        frame, edges = (MapFrame(), ()) if state is None else (self._lay(state), state.edges)
        return LoopResults(frame, self._log.stamps_ns(self._log.count), edges, str(graphs[-1].value) if graphs else "")

    def close(self) -> None:
        self._client.close()

    # --- asking ----------------------------------------------------------------------------------
    @property
    def _editing(self) -> bool:
        """Whether the edits in force are unknown until an answer comes."""
        return any(asked.edits is not None for asked in self._asked)

    def _ask_next(self) -> None:
        """Send what can be asked with the known edits: the user's requests, then states that are missing."""
        while self._requests and not self._editing:
            self._ask_for_user(self._requests.popleft())
        if self._editing:
            return
        outstanding = {asked.moment for asked in self._asked}
        count = self._log.count
        counts = range(self._wanted.count + 1, count + 1)
        if self._at_end:
            counts = range(count, count + (count % EVERY == 0))
        for moment in (self._wanted, *map(Moment, counts)):
            unknown = moment != self._shown and moment not in self._states and moment not in outstanding
            if unknown and moment >= self._wanted:  # an earlier one would not be stored, and be asked for again
                self._ask(Ask(Target(moment.count, self._edits, moment.finished)))

    def _ask_for_user(self, request: UserRequest) -> None:
        question = request if isinstance(request, Question) else AskState()
        try:
            edits = _after(self._edits, request)
        except HemislamError as error:
            self._answers.append(Failure(str(error)))
            return
        target = Target(self._log.count, self._edits if question is request else edits, self._finished)
        self._ask(Ask(target, question), user=True, edits=None if edits is self._edits else edits)

    def _ask(self, ask: Ask, *, user: bool = False, edits: Edits | None = None) -> None:
        moment = Moment(ask.target.count, ask.target.finished)
        self._asked.append(_Asked(moment, user, edits, self._log.cursor.version, self._visit))
        self._client.send(ask)

    # --- answers ---------------------------------------------------------------------------------
    def _settle(self) -> None:
        """Wait until everything is answered."""
        while self._asked or self._requests:
            self._receive(None)

    def _wait_for_wanted(self) -> None:
        self._take_wanted()
        while self._shown != self._wanted and self._asked and not self._client.catching_up and self._receive(None):
            self._take_wanted()

    def _receive(self, timeout: float | None) -> bool:
        """Take in one answer; whether there was one."""
        answer = self._client.receive(timeout)
        if answer is None:
            return False
        asked = self._asked.popleft()
        if isinstance(answer, LoopState):
            self._learn(asked, answer)
        elif asked.user:
            self._answers.append(answer)
        elif isinstance(answer, Failure):
            if answer.text not in self._said:
                self._said.add(answer.text)
                self._notices.append(answer.text)
            return True  # asked again when a keyframe comes, not at once
        self._ask_next()
        return True

    def _learn(self, asked: _Asked, state: LoopState) -> None:
        self._notices += state.notices
        if asked.edits is not None:
            self._edits = Edits(state.undo, state.redo)
            self._forget_states()
        if self._log.keep(Cursor(asked.version, state.count)) < state.count:
            return  # its keyframes have been replaced since
        moment = Moment(state.count, state.finished)
        if self._at_end:
            self._states.clear()
        self._states[moment] = state
        if asked.user and asked.visit == self._visit and moment >= self._wanted:
            self._wanted = moment
            self._put(state)
        past = [moment for moment in self._states if moment < self._wanted]
        for moment in past[: max(0, len(self._states) - self._most_states)]:
            del self._states[moment]

    def _take_wanted(self) -> None:
        if self._shown == self._wanted:
            return
        if (state := self._states.get(self._wanted)) is not None:
            self._put(state)
        elif not self._editing and self._too_early(self._wanted.count):
            self._put(self._without_loops(self._wanted))

    def _too_early(self, count: int) -> bool:
        """Whether the first `count` keyframes can have no loop: none are far enough apart in time, or tied by hand."""
        entries = self._log[:count]
        return not self._edits.done and all(
            entry.stamp_ns - entries[0].stamp_ns < entry.params.min_time * 1e9 for entry in entries
        )

    def _put(self, state: LoopState) -> None:
        """Put a state into effect."""
        self._shown, self.state, self.frame = self._wanted, state, self._lay(state)

    def _forget(self, count: int) -> None:
        """Keep the first `count` keyframes."""
        if count < len(self._log):
            self._log.truncate(count)
            self._states = {moment: state for moment, state in self._states.items() if moment.count <= count}

    def _forget_states(self) -> None:
        self._states, self._shown = {}, None

    def _without_loops(self, moment: Moment) -> LoopState:
        """The answer where no loop is possible, so that nobody waits for one."""
        odometry = np.tile(np.eye(4), (moment.count, 1, 1))
        return LoopState(moment.count, moment.finished, odometry, (), (), self._edits.undone)

    def _lay(self, state: LoopState) -> MapFrame:
        if (state.corrections == np.eye(4)).all():
            return self.frame if not len(self.frame.T_map_odom) else MapFrame()
        count = state.count
        return MapFrame(self._log.stamps_ns(count), state.corrections, self._log.pauses_ns(count))


def _after(edits: Edits, request: UserRequest) -> Edits:
    """The edits after a request of the user. Raises HemislamError: it cannot be done."""
    if isinstance(request, ApplyEdit):
        check(request.edit)
        return Edits((*edits.done, request.edit))
    return edits if isinstance(request, Question) else request(edits)
