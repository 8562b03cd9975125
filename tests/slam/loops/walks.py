"""Walks through simulated scenes as keyframes, without an engine: scans cast from exact poses, with any odometry."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from app.sensors.simulator.lidar import P_IMU_LIDAR, Lidar, firing_pattern
from app.sensors.simulator.raycast import Raycaster, SimulatedScene
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.trajectory import Walker, walk
from app.slam import lie
from app.slam.loops.backend import LoopBackend
from app.slam.loops.types import OPEN_M, LoopEdge
from app.slam.sections import LoopsParams
from app.slam.types import F64, NON_GROUND, Cloud, Keyframe

EPOCH_NS = 1_700_000_000_000_000_000


class _Still:
    """A trajectory that stays at one pose, so that a turn of the scanner needs no deskewing."""

    def __init__(self, position: F64, rotation: F64) -> None:
        self._position, self._rotation = position, rotation

    def poses(self, t: F64) -> tuple[F64, F64]:
        return np.tile(self._position, (len(t), 1)), np.tile(self._rotation, (len(t), 1, 1))


@dataclass(frozen=True)
class Walk:
    """Keyframes whose odometry is exact, in an odom frame that starts where the walk does, and its axes the world's."""

    keyframes: tuple[Keyframe, ...]

    @property
    def truth(self) -> F64:
        """(k, 4, 4) T_odom_imu as it really was."""
        return np.array([keyframe.T_odom_imu for keyframe in self.keyframes])

    def drifted(self, share: float, degrees_per_m: float) -> tuple[Keyframe, ...]:
        """The same clouds with odometry that measures `share` too far and turns steadily aside."""
        out = [self.keyframes[0]]
        T = self.truth[0]
        for before, after in pairwise(self.keyframes):
            step = lie.inverse(before.T_odom_imu) @ after.T_odom_imu
            walked = float(np.linalg.norm(step[:3, 3]))
            step[:3, 3] *= 1 + share
            T = T @ step
            T[:3, :3] = lie.exp(np.array([0.0, 0.0, np.radians(degrees_per_m) * walked])) @ T[:3, :3]
            out.append(replace(after, T_odom_imu=T))
        return tuple(out)


def take(
    scene: str | SimulatedScene, duration_s: float, spacing_m: float = 0.8, every_block: int = 12, seed: int = 0
) -> Walk:
    """A keyframe every `spacing_m` of a walk round the scene's path."""
    place = build_scene(scene, seed) if isinstance(scene, str) else scene
    path = walk(
        place.path, duration_s, np.random.default_rng(seed), walker=Walker(still=0.0), closed=place.closed,
        height=place.height,
    )  # fmt: skip
    t = np.arange(0.5, duration_s, 0.1)
    positions, rotations = path.poses(t)
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    chosen = np.unique(np.searchsorted(walked, np.arange(0.0, walked[-1], spacing_m)))
    caster = Raycaster(place.mesh, place.movers)
    lidar, pattern = Lidar(), firing_pattern(every_block=every_block)
    keyframes = []
    for index, k in enumerate(chosen.tolist()):
        returns = lidar.turn(
            pattern, caster, _Still(positions[k], rotations[k]), t[k], EPOCH_NS, np.random.default_rng([seed, index])
        )  # type: ignore[arg-type]
        count = len(returns.points)
        cloud = Cloud(
            returns.points, np.full(count, NON_GROUND, np.uint8), returns.intensity, returns.ring,
            np.zeros(count, np.int32),
        )  # fmt: skip
        keyframes.append(
            Keyframe(
                index=index,
                frame=k,
                stamp_ns=EPOCH_NS + round(t[k] * 1e9),
                T_odom_imu=lie.transform(rotations[k], positions[k] - positions[0]),
                T_imu_lidar=lie.transform(np.eye(3), P_IMU_LIDAR),
                covariance=np.diag([1e-6] * 3 + [1e-5] * 3),
                cloud=cloud,
            )
        )
    return Walk(tuple(keyframes))


def drive(
    keyframes: tuple[Keyframe, ...], params: LoopsParams, watch: Callable[[LoopBackend], None] = lambda backend: None
) -> LoopBackend:
    """A back end that has walked all keyframes; `watch` sees it after each."""
    backend = LoopBackend()
    for keyframe in keyframes:
        backend.add(keyframe, params)
        watch(backend)
    backend.finish()
    return backend


def error(edge: LoopEdge, truth: F64) -> tuple[float, float]:
    """m and deg between a loop's measurement and the truth (k, 4, 4), in the directions that it holds."""
    real = lie.inverse(truth[edge.older]) @ truth[edge.newer]
    wrong = lie.inverse(real) @ edge.T_older_newer
    squares, directions = np.linalg.eigh(edge.covariance[3:, 3:])
    held = directions[:, squares < OPEN_M**2]
    return float(np.linalg.norm(held.T @ wrong[:3, 3])), float(np.degrees(np.linalg.norm(lie.log(wrong[:3, :3]))))


def revisits(walk: Walk, within_m: float = 2.0, apart_s: float = 15.0) -> list[int]:
    """Keyframes at which the walk comes within `within_m` of where it was at least `apart_s` before."""
    stamps = np.array([keyframe.stamp_ns for keyframe in walk.keyframes]) * 1e-9
    p = walk.truth[:, :3, 3]
    return [
        k
        for k in range(len(p))
        if ((np.linalg.norm(p[:k] - p[k], axis=1) < within_m) & (stamps[:k] <= stamps[k] - apart_s)).any()
    ]
