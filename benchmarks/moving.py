"""Detection of points on moving objects: simulated walks among people, and the same walks without people.

A point is on a person if it lies within 8 cm of a body at the time of its measurement, and still if no body was within
25 cm. Points in between, most of them mixed pixels, do not count. Only keyframes are used, and only their points within
20 m. Seed 3 was not looked at during development of the method.
"""

import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import open3d
from tqdm import tqdm

from app.sensors.simulator.imperfections import IMPERFECT, NONE, Imperfections, Unit, companions, livelier
from app.sensors.simulator.raycast import Mover, Raycaster
from app.sensors.simulator.scanners import SCANNERS
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.simulate import START_NS, trajectory_through
from app.sensors.simulator.trajectory import ImuNoise, SmoothTrajectory, Walker, measured, seconds
from app.slam import moving
from app.slam.engine import Engine
from app.slam.params import Params
from app.slam.types import F64, ImuSamples, Keyframe, Mask, Scan
from app.slam.warmup import compile_kernels
from benchmarks.record import Line

SEEDS = (1, 2, 3)
SCENES = ("corridor", "outdoor")
DURATION_S, RATE_HZ, EVERY_BLOCK = 30.0, 10, 4
ON, OFF, REACH = 0.08, 0.25, 20.0
DEVICE = SCANNERS["bpearl"]
_O3D: Any = open3d  # its stubs lack arrays


def run() -> list[Line]:
    compile_kernels()
    lines, times = [], list[float]()
    walks = [(scene, sizes) for scene in SCENES for sizes in (NONE, IMPERFECT)]
    for scene, sizes in tqdm(walks, desc="Walks", leave=False, disable=None):
        kind = f"{scene}, {'imperfect' if sizes is IMPERFECT else 'clean'}, seeds {', '.join(map(str, SEEDS))}"
        scores = np.array([_among_people(scene, sizes, seed, times) for seed in SEEDS])
        for name, column in (("recall", 0), ("precision", 1), ("still points labelled", 2)):
            lines.append(Line.of(name, kind, "%", 100 * scores[:, column]))
        alone = [100 * _alone(scene, sizes, seed) for seed in SEEDS]
        lines.append(Line.of("points labelled without anyone", kind, "%", alone))
    return [*lines, Line.of("CPU time for a keyframe", "all of these", "ms", times)]


def _among_people(scene: str, sizes: Imperfections, seed: int, times: list[float]) -> tuple[float, float, float]:
    """Recall, precision, and the share of still points that are labelled."""
    walk = _Walk(scene, sizes, seed, people=True)
    called, on, off = (np.concatenate(parts) for parts in zip(*walk.judged(times), strict=True))
    right, wrong, there, still = (int(np.count_nonzero(mask)) for mask in (called & on, called & off, on, off))
    return right / max(there, 1), right / max(right + wrong, 1), wrong / max(still, 1)


def _alone(scene: str, sizes: Imperfections, seed: int) -> float:
    walk = _Walk(scene, sizes, seed, people=False)
    called, _, off = (np.concatenate(parts) for parts in zip(*walk.judged([]), strict=True))
    return float(np.count_nonzero(called & off) / np.count_nonzero(off))


class _Walk:
    """A walk through a scene, processed by the engine. people: include those of the scene and companions."""

    def __init__(self, scene: str, sizes: Imperfections, seed: int, *, people: bool) -> None:
        place, walker = build_scene(scene, seed), livelier(Walker(), sizes.hand)
        self._trajectory = trajectory_through(place, DURATION_S, seed, walker, DEVICE.R_body_imu)
        beside = companions(sizes.companions, self._trajectory, place, _random(seed, 5))
        self._people = [_Body(mover) for mover in (*place.movers, *beside)] if people else []
        caster = Raycaster(place.mesh, tuple(body.mover for body in self._people))
        turns = DEVICE.patterns(RATE_HZ, EVERY_BLOCK, None)
        self._unit = Unit(sizes, _random(seed, 4), turns(0).channels) if sizes != NONE else None
        lidar = replace(DEVICE.lidar, unit=self._unit)
        starts = np.arange(0.05, DURATION_S - 0.15, 1 / RATE_HZ)
        scans = (
            lidar.turn(turns(index), caster, self._trajectory, at, START_NS, _random(seed, 3, index))
            for index, at in enumerate(starts)
        )
        self.keyframes = _keyframes([scan for scan in scans if len(scan)], _imu(self._trajectory, self._unit, seed))

    def judged(self, times: list[float]) -> list[tuple[Mask, Mask, Mask]]:
        """For each keyframe's points within reach: whether a point is labelled, on a person, and far from everyone."""
        sights, found = [moving.sight(one) for one in self.keyframes], []
        for index, one in enumerate(self.keyframes):
            begin = time.process_time()
            called = moving.find(one, [sights[near] for near in moving.around(index, len(sights))], Params().moving)
            times.append(1e3 * (time.process_time() - begin))
            near, far = np.linalg.norm(one.cloud.points, axis=1) < REACH, self._distance(one)
            found.append((called[near], far[near] < ON, far[near] > OFF))
        return found

    def _distance(self, keyframe: Keyframe) -> F64:
        """(n,) m, distance of each point from the nearest person at the time of the point."""
        cloud, end = keyframe.cloud, keyframe.stamp_ns - START_NS
        points = cloud.points.astype(np.float64)
        if self._unit is not None:  # by the true mounting, not the written one
            points = self._unit.fired(np.ones_like(points), points)[1]
        (p,), (R,) = self._trajectory.poses(seconds(np.array([end])))
        world = (points @ DEVICE.lidar.R_imu_lidar.T + DEVICE.lidar.p_imu_lidar) @ R.T + p
        times = seconds(end - int(cloud.offsets_ns.max()) + cloud.offsets_ns.astype(np.int64))
        distances = [np.full(len(world), np.inf), *(body.distance(world, times) for body in self._people)]
        return np.asarray(np.min(distances, axis=0), np.float64)


class _Body:
    def __init__(self, mover: Mover) -> None:
        self.mover, self._scene = mover, _O3D.t.geometry.RaycastingScene()
        faces = _O3D.core.Tensor(mover.mesh.faces.astype(np.uint32))
        self._scene.add_triangles(_O3D.core.Tensor(mover.mesh.vertices), faces)

    def distance(self, points: F64, times: F64) -> F64:
        """(n,) m, distances of points (n, 3) at times (n,) s; inf if large."""
        where, yaw = self.mover.pose(times)
        found, offset = np.full(len(points), np.inf), points - where
        near = np.flatnonzero(np.linalg.norm(offset, axis=1) < 3.0)
        (x, y, z), c, s = offset[near].T, np.cos(yaw[near]), np.sin(yaw[near])
        own = np.column_stack([c * x + s * y, c * y - s * x, z]).astype(np.float32)
        found[near] = self._scene.compute_distance(_O3D.core.Tensor(own)).numpy()
        return found


def _keyframes(scans: list[Scan], imu: ImuSamples) -> list[Keyframe]:
    params = Params().with_values({"sensor.translation": tuple(DEVICE.lidar.p_imu_lidar.tolist())})
    engine, ends = Engine(params), [int(imu.stamps_ns[0]), *(scan.end_ns for scan in scans)]
    for scan, (before, end) in zip(scans, pairwise(ends), strict=True):
        first = max(int(np.searchsorted(imu.stamps_ns, before, side="right")) - 1, 0)
        part = slice(first, int(np.searchsorted(imu.stamps_ns, end)) + 1)
        engine.step(scan, ImuSamples(imu.stamps_ns[part], imu.gyro[part], imu.accel[part]))
    return list(engine.keyframes)


def _imu(trajectory: SmoothTrajectory, unit: Unit | None, seed: int) -> ImuSamples:
    stamps = START_NS + np.arange(0, round(DURATION_S * 1e9), 5_000_000, dtype=np.int64)
    imu = measured(trajectory, stamps, START_NS, ImuNoise(), _random(seed, 2))
    return imu if unit is None else unit.felt(imu, START_NS, _random(seed, 4, 2))


def _random(*stream: int) -> np.random.Generator:
    return np.random.default_rng(stream)
