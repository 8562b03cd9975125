"""A recording in memory and an engine that knows the result, for tests of everything around them.

The walk is a circle of 2 m radius at 10 frames per second, with a rotation of 2° per frame. The "engine"
reports that pose. Points with z < `ground.sigma` are labelled ground, so that relabelling can be checked.
"""

import threading
import warnings
from pathlib import Path

import numpy as np

from app.child import Link
from app.mapping.checkpoints import Checkpoints
from app.mapping.feed import Feed, FeedInfo
from app.mapping.session import Session
from app.sensors.findings import Finding
from app.server.engine_process import run_loop
from app.server.setup import Setup
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import (
    F64,
    GROUND,
    NON_GROUND,
    STAGES,
    Cloud,
    DroppedScan,
    FrameStatus,
    GroundResult,
    ImuSamples,
    Keyframe,
    Measurement,
    NavState,
    Registration,
    Scan,
    StepResult,
)

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 100_000_000
POINTS = 200


class FakeFeed(Feed):
    """`frames` scans; with `broken_at`, reading fails there; with `dropped_at`, that scan is left out."""

    repeatable = True

    def __init__(self, path: Path, frames: int, *, broken_at: int | None = None, dropped_at: int | None = None) -> None:
        findings = (
            Finding("IMU units", "needs you", "The unit is unclear.", "--set recording.acceleration_unit=g"),
            Finding("rings", "fine", "32 rings."),
        )
        self._info = FeedInfo(path, START_NS, frames * FRAME_NS * 1e-9, frames, findings=findings)
        self._frames = frames
        self._index = 0
        self._broken_at, self._dropped_at = broken_at, dropped_at
        self.closed = False

    @property
    def info(self) -> FeedInfo:
        return self._info

    def next(self) -> Measurement | DroppedScan | None:
        index = self._index
        if index >= self._frames:
            return None
        self._index += 1
        stamp = START_NS + index * FRAME_NS
        if index == self._broken_at:
            self._index = self._frames
            raise HemislamError(f"{self._info.path} is damaged at frame {index}; repair it.")
        if index == self._dropped_at:
            return DroppedScan(stamp, "no IMU samples cover it")
        points = np.random.default_rng(index).uniform(-1, 1, (POINTS, 3)).astype(np.float32)
        zeros = np.zeros(POINTS, dtype=np.int32)
        scan = Scan(stamp, points, zeros, zeros.astype(np.float32), zeros.astype(np.uint16))
        return Measurement(scan, ImuSamples(np.array([stamp]), np.zeros((1, 3)), np.zeros((1, 3))))

    def place(self) -> int:
        return self._index

    def go_to(self, place: int) -> None:
        self._index = place

    def close(self) -> None:
        self.closed = True


class FakeStore(list[Keyframe]):
    closed = False

    def close(self) -> None:
        self.closed = True


def pose(index: int) -> np.ndarray:
    """T_odom_imu of a frame: on a circle."""
    angle = np.radians(2.0 * index)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = [2 * np.cos(angle) - 2, 2 * np.sin(angle), 0.0]
    return T


def labels(points: np.ndarray, params: Params) -> np.ndarray:
    return np.where(points[:, 2] < params.ground.sigma, GROUND, NON_GROUND).astype(np.uint8)


class FakeEngine:
    """Every 5th frame is a keyframe. With `fails_at`, that step raises.

    Like a filter it has a memory: the speed it reports tells which parameters were in force at every
    frame so far, and in which order.
    """

    def __init__(self, params: Params, fails_at: int | None = None) -> None:
        self.params = params
        self.keyframes = FakeStore()
        self.steps_with: list[Params] = []
        self._fails_at = fails_at
        self._index, self._memory = 0, 0.1

    @property
    def g_odom(self) -> F64:
        return np.array([0.0, 0.0, -9.81])

    def close(self) -> None:
        self.keyframes.close()

    def step(self, scan: Scan, imu: ImuSamples) -> StepResult:
        index = self._index
        if index == self._fails_at:
            self._fails_at = None
            raise FloatingPointError("the covariance is not positive")
        self.steps_with.append(self.params)
        self._index += 1
        self._memory = 0.5 * self._memory + 0.05 * self.params.ground.sigma / Params().ground.sigma
        T = pose(index)
        state = NavState(
            scan.end_ns, T[:3, :3], T[:3, 3], np.array([self._memory, 0, 0]), *(np.zeros(3) for _ in range(3)),
            np.eye(3), np.zeros(3),
        )  # fmt: skip
        cloud = Cloud(scan.points, labels(scan.points, self.params), scan.intensity, scan.ring, scan.offsets_ns)
        keyframe = None
        if index % 5 == 0:
            keyframe = Keyframe(len(self.keyframes), index, scan.end_ns, T, np.eye(4), np.eye(6), cloud)
            self.keyframes.append(keyframe)
        return StepResult(
            index=index,
            stamp_ns=scan.end_ns,
            status=FrameStatus.TRACKING,
            state=state,
            T_map_odom=np.eye(4),
            cloud=cloud,
            ground=self._ground(cloud),
            registration=Registration(True, 2, 100, 90, 0.01, np.arange(1.0, 7.0), False),
            points_in=len(scan),
            points_reduced=len(scan),
            points_filter=len(scan),
            timings_ms=dict.fromkeys((*STAGES, "total"), 1.0),
            keyframe=keyframe,
        )

    def relabel(self, result: StepResult) -> StepResult:
        from dataclasses import replace

        cloud = replace(result.cloud, labels=labels(result.cloud.points, self.params))
        return replace(result, cloud=cloud, ground=self._ground(cloud))

    def checkpoint(self) -> tuple[object, ...]:
        return self._index, self._memory, self._fails_at, self.params, list(self.keyframes)

    def restore(self, state: tuple[object, ...]) -> None:
        self._index, self._memory, self._fails_at, self.params, self.keyframes[:] = state  # type: ignore[misc, assignment]

    def _ground(self, cloud: Cloud) -> GroundResult:
        share = float(np.mean(cloud.labels == GROUND))
        up = np.array([0.0, 0.0, 1.0])
        return GroundResult(cloud.labels, True, "", up, np.zeros(3), -up, 0.01, 10, share)


def open_fake(
    path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None = None, /
) -> Session:
    """Opens names like `walk-50.mcap` (50 frames), `broken-50-20.mcap`, `failing-50-20.mcap`, `dropped-50-20.mcap`."""
    kind, *numbers = path.stem.split("-")
    if kind not in ("walk", "broken", "failing", "dropped"):
        raise HemislamError(f"{path} is not a recording; choose another file.")
    frames, at = int(numbers[0]), int(numbers[1]) if len(numbers) > 1 else None
    feed = FakeFeed(
        path, frames, broken_at=at if kind == "broken" else None, dropped_at=at if kind == "dropped" else None
    )
    engine = FakeEngine(params, fails_at=at if kind == "failing" else None)
    return Session(feed, engine, truth=truth, checkpoints=Checkpoints())  # type: ignore[arg-type]


def fake_main(owner: Link, setup: Setup) -> None:
    run_loop(owner, setup, open_fake)


def failing_main(owner: Link, setup: Setup) -> None:
    """Says a word of warning, loses a thread and ends."""
    warnings.warn("somewhat odd", stacklevel=1)
    thread = threading.Thread(target=lambda: [][1], name="side work")
    thread.start()
    thread.join()
    raise ValueError("an engine\nthat fails")
