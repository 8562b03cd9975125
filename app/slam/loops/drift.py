"""How far odometry may have drifted between two keyframes, and whether measured loops agree with it.

The filter's covariance does not show this: it takes the map as exact, so it stays at millimetres however long the
trajectory. Drift grows with the distance. Model: position drifts by a share of the distance, height by a smaller share,
heading by an angle per metre, all constant (the worst case, as nothing averages out) and independent. Gravity fixes
roll and pitch, and thereby the height. The distance between two keyframes is the shortest one through the graph:
accepted loops are short cuts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from app.slam import lie
from app.slam.loops.types import LoopEdge
from app.slam.sections import LoopsParams
from app.slam.types import F64, Mask

POSITION_M, ROTATION = 0.05, np.radians(0.5)
"""Standard deviations at distance zero, of registration and of submaps (m; rad about each axis)."""
PAUSE_M, PAUSE_TURN = 100.0, np.radians(7.5)
"""A pause counts as this many metres of odometry, and adds a heading error: a recording is expected to resume about
where it stopped, facing about the same way. Otherwise, places that look alike could not be told apart."""
PAUSE_TILT = np.radians(1.0)
"""Error of roll and pitch after a pause: after such a short time in motion, the filter hardly knows gravity better."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Attributes:
    translation, height: per distance. rotation: rad/m, of the heading. Standard deviations.
    """

    translation: float
    height: float
    rotation: float

    @classmethod
    def of(cls, params: LoopsParams) -> "Drift":
        return cls(params.drift_translation / 100, params.drift_height / 100, np.radians(params.drift_rotation))


class Deviation(NamedTuple):
    """How far a measured pose deviates from what the graph expects.

    Attributes:
        sigmas: of the whole pose, height_sigmas: of the height alone, in standard deviations. height: m, too high if
            positive.
    """

    sigmas: float
    height_sigmas: float
    height: float


@dataclass(frozen=True, slots=True)
class Expectation:
    """Where the graph expects every keyframe relative to one of them, the root.

    Attributes:
        root: index. poses: (k, 4, 4) T_map_imu. way: (k,) m, shortest through the graph.
        lever: (k, 3) m^2, integral of the lever arm along the way. Crossed with z and multiplied by a
            constant rate of heading drift, rad/m, it gives the error of position.
        pauses: (k,) number on the way. arm: (k, 3) m, sum of the straight lines from them to the root.
    """

    root: int
    poses: F64
    way: F64
    lever: F64
    pauses: F64
    arm: F64
    drift: Drift

    def covariance(self, other: int) -> F64:
        """(6, 6) of the root's pose as seen from `other`, rotation then translation, map axes."""
        way = float(self.way[other])
        heading = self.drift.rotation * way
        sideways = self.drift.rotation * np.array([-self.lever[other, 1], self.lever[other, 0], 0.0])
        turned = PAUSE_TURN * float(self.pauses[other])
        swung = PAUSE_TURN * np.array([-self.arm[other, 1], self.arm[other, 0], 0.0])
        out = np.zeros((6, 6))
        tilted = PAUSE_TILT * float(self.pauses[other])
        out[:3, :3] = np.diag([0.0, 0.0, heading**2 + turned**2]) + (ROTATION**2 + tilted**2) * np.eye(3)
        along = np.array([self.drift.translation, self.drift.translation, self.drift.height]) * way
        out[3:, 3:] = (
            np.diag(along**2) + POSITION_M**2 * np.eye(3) + np.outer(sideways, sideways) + np.outer(swung, swung)
        )
        return out

    def position_sigmas(self) -> F64:
        """(k,) m, standard deviation of the root's position as seen from each, in its worst direction."""
        sideways = self.drift.rotation * np.hypot(self.lever[:, 0], self.lever[:, 1])
        swung = PAUSE_TURN * np.hypot(self.arm[:, 0], self.arm[:, 1])
        return np.asarray(np.sqrt((self.drift.translation * self.way) ** 2 + sideways**2 + swung**2 + POSITION_M**2))

    def deviation(self, other: int, T_other_root: F64) -> Deviation:
        """The deviation of a measured (4, 4) pose of the root, as seen from `other`."""
        R = self.poses[other, :3, :3]
        expected = lie.inverse(self.poses[other]) @ self.poses[self.root]
        turned = R @ lie.log(T_other_root[:3, :3] @ expected[:3, :3].T)
        moved = R @ (T_other_root[:3, 3] - expected[:3, 3])
        error = np.concatenate([turned, moved])
        covariance = self.covariance(other)
        sigmas = float(np.sqrt(error @ np.linalg.solve(covariance, error)))
        return Deviation(sigmas, abs(float(error[5])) / float(np.sqrt(covariance[5, 5])), float(error[5]))


def expect(
    root: int,
    poses: F64,
    loops: Sequence[LoopEdge],
    drift: Drift,
    resumed: Mask | None = None,
    astray: F64 | float = 0.0,
) -> Expectation:
    """What the graph of poses (k, 4, 4) T_map_imu with these loops expects, seen from keyframe `root`.

    Args:
        resumed: (k,) which keyframes are the first after a pause; None: there was none. astray: (k,) m,
            `Keyframe.astray` of each.
    """
    count, loops = len(poses), [loop for loop in loops if not loop.open]
    p = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    resumed = np.zeros(count, np.bool_) if resumed is None else resumed
    steps += PAUSE_M * resumed[1:] + np.broadcast_to(astray, count)[1:] / drift.translation
    pairs = np.array([loop.pair for loop in loops], dtype=np.int64).reshape(-1, 2)
    measured = np.array([loop.T_older_newer for loop in loops]).reshape(-1, 4, 4)
    left = lie.inverse(poses[pairs[:, 0]] @ measured) @ poses[pairs[:, 1]]  # error of each loop in the graph
    missed = np.maximum(np.linalg.norm(left[:, :3, 3], axis=1) - POSITION_M, 0.0) / drift.translation
    turned = np.maximum(np.linalg.norm(lie.log(left[:, :3, :3]), axis=1) - ROTATION, 0.0) / drift.rotation
    short = np.maximum(missed, turned)
    neighbours = pairs[:, 1] - pairs[:, 0] == 1  # such a loop replaces the odometry step, since two edges would add up
    unpaused = np.zeros(count, np.bool_)
    unpaused[pairs[neighbours, 1]] = short[neighbours] < steps[pairs[neighbours, 0]]
    np.minimum.at(steps, pairs[neighbours, 0], short[neighbours])
    first = np.concatenate([np.arange(count - 1), pairs[~neighbours, 0]])
    second = np.concatenate([np.arange(1, count), pairs[~neighbours, 1]])
    length = np.concatenate([steps, short[~neighbours]]) + 1e-6  # scipy drops edges of length 0
    graph = coo_array((length, (first, second)), shape=(count, count))  # type: ignore[no-untyped-call]  # no types
    way, before = dijkstra(graph, directed=False, indices=root, return_predecessors=True)

    # moments of each way, gathered towards the root by doubling: log2(k) vector operations
    before = np.where(before < 0, root, before)
    tied = before.copy()
    stretch = way - way[before]
    each = np.arange(count)
    across = (np.abs(each - before) == 1) & (resumed & ~unpaused)[np.maximum(each, before)]
    moment = np.column_stack(
        [stretch[:, None] * (p + p[before]) / 2, across, across[:, None] * p[np.maximum(each, before)]]
    )
    moment[root] = 0.0
    while (tied != root).any():
        moment = moment + moment[tied]
        tied = tied[tied]
    lever, pauses = way[:, None] * p[root] - moment[:, :3], moment[:, 3]
    return Expectation(root, poses, np.asarray(way), lever, pauses, pauses[:, None] * p[root] - moment[:, 4:], drift)
