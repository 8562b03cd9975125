"""What a loop back end is asked and answers, as frozen values: they also pass between processes.

One request, one reply, in order. Most are answered by a `LoopState`; what can not be done, by a
`Failure`, and nothing has changed then.
"""

from dataclasses import dataclass
from typing import Protocol

from app.slam.errors import HemislamError
from app.slam.loops.types import FactorResidual, LoopDetail, LoopEdge, LoopEdit, Pair, Preview
from app.slam.params import LoopsParams
from app.slam.types import F64, Keyframe


# --- the walk ------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class AddKeyframe:
    """The next keyframe, with its cloud, and the parameters for it.

    One that is known already, as it was and with the same parameters, gives what was found then;
    any other one there makes the back end forget what it knows from there on. Parameters that act
    on restart are those of the first keyframe.
    """

    keyframe: Keyframe
    params: LoopsParams


@dataclass(frozen=True, slots=True)
class GoTo:
    """Be where the back end was after the first `count` keyframes, or on again to as many as it knows.

    `forget`: what lies beyond is forgotten, since the walk goes on differently.
    """

    count: int
    forget: bool = False


@dataclass(frozen=True, slots=True)
class Finish:
    """The walk ends here: look for loops of the last keyframes too, whose surroundings are half seen.

    Whatever comes next of the walk (`AddKeyframe`, `GoTo`) takes that back.
    """


# --- the user's commands -------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class ApplyEdit:
    """Put a command over what was found. One for a pair that is not there yet waits for it."""

    command: LoopEdit


@dataclass(frozen=True, slots=True)
class Undo:
    """Take the last command back."""


@dataclass(frozen=True, slots=True)
class Redo:
    """Give the command again that was taken back last."""


@dataclass(frozen=True, slots=True)
class LoadCommands:
    """These commands in place of all there are. `redo`: as in `LoopState`."""

    commands: tuple[LoopEdit, ...]
    redo: tuple[LoopEdit, ...] = ()


# --- questions -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class TryOut:
    """What would the graph become by this command? Answered by `Tried`."""

    command: LoopEdit


@dataclass(frozen=True, slots=True)
class Inspect:
    """All there is on two keyframes, a candidate or not. Answered by `Inspected`."""

    older: int
    newer: int


@dataclass(frozen=True, slots=True)
class AskResiduals:
    """How far is every factor of the graph from being met? Answered by `Residuals`."""


@dataclass(frozen=True, slots=True)
class AskG2o:
    """The graph as the text of a g2o file. Answered by `G2o`."""


Request = (
    AddKeyframe | GoTo | Finish | ApplyEdit | Undo | Redo | LoadCommands | TryOut | Inspect | AskResiduals | AskG2o
)


# --- replies -------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class LoopState:
    """Where the back end stands.

    Attributes:
        count: keyframes. known: how many `GoTo` can go to. finished: whether `Finish` holds.
        corrections: (count, 4, 4), T_map_odom at each keyframe: its T_map_imu is
            corrections[i] @ T_odom_imu.
        edges: all candidates as they count now, by keyframes; from another process without covariances. changed:
            those of them that are new by this request, or have another verdict, weight or measurement.
        undo, redo: commands in force and taken back; the last of each is the next one.
        notices: new since the last reply.
    """

    count: int
    known: int
    finished: bool
    corrections: F64
    edges: tuple[LoopEdge, ...]
    changed: tuple[LoopEdge, ...]
    undo: tuple[LoopEdit, ...]
    redo: tuple[LoopEdit, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Tried:
    """By `TryOut`: poses T_map_imu of all keyframes and residuals as they would be."""

    command: LoopEdit
    preview: Preview


@dataclass(frozen=True, slots=True)
class Inspected:
    pair: Pair
    detail: LoopDetail


@dataclass(frozen=True, slots=True)
class Residuals:
    """Odometry first, then loops."""

    residuals: tuple[FactorResidual, ...]


@dataclass(frozen=True, slots=True)
class G2o:
    text: str


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a request could not be met, in a sentence for the user."""

    text: str


Reply = LoopState | Tried | Inspected | Residuals | G2o | Failure


# --- who answers ---------------------------------------------------------------------------------
class LoopWorkerDied(HemislamError):
    """Whoever answered is gone, and what was pending with it; another one can be given the keyframes again."""


class LoopClient(Protocol):
    """Whoever answers: `app.slam.loops.service.InlineLoops`, or a process of its own (`app.mapping.loop_process`)."""

    @property
    def pending(self) -> int:
        """Requests whose replies were not received yet."""

    def send(self, request: Request) -> None:
        """Hand a request over. Never waits for the answer."""

    def receive(self, timeout: float | None = None) -> Reply | None:
        """The answer to the oldest request that has none yet; None if there is none within the time (s).

        None at once if nothing is pending; `timeout` None waits as long as it takes.

        Raises:
            LoopWorkerDied: there will be no answer.
        """

    def close(self) -> None:
        """Give back what is held; pending requests are dropped."""
