"""Values of the loop back end: candidates with their verdicts, and the user's commands over them.

A loop is named by the two keyframes it ties together, `(older, newer)`: the name stays the same
whatever else is found, so that a list of edits can be replayed.
"""

import sys
from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final

import numpy as np

from app.slam.loops.measured import Evidence, Measured
from app.slam.types import F32, F64

HUBER = 1.345
"""Whitened error from which a loop pulls with constant force (95 % efficient for a Gaussian)."""

SUMMARY: Final = "{}"
"""In the words for a verdict: that of the evidence."""

Pair = tuple[int, int]
"""(older, newer) keyframe."""


class Verdict(StrEnum):
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    CANDIDATE = "candidate"
    """Fits, but waits for others that agree with it. It is no factor of the graph."""


class Origin(StrEnum):
    DETECTED = "detected"
    USER = "user"


@lru_cache(maxsize=1024)
def _shared(older: int, newer: int) -> Pair:
    """The same tuple for all that one loop stands for."""
    return older, newer


@dataclass(frozen=True, slots=True, eq=False)
class LoopEdge:
    """One candidate loop, whatever became of it. The same only as itself, so that thousands are told apart at once.

    Attributes:
        older, newer: the keyframes. decided_at: newest keyframe when it got its verdict; from then on
            an accepted loop takes effect.
        measured: T_older_newer of the IMU frames, its covariance, rotation then translation, in the
            newer's IMU frame (right perturbation), which pickling leaves behind, and the evidence.
        verdict, words: and why; `SUMMARY` in the words stands for that of the evidence, so that many share them.
        origin: who proposed it. edited: whether the verdict is the user's.
        weight: the covariance is divided by it in the graph; that of no other, also of those that repeat it.
        represented_by: a loop that is in the graph for both: next to it, so its submaps are most of the same points; or
            the last one that ties poses, where the graph says the same as this one.
        repeats: a loop up to a submap's length away that measured the same. In the graph this one is a further
            measurement between that one's keyframes, and ties none of its own.
    """

    older: int
    newer: int
    decided_at: int
    measured: Measured
    verdict: Verdict
    words: str
    origin: Origin = Origin.DETECTED
    edited: bool = False
    weight: float = 1.0
    represented_by: Pair | None = None
    repeats: Pair | None = None

    def __post_init__(self) -> None:
        """What is the same of many is held once, also behind a pipe."""
        if SUMMARY in self.words:
            object.__setattr__(self, "words", sys.intern(self.words))
        if self.weight == 1.0:
            object.__setattr__(self, "weight", 1.0)
        for name in ("represented_by", "repeats"):
            if (pair := getattr(self, name)) is not None:
                object.__setattr__(self, name, _shared(*pair))

    def __reduce__(self) -> tuple[type["LoopEdge"], tuple[Any, ...]]:
        """For pipes; what dataclasses have for slots leaves a tuple behind of each."""
        return LoopEdge, _FIELDS(self)

    @property
    def pair(self) -> Pair:
        return self.older, self.newer

    @property
    def reason(self) -> str:
        """For the verdict, in words and numbers."""
        return self.words.replace(SUMMARY, self.evidence.summary) if SUMMARY in self.words else self.words

    @property
    def T_older_newer(self) -> F64:
        """(4, 4), read-only."""
        return self.measured.T_older_newer

    @property
    def covariance(self) -> F64:
        """(6, 6), read-only. Raises ValueError in another process than that where loops are looked for."""
        return self.measured.covariance

    @property
    def evidence(self) -> Evidence:
        return self.measured.evidence

    @property
    def counts(self) -> bool:
        """Whether it is a factor of the graph."""
        return self.verdict is Verdict.ACCEPTED and self.represented_by is None


_FIELDS: Final = attrgetter(*(field.name for field in fields(LoopEdge)))


# --- the user's commands -------------------------------------------------------------------------
# `since` of each: how many keyframes the walk had when it was given, one more after its end. The first
# time round a command acts from there on, so that a session given again goes as it went; 0: from the start.
@dataclass(frozen=True, slots=True)
class Accept:
    """Make a candidate a factor of the graph, whatever was found against it."""

    older: int
    newer: int
    since: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Reject:
    """Take a loop out of the graph."""

    older: int
    newer: int
    since: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class SetWeight:
    """Divide a loop's covariance by `weight` (> 0); 1 is what registration said."""

    older: int
    newer: int
    weight: float
    since: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Add:
    """Tie two keyframes together by hand.

    Attributes:
        guess: (4, 4) T_older_newer of the IMU frames from which their submaps are registered;
            None: where the graph has them now. As rows of numbers, so that commands compare.
        register: False takes the guess as it is.
    """

    older: int
    newer: int
    guess: tuple[tuple[float, ...], ...] | None = None
    register: bool = True
    since: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Solve:
    """Take the poses from all factors solved at once (Levenberg-Marquardt), from here on.

    They differ from the incremental ones where these only came near the optimum, and with a window.
    """

    since: int = field(default=0, compare=False)


LoopEdit = Accept | Reject | SetWeight | Add | Solve


# --- what the inspector and the files show -------------------------------------------------------
@dataclass(frozen=True, slots=True)
class FactorResidual:
    """How far one factor of the graph is from being met.

    Attributes:
        pair: keyframes. loop: or odometry. rotation: deg. translation: m.
        sigmas: length of the whitened error, in standard deviations.
    """

    pair: Pair
    loop: bool
    rotation: float
    translation: float
    sigmas: float

    @property
    def cost(self) -> float:
        """What it adds to that which the solver minimises: the square of `sigmas`, of a loop by Huber's loss."""
        if not self.loop or self.sigmas <= HUBER:
            return self.sigmas**2
        return 2 * HUBER * self.sigmas - HUBER**2


@dataclass(frozen=True, slots=True)
class Preview:
    """What the graph would become: (k, 4, 4) T_map_imu of all keyframes, and every factor's residual."""

    poses: F64
    residuals: tuple[FactorResidual, ...]


@dataclass(frozen=True, slots=True)
class LoopDetail:
    """All that the inspector shows of one candidate. Points are level frames: z up, origin at the IMU.

    Attributes:
        older, newer: (n, 3) submap points, each in its own level frame.
        T_imu_level: (4, 4) the older keyframe's IMU frame from its level frame: a rotation.
        T_guess: (4, 4) older's level frame from newer's, by odometry if the loop counts, else by the graph.
        T_registered: by the edge.
        older_context, newer_context: (rings, sectors), nan where never seen.
        shift_distances: (sectors,) distance over column shifts.
        residuals: (k,) m, point-to-plane, of the newer's points that have a partner.
    """

    older: F32
    newer: F32
    T_imu_level: F64
    T_guess: F64
    T_registered: F64
    older_context: F32
    newer_context: F32
    shift_distances: F64
    residuals: F64


def pair_of(command: LoopEdit) -> Pair | None:
    """What a command is for; None: the graph as a whole."""
    return None if isinstance(command, Solve) else (command.older, command.newer)


def rows(T: F64) -> tuple[tuple[float, ...], ...]:
    """A matrix as a command holds it."""
    return tuple(tuple(float(value) for value in row) for row in np.asarray(T))
