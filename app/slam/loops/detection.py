"""From a keyframe to candidates with evidence: place recognition and registration.

A keyframe is looked at once the keyframes after it that belong to its submap have come: what lies
on either side of it is then as dense as at the older ones it is compared with.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.slam import lie
from app.slam.keyframes import KeyframeStore
from app.slam.loops import scan_context, verification
from app.slam.loops.drift import Expectation
from app.slam.loops.scan_context import ScanContext
from app.slam.loops.submap import Recent, Submaps
from app.slam.loops.verification import Fit, Prepared
from app.slam.params import Loops
from app.slam.types import F64, I64, Keyframe

NEAR_M = 3.0
"""Beyond the reach of drift, places this far apart still see each other."""
KEPT_PREPARED = 16
"""Submaps ready for registration that stay in memory, some 1 MB each."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """A place that looks like an older one.

    Attributes:
        older, newer: keyframes. distance: of their contexts at the best column shift. yaw: rad, of
            that shift: heading of the newer's level frame in the older's.
    """

    older: int
    newer: int
    distance: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Head:
    """A keyframe without its cloud; the fields are those of `Keyframe`."""

    stamp_ns: int
    T_odom_imu: F64
    covariance: F64


@dataclass(frozen=True, slots=True)
class Memory:
    """What a detector remembers: every keyframe's head, and the contexts of the first ones."""

    heads: tuple[Head, ...] = ()
    contexts: tuple[ScanContext, ...] = ()


class Detector:
    """Describes keyframes and compares them. What it remembers follows from the keyframes alone."""

    def __init__(self, params: Loops, keyframes: KeyframeStore) -> None:
        self._params = params
        self._submaps = Submaps(keyframes, params.submap_voxel, scan_context.RADIUS)
        self._prepared: Recent[int, Prepared] = Recent(KEPT_PREPARED, self._prepare)
        self._heads: list[Head] = []
        self._contexts: list[ScanContext] = []

    def __len__(self) -> int:
        return len(self._heads)

    @property
    def described(self) -> int:
        """How many keyframes, from the first on, can be looked for."""
        return len(self._contexts)

    @property
    def heads(self) -> Sequence[Head]:
        return self._heads

    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_odom_imu."""
        return np.array([head.T_odom_imu for head in self._heads]).reshape(-1, 4, 4)

    def add(self, keyframe: Keyframe) -> None:
        self._heads.append(Head(keyframe.stamp_ns, keyframe.T_odom_imu, keyframe.covariance))
        self._submaps.offer(keyframe)

    def describe(self, index: int) -> None:
        """Make the context of the next keyframe, from the keyframes around it that there are."""
        if index != self.described:
            raise ValueError(f"keyframe {self.described} comes next, not {index}")
        self._contexts.append(scan_context.describe(self.submap(index).submap.points))

    def memory(self) -> Memory:
        return Memory(tuple(self._heads), tuple(self._contexts))

    def restore(self, memory: Memory) -> None:
        self._heads, self._contexts = list(memory.heads), list(memory.contexts)
        self._submaps.clear()
        self._prepared.clear()

    def context(self, index: int) -> ScanContext:
        return self._contexts[index]

    def submap(self, index: int) -> Prepared:
        return self._prepared[index]

    def T_level_imu(self, index: int) -> F64:
        """(4, 4) from a keyframe's IMU frame to its level frame: a rotation."""
        return lie.transform(self._heads[index].T_odom_imu[:3, :3], np.zeros(3))

    def look(self, newer: int, expectation: Expectation) -> list[Sighting]:
        """Older places that look like this one, the most alike first, each well apart from the others."""
        p = self._params
        candidates = self._eligible(newer, expectation)
        if not len(candidates):
            return []
        context = self._contexts[newer]
        keys = np.array([self._contexts[i].ring_key for i in candidates])
        alike = np.linalg.norm(keys - context.ring_key, axis=1)
        nearest = candidates[np.argsort(alike, kind="stable")[: p.candidates]]
        sightings = [self._compare(int(older), newer, expectation) for older in nearest]
        chosen: list[Sighting] = []
        for sighting in sorted(sightings, key=lambda s: s.distance):
            where = self._heads[sighting.older].T_odom_imu[:3, 3]
            if all(np.linalg.norm(where - self._heads[other.older].T_odom_imu[:3, 3]) > NEAR_M for other in chosen):
                chosen.append(sighting)
        return chosen[: p.verified]

    def guess(self, older: int, newer: int, poses: F64) -> F64:
        """(4, 4) of the level frames, newer in older, by poses T_map_imu of all keyframes."""
        T_older_newer = lie.inverse(poses[older]) @ poses[newer]
        return np.asarray(self.T_level_imu(older) @ T_older_newer @ lie.inverse(self.T_level_imu(newer)))

    def register(self, older: int, newer: int, T_guess: F64) -> Fit:
        """Lay the newer submap on the older one from a guess of the level frames' transform."""
        target, source = self.submap(older), self.submap(newer)
        return verification.assess(target, source, verification.register(target, source, T_guess))

    def assess(self, older: int, newer: int, T: F64) -> Fit:
        """How the newer submap lies on the older one, as the level frames' transform has it."""
        return verification.assess(self.submap(older), self.submap(newer), T)

    def slide(self, older: int, newer: int, fit: Fit) -> float:
        return verification.slide(self.submap(older), self.submap(newer), fit)

    def _eligible(self, newer: int, expectation: Expectation) -> I64:
        """Keyframes left long enough ago, as near as drift may have brought them."""
        stamps = np.array([head.stamp_ns for head in self._heads[: self.described]])
        old = np.flatnonzero(stamps <= self._heads[newer].stamp_ns - round(self._params.min_time * 1e9))
        away = np.linalg.norm(expectation.poses[old, :3, 3] - expectation.poses[newer, :3, 3], axis=1)
        reach = self._params.max_mahalanobis * expectation.position_sigmas()[old] + NEAR_M
        return np.asarray(old[away < reach])

    def _compare(self, older: int, newer: int, expectation: Expectation) -> Sighting:
        """Scan Contexts at the column shifts that odometry allows."""
        distances = scan_context.shift_distances(self._contexts[older], self._contexts[newer])
        expected = self.guess(older, newer, expectation.poses)
        yaw = np.arctan2(expected[1, 0], expected[0, 0])
        sigma = np.sqrt(expectation.covariance(older)[2, 2])
        away = np.abs(_wrapped(scan_context.YAWS - yaw))
        allowed = away <= self._params.max_mahalanobis * sigma + scan_context.SECTOR
        shift = int(np.argmin(np.where(allowed, distances, np.inf)))
        return Sighting(older, newer, float(distances[shift]), float(scan_context.YAWS[shift]))

    def _prepare(self, index: int) -> Prepared:
        half = self._params.submap_keyframes
        first, last = max(0, index - half), min(len(self) - 1, index + half)
        return verification.prepare(self._submaps.around(index, [head.T_odom_imu for head in self._heads], first, last))


def _wrapped(angle: npt.NDArray[np.float64]) -> F64:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
