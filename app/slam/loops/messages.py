"""Requests to a loop back end and its replies, as frozen values that also pass between processes.

A back end follows a log of keyframes: `AddKeyframe` sends the next one that it lacks. Everything else is a question
about a `Target`, so an answer depends only on the keyframes and the question, not on earlier questions. Each request
has one reply, in order. A request that cannot be met is answered by a `Failure`, and changes nothing.
"""

from dataclasses import dataclass, field
from typing import Protocol

from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Edits, LoopEdit
from app.slam.loops.types import FactorResidual, LoopDetail, LoopEdge, Preview
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe


# --- to the back end -----------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class AddKeyframe:
    """The next keyframe of the log, with its cloud, and its parameters. Answered by `Added`.

    If the back end has another keyframe at this index, it forgets that one and all later ones. Parameters that act
    on restart are read from the first keyframe.
    """

    keyframe: Keyframe
    params: LoopsParams


@dataclass(frozen=True, slots=True)
class Target:
    """A state of the loops: with the first `count` keyframes, or all if there are fewer, and these edits.

    `finished`: the session ends here, so loops are looked for at the last keyframes too, whose surroundings are
    half seen.
    """

    count: int
    edits: Edits = field(default_factory=Edits)
    finished: bool = False


@dataclass(frozen=True, slots=True)
class AskState:
    """Answered by `LoopState`."""


@dataclass(frozen=True, slots=True)
class ApplyEdit:
    """Add an edit to those of the target. An edit of a pair that does not exist yet waits for it. Answered by
    `LoopState`, which holds the edit with the guess that was used, so that it can be repeated.
    """

    edit: LoopEdit


@dataclass(frozen=True, slots=True)
class TryOut:
    """What would the graph become with this edit? The answer is a `Preview`."""

    edit: LoopEdit


@dataclass(frozen=True, slots=True)
class Inspect:
    """All that is known of two keyframes, a candidate or not. The answer is a `LoopDetail`."""

    older: KeyframeId
    newer: KeyframeId


@dataclass(frozen=True, slots=True)
class AskResiduals:
    """The residuals of all factors of the graph. The answer is their `FactorResidual`s, odometry first."""


@dataclass(frozen=True, slots=True)
class AskG2o:
    """The graph as the text of a g2o file."""


Question = AskState | ApplyEdit | TryOut | Inspect | AskResiduals | AskG2o


@dataclass(frozen=True, slots=True)
class Ask:
    target: Target
    question: Question = field(default_factory=AskState)


Request = AddKeyframe | Ask


# --- replies -------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Added:
    """The back end now has this many keyframes."""

    count: int


@dataclass(frozen=True, slots=True)
class LoopState:
    """The loops with a number of keyframes.

    Attributes:
        count: keyframes. finished: as in `Target`.
        corrections: (count, 4, 4), T_map_odom at each keyframe: its T_map_imu is corrections[i] @ T_odom_imu.
        edges: all candidates with their present verdicts, by keyframes.
        undo, redo: edits in force and taken back; the last of each is the next one.
        notices: new since the last reply.
    """

    count: int
    finished: bool
    corrections: F64
    edges: tuple[LoopEdge, ...]
    undo: tuple[LoopEdit, ...] = ()
    redo: tuple[LoopEdit, ...] = ()
    notices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer to a question that changes no state."""

    question: Question
    value: Preview | LoopDetail | tuple[FactorResidual, ...] | str


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a request could not be met, in a sentence for the user."""

    text: str


Answer = LoopState | Answered | Failure
Reply = Added | Answer


class LoopClient(Protocol):
    """Answers questions about a log of keyframes, which it follows: `InlineLoops`, or `app.mapping.loops`."""

    @property
    def catching_up(self) -> bool:
        """Whether the back end has yet to be given many keyframes, so that a frame should not wait for it."""

    def send(self, ask: Ask) -> None:
        """Ask. Never waits for the answer."""

    def receive(self, timeout: float | None = None) -> Answer | None:
        """The answer to the oldest question that has none yet; None if there is none within the time (s).

        None at once if nothing was asked. With `timeout` None it waits; it returns None only when `catching_up`
        begins.
        """

    def take_alarms(self) -> list[str]:
        """Failures of the search itself since the last call, in sentences."""

    def close(self) -> None:
        """Release all resources; unanswered questions are dropped."""
