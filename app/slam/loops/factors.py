"""Factors of the pose graph: measurements between two keyframes, or of one keyframe."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.drift import PAUSE_TILT, Drift
from app.slam.loops.support import transported
from app.slam.loops.types import FactorResidual, LoopEdge, Pair
from app.slam.types import F64, Keyframe


@dataclass(frozen=True, slots=True)
class Factor:
    """A measured T_first_second (4, 4) with its covariance (6, 6), first < second.

    Attributes:
        robust: whether a large error pulls less than its square, as a loop's should.
        loop: the loop that it stands for, if that loop ties two other keyframes; else None.
    """

    first: KeyframeId
    second: KeyframeId
    T_first_second: F64
    covariance: F64
    robust: bool = False
    loop: Pair | None = None

    @property
    def name(self) -> Pair:
        """The keyframes of the loop or of the step."""
        return self.loop or (self.first, self.second)

    @property
    def keyframes(self) -> tuple[KeyframeId, ...]:
        return self.first, self.second


@dataclass(frozen=True, slots=True)
class PositionPrior:
    """A measured position p_map_imu (3,) m of one keyframe, from GNSS for example, with its covariance (3, 3).

    Attributes:
        arm: (3,) m, the point that was measured, in the IMU frame. robust: as in `Factor`.
    """

    keyframe: KeyframeId
    p_map_imu: F64
    covariance: F64
    arm: F64 = field(default_factory=lambda: np.zeros(3))
    robust: bool = False

    @property
    def keyframes(self) -> tuple[KeyframeId, ...]:
        return (self.keyframe,)


Closing = Factor | PositionPrior
"""A factor on poses that are already in the graph."""
Step = Factor | tuple[Closing, ...]
"""One change of a graph: odometry to the next pose, or factors on poses that the graph has."""


STILL_M, STILL_RAD = 0.001, np.radians(0.02)
"""Standard deviations of a step, however short."""
LOST_M, LOST_RAD = 10.0, 1.0
"""Standard deviations of a step across a pause, along each axis and of the heading."""
EVEN_M = 1.0
"""m over which drift keeps its direction: over a distance L, drift grows to drift * sqrt(L * EVEN_M)."""


def odometry_factor(second: int, before: Keyframe, after: Keyframe, drift: Drift) -> Factor:
    """Odometry from one keyframe to the next.

    The filter gives the covariance of each pose in its map, which it takes as exact, but not that of the step between
    two poses. So the covariances of both poses are added, as if they were independent (an upper bound), and drift is
    added as a random walk: constant over `EVEN_M`, independent beyond. A step across a pause is a guess. A step that a
    scan contradicted may be off by metres.
    """
    T = lie.inverse(before.T_odom_imu) @ after.T_odom_imu
    walked = float(np.linalg.norm(T[:3, 3]))
    turn = np.kron(np.eye(2), T[:3, :3].T)
    first = turn @ _own_axes(before) @ turn.T
    even = walked * EVEN_M
    covariance = first + _own_axes(after)
    up = after.T_odom_imu[2, :3]  # gravity fixes rotation about the other axes
    covariance[:3, :3] += STILL_RAD**2 * np.eye(3) + drift.rotation**2 * even * np.outer(up, up)
    covariance[3:, 3:] += (STILL_M**2 + drift.translation**2 * even) * np.eye(3)
    covariance[3:, 3:] += (drift.height**2 - drift.translation**2) * even * np.outer(up, up)
    covariance[3:, 3:] += after.astray**2 * np.eye(3)
    if after.resumed_ns:
        covariance[:3, :3] += PAUSE_TILT**2 * np.eye(3) + LOST_RAD**2 * np.outer(up, up)
        covariance[3:, 3:] += LOST_M**2 * np.eye(3)
    return Factor(KeyframeId(0, second - 1), KeyframeId(0, second), T, (covariance + covariance.T) / 2)


def loosened(step: Factor, slip: F64, R_odom_imu: F64) -> Factor:
    """Odometry to a keyframe, weakened along a slip (6,) of rotation and translation, in odom's axes."""
    moved = np.kron(np.eye(2), R_odom_imu.T) @ slip
    return replace(step, covariance=step.covariance + np.outer(moved, moved))


def _own_axes(head: Keyframe) -> F64:
    """(6, 6) covariance with errors of rotation and position in the IMU's axes; zero if it is not finite."""
    turn = np.eye(6)
    turn[3:, 3:] = head.T_odom_imu[:3, :3].T
    out = turn @ head.covariance @ turn.T
    return out if np.isfinite(out).all() else np.zeros((6, 6))


def loop_factors(
    edges: Iterable[LoopEdge], by_pair: Mapping[Pair, LoopEdge], T_odom_imu: F64, *, window: int
) -> list[Factor]:
    """The factors of the loops that count.

    Args:
        by_pair: all loops, including those that others repeat. T_odom_imu: (k, 4, 4). window: of the solver. If there
            is one, each factor ties its own keyframes, since those of a loop that it repeats may have left the window.
    """
    factors = []
    for edge in edges:
        if edge.counts:
            first = by_pair[edge.repeats] if edge.repeats and not window else edge
            T, covariance = edge.T_older_newer, edge.covariance
            if first is not edge:
                (T,), (covariance,) = transported([edge], first, T_odom_imu)
            factors.append(Factor(first.older, first.newer, T, covariance / edge.weight, True, edge.pair))
    return factors


def residuals(graph: Iterable[Closing], poses: F64) -> tuple[FactorResidual, ...]:
    """The residual of every factor between two keyframes, by poses (k, 4, 4)."""
    factors = [factor for factor in graph if isinstance(factor, Factor)]
    if not factors:
        return ()
    first, second = np.array([f.keyframes for f in factors]).T
    measured = np.array([f.T_first_second for f in factors])
    errors = lie.log_se3(lie.inverse(measured) @ lie.inverse(poses[first]) @ poses[second])
    whitened = np.linalg.solve(np.array([f.covariance for f in factors]), errors[..., None])[..., 0]
    sigmas = np.sqrt(np.einsum("ni,ni->n", errors, whitened))
    turned = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    moved = np.linalg.norm(errors[:, 3:], axis=1)
    rows = zip(factors, turned.tolist(), moved.tolist(), sigmas.tolist(), strict=True)
    return tuple(FactorResidual(f.name, f.robust, r, t, s) for f, r, t, s in rows)
