"""Loops: one update of a large pose graph, and the loop search's time per keyframe on a walk with 1,000 keyframes."""

import time
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from tqdm import tqdm

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Reject
from app.slam.loops.factors import Factor, residuals
from app.slam.loops.messages import AddKeyframe, ApplyEdit, Ask, LoopState, Target
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.service import warm_up
from app.slam.loops.solvers import optimise
from app.slam.loops.types import Verdict
from app.slam.params import Params
from app.slam.types import F64, Keyframe, Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import walk_in_laps

GARAGE = Path(__file__).resolve().parents[2] / "shared" / "data" / "pose_graphs" / "parking-garage.g2o"
KEYFRAMES = 1000


def run() -> list[Line]:
    return [*_garage(), *_search()]


def _garage() -> list[Line]:
    """parking-garage.g2o pose by pose: time of every update, and distance of the final cost from the batch optimum."""
    first, odometry, loops, start = read_g2o(GARAGE)
    graph, times = PoseGraph(first), []
    for factor in tqdm(odometry, desc=GARAGE.stem, unit=" poses", leave=False, disable=None):
        closing = [loop for loop in loops if loop.second == factor.second]
        begin = time.perf_counter()
        graph.do(factor)
        graph.do(closing)
        times.append((time.perf_counter() - begin) * 1e3)
    factors = [*odometry, *loops]
    batch = optimise(first, factors, start)
    ours, best = (sum(r.sigmas**2 for r in residuals(factors, poses)) for poses in (graph.poses, batch))
    on = f"{GARAGE.stem}: {len(start):,} poses, {len(loops):,} loops"
    return [
        Line.of("graph update", on, "ms", times),
        Line.of("cost over that of the batch optimum, less 1", on, "1e-3", [(ours / best - 1) * 1e3]),
    ]


def read_g2o(path: Path) -> tuple[F64, list[Factor], list[Factor], F64]:
    """First pose (4, 4), odometry and loops as factors from older to newer poses, and the file's poses (n, 4, 4)."""
    read, values = gtsam.readG2o(str(path), True)
    odometry: dict[int, Factor] = {}
    loops = []
    for k in range(read.size()):
        factor: Any = read.at(k)
        i, j = factor.keys()
        T, covariance = factor.measured(), factor.noiseModel().covariance()
        if i > j:
            adjoint = T.AdjointMap()
            i, j, T, covariance = j, i, T.inverse(), adjoint @ covariance @ adjoint.T
        ours = Factor(i, j, T.matrix(), covariance)
        if j == i + 1 and j not in odometry:
            odometry[j] = ours
        else:
            loops.append(ours)
    poses = np.array([values.atPose3(k).matrix() for k in range(values.size())])
    return poses[0], [odometry[j] for j in sorted(odometry)], loops, poses


def _search() -> list[Line]:
    """The loop search on a walk in laps, for every keyframe, on one thread; and undoing edits at its end."""
    path = walk_in_laps()
    params = resolve_params(path, None, None, [])
    keyframes = _keyframes(path, params)
    every_ms = np.median(np.diff([keyframe.stamp_ns for keyframe in keyframes])) / 1e6
    warm_up()
    backend, times = LoopBackend(), []
    state = None
    for keyframe in tqdm(keyframes, desc="Loops", unit=" keyframes", leave=False, disable=None):
        begin = time.perf_counter()
        backend.handle(AddKeyframe(keyframe, params.loops))
        reply = backend.handle(Ask(Target(keyframe.index + 1)))
        times.append((time.perf_counter() - begin) * 1e3)
        state = reply if isinstance(reply, LoopState) else state
    assert state is not None
    accepted = [edge for edge in state.edges if edge.verdict is Verdict.ACCEPTED]
    undoing = []
    for edge in accepted[:: max(1, len(accepted) // 10)]:
        target = Target(len(keyframes))
        for request in (Ask(target, ApplyEdit(Reject(*edge.pair))), Ask(target)):
            begin = time.perf_counter()
            backend.handle(request)
            undoing.append((time.perf_counter() - begin) * 1e3)
    backend.close()
    on = f"building in laps: {len(keyframes):,} keyframes, {len(accepted)} loops, one each {every_ms:.0f} ms"
    return [Line.of("loop search of a keyframe", on, "ms", times), Line.of("editing and undoing", on, "ms", undoing)]


def _keyframes(path: Path, params: Params) -> list[Keyframe]:
    """The first keyframes of the walk, by the engine's odometry."""
    compile_kernels()
    engine, out = Engine(params), list[Keyframe]()
    with open_recording(path, params) as source:
        for entry in tqdm(source.measurements(), desc="Odometry", unit=" frames", leave=False, disable=None):
            if isinstance(entry, Measurement) and (keyframe := engine.step(entry.scan, entry.imu).keyframe) is not None:
                out.append(keyframe)
            if len(out) == KEYFRAMES:
                break
    engine.close()
    return out
