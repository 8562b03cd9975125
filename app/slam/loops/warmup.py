"""Load the kernels and the solver before the first keyframe waits for them."""

import numpy as np

from app.slam.loops import scan_context, verification
from app.slam.loops.factors import Factor
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.submap import Submap
from app.slam.voxel import VoxelGrid


def warm_up() -> None:
    """Do once, on a small scene, what every loop needs."""
    rng = np.random.default_rng(0)
    sides = np.repeat(np.arange(3), 400)
    points = rng.uniform(0.0, 4.0, (len(sides), 3)).astype(np.float32)
    points[np.arange(len(sides)), sides] = 0.0  # a corner of three walls
    thin = VoxelGrid().downsample(points, 0.1).points
    place = verification.prepare(Submap(0, thin, np.full_like(thin, 2.0)))
    fit = verification.assess(place, place, verification.register(place, place, np.eye(4)))
    verification.slide(place, place, fit)
    context = scan_context.describe(thin)
    scan_context.shift_distances(context, context)
    graph = PoseGraph(np.eye(4))
    graph.extend(Factor(0, 1, np.eye(4), np.eye(6)))
    graph.close([Factor(0, 1, np.eye(4), np.eye(6), robust=True)])
