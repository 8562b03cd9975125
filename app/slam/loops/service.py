"""The client that runs the loop back end in the caller's own process, and the loading of all that a back end needs."""

from collections import deque

import numpy as np

from app.slam.keyframe_id import KeyframeId
from app.slam.loops import placing, scan_context, verification
from app.slam.loops.backend import LoopBackend
from app.slam.loops.drift import Deviation
from app.slam.loops.factors import Factor
from app.slam.loops.keyframe_log import Follower, KeyframeLog
from app.slam.loops.messages import Answer, Ask
from app.slam.loops.plan import Window
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.submap import Submap
from app.slam.voxel import VoxelGrid


class InlineLoops:
    """A `LoopClient` that answers at once, in this process."""

    catching_up = False

    def __init__(self, log: KeyframeLog) -> None:
        self._backend = LoopBackend()
        self._follower = Follower(log)
        self._answers: deque[Answer] = deque()

    def send(self, ask: Ask) -> None:
        while (keyframe := self._follower.next(ask.target)) is not None:
            self._backend.add(keyframe.keyframe, keyframe.params)
        self._answers.append(self._backend.answer(ask))

    def receive(self, timeout: float | None = None) -> Answer | None:
        return self._answers.popleft() if self._answers else None

    def take_alarms(self) -> list[str]:
        return []

    def close(self) -> None:
        self._backend.close()


def warm_up() -> None:
    """Load the kernels and the solver before the first keyframe waits for them, on a small scene."""
    rng = np.random.default_rng(0)
    sides = np.repeat(np.arange(3), 400)
    points = rng.uniform(0.0, 4.0, (len(sides), 3)).astype(np.float32)
    points[np.arange(len(sides)), sides] = 0.0  # a corner of three walls
    thin = VoxelGrid().downsample(points, 0.1).points
    place = verification.prepare(Submap(0, thin, np.full_like(thin, 2.0), scan_context.RADIUS))
    none = Deviation(0.0, 0.0, 0.0)
    found = placing.place(place, place, np.eye(4), Window(1.0, 0.1), lambda T: none, most_sigmas=1.0, most_slide=0.1)
    verification.refine(place, place, found.fit.T_target_source)
    context = scan_context.describe(thin)
    scan_context.shift_distances(context, context)
    graph, ends = PoseGraph(np.eye(4)), (KeyframeId(0, 0), KeyframeId(0, 1))
    graph.do(Factor(*ends, np.eye(4), np.eye(6)))
    graph.do([Factor(*ends, np.eye(4), np.eye(6), robust=True)])
