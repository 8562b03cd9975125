"""Compile every kernel once, with progress. It takes a while on the first start of a new installation."""

from collections.abc import Callable

import numpy as np

from app.slam import channels, ground, iekf, imu, lie, moving, start
from app.slam.engine import Engine
from app.slam.kernels import clouds, manifold
from app.slam.lines import LineErrors
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.sections import MapParams
from app.slam.types import Cloud, ImuSamples, Keyframe, Scan
from app.slam.voxel import VoxelGrid


def compile_kernels(progress: Callable[[str, float], None] = lambda name, fraction: None) -> None:
    """Run each kernel on a toy frame, which compiles it or loads it from numba's cache.

    Args:
        progress: called with the name of the next step and the fraction done, 0-1; finally with 1.
    """
    params = Params()
    u, v = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-3, 3, 40))
    floor = np.stack([u.ravel(), v.ravel(), np.full(u.size, -1.3)], axis=1).astype(np.float32)
    n = len(floor)
    scan = Scan(0, floor, np.arange(n, dtype=np.int32), np.zeros(n, np.float32), np.zeros(n, np.uint16))
    samples = ImuSamples(np.array([0, 5_000_000]), np.zeros((2, 3)), np.tile([0.0, 0.0, 9.81], (2, 1)))
    belief = start.standing(samples, 0, params)
    local_map, grid = LocalMap(MapParams(max_voxels=1000)), VoxelGrid()

    progress("propagation", 0.0)
    predicted, path = imu.propagate(belief, samples, 5_000_000, params.imu)
    progress("deskew", 0.25)
    points = imu.deskew(scan, path, predicted.state)
    points.setflags(write=False)  # as in a frame
    channels.bent(scan, np.zeros(1), np.zeros(1))
    progress("ground segmentation", 0.28)
    surface = ground.segment(points, scan.ring, np.array([0.0, 0.0, -1.0]), params.ground)
    progress("downsampling", 0.3)
    sampled = grid.downsample(points, 0.01, chosen=surface.labels).points
    progress("local map", 0.32)
    local_map.insert(sampled, np.array([100.0, 0.0, 0.0]), params.map)
    progress("registration", 0.35)
    posterior, _ = iekf.update(predicted, sampled, local_map, params.filter)
    iekf.boxminus(posterior.state, predicted.state)
    manifold.log(np.eye(3))
    lie.log(np.eye(3))
    LineErrors.unknown().learnt(posterior, points, scan.ring, 1.0, local_map, params.filter)
    progress("a whole frame", 0.9)
    _run_frames(scan, samples, params)
    surface.labels.setflags(write=False)
    cloud = Cloud(points, surface.labels, scan.intensity, scan.ring, scan.offsets_ns)
    keyframe = Keyframe(0, 0, 0, np.eye(4), np.eye(4), np.eye(6), cloud)
    clouds.transform(points, np.eye(4), np.empty((n, 3)))
    moving.find(keyframe, [moving.sight(keyframe)], params.moving)
    progress("done", 1.0)


def _run_frames(scan: Scan, samples: ImuSamples, params: Params) -> None:
    """With ground seen straight down, and without."""
    engine = Engine(params)
    for alpha in (params.ground.alpha, 1.0):
        engine.params = params.with_values({"ground.alpha": alpha})
        engine.relabel(engine.step(scan, samples))
    engine.close()
