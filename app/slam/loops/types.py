"""Values of the loop back end: candidates with their verdicts.

A loop is named by the two keyframes that it ties, `(older, newer)`. The name does not depend on what else is found,
so a list of edits can be replayed.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from app.slam.arrays import F32, F64
from app.slam.keyframe_id import KeyframeId

LOOP_HUBER = 1.345
"""Whitened error from which a loop pulls with constant force (95 % efficient for a Gaussian)."""

OPEN_M = 1.0
"""A direction is open if a loop's standard deviation along it is greater than this."""

Pair = tuple[KeyframeId, KeyframeId]
"""(older, newer) keyframe."""


class Verdict(StrEnum):
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    CANDIDATE = "candidate"
    """It fits, but waits for others that agree. It is not a factor of the graph."""


class Origin(StrEnum):
    DETECTED = "detected"
    USER = "user"


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence for and against one candidate; nan where it was not measured.

    Attributes:
        context_distance: of the two Scan Contexts at the best column shift, 0 (same) to 1.
        overlap: share of points near both keyframes that have a partner in the other submap, 0-1.
        residual_rms: m, point to plane, of the points with a partner.
        condition: smallest eigenvalue of the registration's translation information over its
            largest, 0-1; near 0 the two submaps slide along each other.
        slide: m, how far registrations from disturbed starts ended from the result, along its least certain direction.
        alternative_m: m to the nearest other alignment that fits as well and that odometry also allows; inf if
            there is none.
        mahalanobis: distance from odometry's prediction, in standard deviations.
        gate_m: m, standard deviation of that prediction's position.
        support: number of other candidates nearby that agree.
    """

    context_distance: float = float("nan")
    overlap: float = float("nan")
    residual_rms: float = float("nan")
    condition: float = float("nan")
    slide: float = float("nan")
    alternative_m: float = float("nan")
    mahalanobis: float = float("nan")
    gate_m: float = float("nan")
    support: int = 0

    @property
    def ambiguous(self) -> bool:
        return self.alternative_m < float("inf")

    def against_odometry(self, most_sigmas: float) -> str:
        """What odometry predicts, in words."""
        return (
            f"odometry rules it out: {self.mahalanobis:.1f} σ (most {most_sigmas:g} σ, one being {self.gate_m:.2f} m)"
        )

    @property
    def summary(self) -> str:
        """The numbers of a registered candidate, for its reason."""
        return (
            f"overlap {100 * self.overlap:.0f} %, residual {self.residual_rms * 1e3:.0f} mm, "
            f"slide {self.slide * 1e3:.0f} mm, {self.mahalanobis:.1f} σ from odometry"
        )


@dataclass(frozen=True, slots=True, eq=False)
class LoopEdge:
    """One loop candidate and its verdict. Compared by identity; `same` compares values.

    Attributes:
        older, newer: the keyframes. decided_at: the newest keyframe at the time of the verdict.
        T_older_newer: (4, 4) of the IMU frames, as registered, read-only.
        covariance: (6, 6) of that, rotation then translation, in the newer's IMU frame (right perturbation), read-only.
        verdict, reason: the reason in words and numbers.
        origin: who proposed it. edited: whether the verdict is the user's.
        weight: divides the covariance in the graph, of this loop only, not of loops that repeat it.
        represented_by: the loop that is in the graph in place of this one: a neighbour whose submaps share most
            points, or, if the graph already predicts this one, the last loop that ties poses.
        repeats: a loop up to a submap's length away that measured the same. This one becomes a further measurement
            between that loop's keyframes and ties no poses of its own.
        contradicted_by: loops nearby that do not agree with this candidate, at most `support.NAMED` of them.
    """

    older: KeyframeId
    newer: KeyframeId
    decided_at: int
    T_older_newer: F64
    covariance: F64
    evidence: Evidence
    verdict: Verdict
    reason: str
    origin: Origin = Origin.DETECTED
    edited: bool = False
    weight: float = 1.0
    represented_by: Pair | None = None
    repeats: Pair | None = None
    contradicted_by: tuple[Pair, ...] = ()

    @property
    def pair(self) -> Pair:
        return self.older, self.newer

    def __post_init__(self) -> None:
        self.T_older_newer.setflags(write=False)
        self.covariance.setflags(write=False)

    @property
    def open(self) -> bool:
        """Whether it leaves a direction open."""
        return bool(np.trace(self.covariance[3:, 3:]) > OPEN_M**2)  # the other directions are held to centimetres

    @property
    def counts(self) -> bool:
        """Whether it is a factor of the graph."""
        return self.verdict is Verdict.ACCEPTED and self.represented_by is None

    def same(self, other: "LoopEdge") -> bool:
        """Whether everything is the same, to the last bit."""
        return self is other or self._values() == other._values()

    def _values(self) -> list[bytes | str]:
        values = (getattr(self, field.name) for field in fields(self))
        return [value.tobytes() if isinstance(value, np.ndarray) else repr(value) for value in values]


class LoopChange(NamedTuple):
    """The difference between two states of the loops: candidates that are new or changed, and those that are gone."""

    changed: tuple[LoopEdge, ...]
    gone: tuple[Pair, ...]


def difference(before: Iterable[LoopEdge], after: Iterable[LoopEdge]) -> LoopChange:
    """The change from the candidates `before` to those `after`, by pair."""
    old, new = {edge.pair: edge for edge in before}, {edge.pair: edge for edge in after}
    changed = tuple(edge for pair, edge in new.items() if pair not in old or not edge.same(old[pair]))
    return LoopChange(changed, tuple(pair for pair in old if pair not in new))


def changed_by(change: LoopChange, before: Iterable[LoopEdge]) -> tuple[LoopEdge, ...]:
    """The candidates, by pair, after a change of those `before`: the inverse of `difference`."""
    edges = {edge.pair: edge for edge in (*before, *change.changed)}
    for pair in change.gone:
        del edges[pair]
    return tuple(edges[pair] for pair in sorted(edges))


# --- what the inspector and the files show -------------------------------------------------------
@dataclass(frozen=True, slots=True)
class FactorResidual:
    """The residual of one factor of the graph.

    Attributes:
        pair: keyframes. loop: whether it is a loop; else odometry. rotation: deg. translation: m.
        sigmas: length of the whitened error, in standard deviations.
    """

    pair: Pair
    loop: bool
    rotation: float
    translation: float
    sigmas: float

    @property
    def cost(self) -> float:
        """Its share of the cost that the solver minimises: the square of `sigmas`; for a loop, Huber's loss."""
        if not self.loop or self.sigmas <= LOOP_HUBER:
            return self.sigmas**2
        return 2 * LOOP_HUBER * self.sigmas - LOOP_HUBER**2


@dataclass(frozen=True, slots=True)
class Preview:
    """What the graph would become: (k, 4, 4) T_map_imu of all keyframes, and every factor's residual."""

    poses: F64
    residuals: tuple[FactorResidual, ...]


@dataclass(frozen=True, slots=True)
class LoopDetail:
    """All that the inspector shows of one candidate. Points are in level frames: z up, origin at the IMU.

    Attributes:
        older, newer: (n, 3) submap points, each in its own level frame.
        T_imu_level: (4, 4) the older keyframe's IMU frame from its level frame: a rotation.
        T_guess: (4, 4) T_older_newer of the level frames, by odometry if the loop counts, else by the graph.
        T_registered: the same by the loop's registration.
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
