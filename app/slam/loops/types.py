"""Values of the loop back end: candidates with their verdicts, and the user's commands over them.

A loop is named by the two keyframes it ties together, `(older, newer)`: the name stays the same
whatever else is found, so that a list of overrulings can be replayed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Final

import numpy as np

from app.slam.loops import packed
from app.slam.types import F32, F64

HUBER = 1.345
"""Whitened error from which a loop pulls with constant force (95 % efficient for a Gaussian)."""

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


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for and against one candidate. nan: not looked at.

    Attributes:
        context_distance: of the two Scan Contexts at the best column shift, 0 (same) to 1.
        context_yaw: rad, heading of the newer in the older's level frame by that shift.
        overlap: share of points near both keyframes that have a partner in the other submap, 0-1.
        residual_rms: m, point to plane, of those.
        condition: smallest eigenvalue of the registration's translation information over its
            largest, 0-1; near 0 the two submaps slide along each other.
        slide: m, how far registrations from disturbed starts ended from one another.
        rival_m: m to the nearest other alignment that fits as well and that odometry allows too; inf:
            there is none.
        mahalanobis: distance to what odometry predicts, in standard deviations.
        gate_m: m, standard deviation of that prediction's position.
        support: other candidates nearby that agree.
    """

    context_distance: float = float("nan")
    context_yaw: float = float("nan")
    overlap: float = float("nan")
    residual_rms: float = float("nan")
    condition: float = float("nan")
    slide: float = float("nan")
    rival_m: float = float("nan")
    mahalanobis: float = float("nan")
    gate_m: float = float("nan")
    support: int = 0

    @property
    def ambiguous(self) -> bool:
        return self.rival_m < float("inf")


class _Packed:
    __slots__ = ("_bytes",)
    _bytes: bytes


@dataclass(frozen=True, init=False, eq=False)
class LoopEdge(_Packed):
    """One candidate loop, whatever became of it.

    A walk has thousands, and three processes hold them all. So each is one piece of bytes, half as large as its
    parts would be on their own, and these are made as they are asked for.

    Attributes:
        older, newer: the keyframes. decided_at: newest keyframe when it got its verdict; from then on
            an accepted loop takes effect.
        T_older_newer: (4, 4), IMU frames. covariance: (6, 6), rotation then translation, in the
            newer's IMU frame (right perturbation). Both are read-only.
        verdict, reason: and why, in words and numbers.
        origin: who proposed it. overruled: whether the verdict is the user's.
        weight: the covariance is divided by it in the graph.
        evidence: the numbers.
        represented_by: a loop next to it, which shares most of its points and is in the graph for both.
    """

    __slots__ = ()

    older: int
    newer: int
    decided_at: int
    T_older_newer: F64
    covariance: F64
    verdict: Verdict
    reason: str
    evidence: Evidence
    origin: Origin
    overruled: bool
    weight: float
    represented_by: Pair | None

    def __init__(
        self,
        older: int,
        newer: int,
        decided_at: int,
        T_older_newer: F64,
        covariance: F64,
        verdict: Verdict,
        reason: str,
        evidence: Evidence,
        origin: Origin = Origin.DETECTED,
        overruled: bool = False,
        weight: float = 1.0,
        represented_by: Pair | None = None,
    ) -> None:
        *measures, support = (getattr(evidence, each.name) for each in fields(evidence))
        counts = (older, newer, decided_at, support, *(represented_by or _NOBODY))
        choices = (_VERDICTS.index(verdict), _ORIGINS.index(origin), overruled)
        self._hold(packed.pack(T_older_newer, covariance, (*measures, weight), counts, choices, reason))

    def _hold(self, whole: bytes) -> None:
        object.__setattr__(self, "_bytes", whole)

    def __reduce__(self) -> tuple[Callable[[bytes], "LoopEdge"], tuple[bytes]]:
        return _edge, (self._bytes,)

    @property
    def pair(self) -> Pair:
        return packed.first_counts(self._bytes)

    @property
    def counts(self) -> bool:
        """Whether it is a factor of the graph."""
        return self.verdict is Verdict.ACCEPTED and self.represented_by is None


_VERDICTS: Final = tuple(Verdict)
_ORIGINS: Final = tuple(Origin)
_NOBODY: Final = (-1, -1)


def _edge(whole: bytes) -> LoopEdge:
    edge = object.__new__(LoopEdge)
    edge._hold(whole)
    return edge


def _evidence(whole: bytes) -> Evidence:
    distance, yaw, overlap, residual, condition, slide, rival, mahalanobis, gate, _ = packed.numbers(whole)
    support = packed.counts(whole)[3]
    return Evidence(distance, yaw, overlap, residual, condition, slide, rival, mahalanobis, gate, support)


def _represented_by(whole: bytes) -> Pair | None:
    pair = packed.last_counts(whole)
    return None if pair == _NOBODY else pair


# To `dataclasses`, and so to `replace`, they are fields as others are.
_FIELDS: Final[Mapping[str, Callable[[bytes], object]]] = {
    "older": lambda whole: packed.counts(whole)[0],
    "newer": lambda whole: packed.counts(whole)[1],
    "decided_at": lambda whole: packed.counts(whole)[2],
    "T_older_newer": packed.pose,
    "covariance": packed.covariance,
    "verdict": lambda whole: _VERDICTS[packed.choice(whole, 0)],
    "reason": packed.text,
    "evidence": _evidence,
    "origin": lambda whole: _ORIGINS[packed.choice(whole, 1)],
    "overruled": lambda whole: bool(packed.choice(whole, 2)),
    "weight": lambda whole: packed.numbers(whole)[-1],
    "represented_by": _represented_by,
}


def _property(read: Callable[[bytes], object]) -> property:
    return property(lambda edge: read(edge._bytes))


for _name, _read in _FIELDS.items():
    setattr(LoopEdge, _name, _property(_read))


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


Command = Accept | Reject | SetWeight | Add | Solve


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


def pair_of(command: Command) -> Pair | None:
    """What a command is for; None: the graph as a whole."""
    return None if isinstance(command, Solve) else (command.older, command.newer)


def rows(T: F64) -> tuple[tuple[float, ...], ...]:
    """A matrix as a command holds it."""
    return tuple(tuple(float(value) for value in row) for row in np.asarray(T))
