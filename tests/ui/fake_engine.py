"""A fake engine for drawing tests: a hemispherical sensor carried along an analytic corridor.

It answers commands at once in the caller's thread, so that tests need not wait; only `Play` has a
thread of its own. Labels follow from the corridor's true floor by the paper's rules, so that sliders
have visible, predictable effects.
"""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.sensors.doctor import Finding
from app.server.keeping import SetClip
from app.server.protocol import (
    SERIES,
    Chunk,
    Command,
    LoadParams,
    Notice,
    OpenedRecording,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Seek,
    SetBreakpoints,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
    Transport,
)
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params, leaves
from app.slam.types import (
    GROUND,
    NON_GROUND,
    SEED,
    STAGES,
    Cloud,
    FrameStatus,
    GroundResult,
    NavState,
    Registration,
    StepResult,
)

START_NS = 1_700_000_000_000_000_000
HEIGHT = 1.3
R_MAP_LIDAR = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""As H2LID holds it: the LiDAR's z looks along the corridor, its x up."""

FINDINGS = (
    Finding("topics", "fine", "Point clouds on /rslidar_points at 10.0 Hz, IMU on /imu/data at 200.0 Hz."),
    Finding("header stamp", "corrected", "Clouds are stamped at their last one.", "--set recording.header_stamp=last"),
    Finding(
        "IMU gaps", "needs you", "The IMU pauses 0.31 s at 12.4 s; the filter bridges it.", "--set imu.max_gap=0.4"
    ),
    Finding("gravity", "fine", "Down is (−1.00, 0.01, 0.02) in the LiDAR frame: it looks forward."),
)

_BOXES = np.array(  # low corner, high corner: things that stand about
    [[[4, 1.0, 0], [5, 2.0, 0.8]], [[9, -2, 0], [10, -1.2, 1.9]],
     [[15, 0.6, 0], [15.6, 1.2, 1.7]], [[21, -2, 0], [23, -1, 0.5]]],
    dtype=float,
)  # fmt: skip
_LENGTH, _HALF_WIDTH, _CEILING = 40.0, 2.2, 2.8


def _cast(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance along each unit direction to the corridor's walls or a box (slab method)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = np.array([-3.0, -_HALF_WIDTH, 0.0]), np.array([_LENGTH, _HALF_WIDTH, _CEILING])
        walls = np.where(directions > 0, (high - origin) / directions, (low - origin) / directions)
        best = np.where(np.abs(directions) > 1e-9, walls, np.inf).min(axis=1)
        for box in _BOXES:
            t = (box[:, None, :] - origin) / directions
            near, far = t.min(axis=0).max(axis=1), t.max(axis=0).min(axis=1)
            best = np.where((near > 0) & (near <= far) & (near < best), near, best)
    return best


class World:
    """Scans of the corridor; `columns` azimuths by 32 lines."""

    def __init__(self, columns: int = 160) -> None:
        elevation = np.radians(np.linspace(2.3, 89.5, 32))
        azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
        e, a = np.meshgrid(elevation, azimuth)
        self.ring = np.tile(np.arange(32, dtype=np.uint16), columns)
        directions = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), -1)
        self.directions = directions.reshape(-1, 3)

    def position(self, frame: int) -> np.ndarray:
        t = 0.1 * frame
        return np.array([0.8 * t, 0.15 * np.sin(0.7 * t), HEIGHT + 0.03 * np.sin(6 * t)])

    def rotation(self, frame: int) -> np.ndarray:
        yaw = 0.2 * np.sin(0.05 * frame)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        return turn @ R_MAP_LIDAR

    def points(self, frame: int) -> np.ndarray:
        ranges = _cast(self.position(frame), self.directions @ self.rotation(frame).T)
        ranges = ranges + np.random.default_rng(frame).normal(0, 0.005, len(ranges))
        return (self.directions * ranges[:, None]).astype(np.float32)


def label(world: World, frame: int, points: np.ndarray, params: Params) -> GroundResult:
    """The paper's rules with the true floor as the plane. The odometry frame starts at the sensor."""
    R = world.rotation(frame)
    down = R.T @ np.array([0.0, 0.0, -1.0])
    ranges = np.linalg.norm(points, axis=1)
    height = points @ (R[2]) + world.position(frame)[2]
    ground = np.abs(height) < params.ground.sigma * ranges
    near = points @ down > np.cos(np.radians(params.ground.alpha)) * ranges
    seeds = ground & near & (world.ring < params.ground.scan_lines)
    labels = np.where(seeds, SEED, np.where(ground, GROUND, NON_GROUND)).astype(np.uint8)
    return GroundResult(
        labels=labels,
        found=bool(seeds.sum() >= 20),
        reason="" if seeds.sum() >= 20 else f"only {seeds.sum()} seed points; a plane needs 20",
        normal=-down,
        centroid=down * world.position(frame)[2],
        down=down,
        planarity=0.004 + 0.002 * np.sin(frame),
        seeds=int(seeds.sum()),
        share=float(ground.mean()),
    )


class FakeEngine:
    """`send`, `snapshot` and `wait` of the engine's process, without one."""

    def __init__(self, *, columns: int = 160, frames: int = 400, opened: bool = True, truth: bool = True) -> None:
        self.world = World(columns)
        self.frames = frames
        self.sent: list[Command] = []
        self._changed = threading.Condition()
        self._snapshot = Snapshot()
        self._truth = truth
        self._rows: list[list[float]] = []
        self._player: threading.Thread | None = None
        self._closing = threading.Event()
        if opened:
            self._open(Path("/data/hall_bpearl.mcap"))

    # --- what the workbench uses -------------------------------------------------------------
    @property
    def snapshot(self) -> Snapshot:
        return self._snapshot

    def wait(self, after_revision: int, timeout: float) -> Snapshot:
        with self._changed:
            self._changed.wait_for(lambda: self._snapshot.revision > after_revision, timeout)
            return self._snapshot

    def send(self, command: Command) -> None:
        with self._changed:
            self.sent.append(command)
            try:
                self._obey(command)
            except HemislamError as error:
                self.notice("error", str(error))

    # --- what tests use ----------------------------------------------------------------------
    def publish(self, **changes: object) -> None:
        with self._changed:
            self._snapshot = replace(self._snapshot, revision=self._snapshot.revision + 1, **changes)
            self._changed.notify_all()

    def notice(self, level: str, text: str) -> None:
        notices = self._snapshot.notices
        number = notices[-1].number + 1 if notices else 1
        self.publish(notices=(*notices, Notice(number, level, text))[-50:])  # type: ignore[arg-type]

    def close(self) -> None:
        self._closing.set()

    # --- inside ------------------------------------------------------------------------------
    def _obey(self, command: Command) -> None:
        snapshot = self._snapshot
        match command:
            case Play():
                self._transport(playing=True)
                if self._player is None:
                    self._player = threading.Thread(target=self._play, daemon=True)
                    self._player.start()
            case Pause():
                self._transport(playing=False)
            case StepFrame(frames) if frames < 0:
                self._transport(playing=False)
                self._go_back(max(snapshot.transport.frame + frames, 0))
            case StepFrame(frames):
                self._transport(playing=False)
                for _ in range(frames):
                    self._step()
            case SetSpeed(factor):
                self._transport(speed=factor)
            case SetBreakpoints(breakpoints):
                self.publish(breakpoints=breakpoints)
            case SetClip(changes):
                self.publish(clip=replace(snapshot.clip, **changes))
            case Seek(frame):
                self._go_back(frame)
                while self._snapshot.transport.frame < frame:
                    self._step()
            case SetParams(values):
                self._set(snapshot.params.with_values(values))
            case LoadParams(yaml):
                self._set(Params().merged_yaml(yaml))
            case Restart():
                self.publish(pending_restart=())
                self._open(Path("/data/hall_bpearl.mcap"))
            case OpenRecording(path):
                self._open(path)

    def _set(self, params: Params) -> None:
        effect = {leaf.path: leaf.effect for leaf in leaves()}
        changed = self._snapshot.params.changed(params)
        pending = {*self._snapshot.pending_restart, *(name for name in changed if effect[name] == "restart")}
        result = self._snapshot.result
        if result is not None:
            ground = label(self.world, result.index, result.cloud.points, params)
            result = replace(result, ground=ground, cloud=replace(result.cloud, labels=ground.labels))
        self.publish(params=params, pending_restart=tuple(sorted(pending)), result=result)

    def _transport(self, **changes: object) -> None:
        self.publish(transport=replace(self._snapshot.transport, **changes))  # type: ignore[arg-type]

    def _open(self, path: Path) -> None:
        truth = np.array([self.world.position(i) for i in range(self.frames)]) if self._truth else None
        recording = OpenedRecording(
            path,
            START_NS,
            0.1 * self.frames,
            self.frames,
            FINDINGS,
            START_NS + 100_000_000 * np.arange(self.frames) if truth is not None else None,
            truth,
        )
        self._rows = []
        self.publish(
            session=self._snapshot.session + 1,
            recording=recording,
            transport=Transport(speed=self._snapshot.transport.speed),
            result=None,
            chunks=(),
            keyframe_poses=np.empty((0, 4, 4)),
            trajectory=np.empty((0, 3)),
            series=Snapshot().series,
            known_ns=Snapshot().known_ns,
            T_map_truth=None,
        )

    def _go_back(self, frame: int) -> None:
        """What came later is taken away, what was before stays the same objects."""
        snapshot = self._snapshot
        if not 0 <= frame < snapshot.transport.frame:
            return
        result, chunks = self.result(frame, snapshot.params), frame // 6 + 1
        del self._rows[frame + 1 :]
        self.publish(
            transport=replace(snapshot.transport, frame=frame, stamp_ns=result.stamp_ns, finished=False),
            result=result,
            chunks=snapshot.chunks[:chunks],
            keyframe_poses=snapshot.keyframe_poses[:chunks],
            trajectory=snapshot.trajectory[: frame + 1],
            series={name: column[: frame + 1] for name, column in snapshot.series.items()},
            T_map_truth=snapshot.T_map_truth if frame > 10 else None,
        )

    def _play(self) -> None:
        while not self._closing.is_set():
            with self._changed:
                if self._snapshot.transport.playing:
                    self._step()
                speed = self._snapshot.transport.speed
            time.sleep(0.1 / min(speed, 10.0))

    def _step(self) -> None:
        snapshot = self._snapshot
        frame = snapshot.transport.frame + 1
        if frame >= self.frames:
            self._transport(playing=False, finished=True)
            return
        result = self.result(frame, snapshot.params)
        T_map_lidar = result.T_map_imu @ result.state.T_imu_lidar
        chunks, poses = snapshot.chunks, snapshot.keyframe_poses
        if frame % 6 == 0:
            cloud = result.cloud
            chunks = (
                *chunks,
                Chunk(
                    len(chunks),
                    result.index,
                    result.stamp_ns,
                    cloud.points,
                    cloud.labels,
                    cloud.intensity,
                    cloud.ring,
                    np.eye(4),
                ),
            )
            new = T_map_lidar[None]
            poses = np.concatenate((poses, new))
        position = T_map_lidar[None, :3, 3]
        trajectory = np.concatenate((snapshot.trajectory, position))
        error = 0.004 + 0.0001 * frame if self._truth else np.nan
        row = {
            "stamp_s": 0.1 * frame,
            "planarity": result.ground.planarity,
            "residual_rms": result.registration.residual_rms,
            "ground_share": result.ground.share,
            "used": result.registration.used,
            "inliers": result.registration.inliers,
            "degeneracy": result.registration.eigenvalues[0],
            "imu_gap_s": result.imu_gap_s,
            "dropped": result.dropped,
            "clock_late_s": result.clock_late_s,
            "total_ms": result.timings_ms["total"],
            "distance": 0.08 * frame,
            "error_m": error,
            **dict(zip(("turn_x", "turn_y", "turn_z"), lie.log(result.state.R_odom_imu), strict=True)),
            **{f"{stage}_ms": ms for stage, ms in result.timings_ms.items()},
        }
        self._rows.append([row.get(name, np.nan) for name in SERIES])
        table = np.array(self._rows)
        offset = np.eye(4)
        offset[2, 3] = -HEIGHT
        self.publish(
            transport=replace(
                snapshot.transport,
                frame=frame,
                stamp_ns=result.stamp_ns,
                frames_per_second=10 * snapshot.transport.speed,
            ),
            result=result,
            chunks=chunks,
            keyframe_poses=poses,
            trajectory=trajectory,
            series={name: table[:, i] for i, name in enumerate(SERIES)},
            known_ns=np.append(snapshot.known_ns[:frame], result.stamp_ns),
            T_map_truth=offset if self._truth and frame > 10 else None,
        )

    def result(self, frame: int, params: Params) -> StepResult:
        world = self.world
        points = world.points(frame)
        ground = label(world, frame, points, params)
        stamp = START_NS + 100_000_000 * frame
        rng = np.random.default_rng(frame)
        stages = dict(zip(STAGES, rng.uniform(0.8, 1.2, 8) * [0.2, 0.6, 1.1, 0.7, 3.2, 0.9, 0.3, 0.1], strict=True))
        stages["total"] = sum(stages.values())
        state = NavState(
            stamp_ns=stamp,
            R_odom_imu=world.rotation(frame),
            p_odom_imu=world.position(frame) - [0, 0, HEIGHT],
            v_odom_imu=np.array([0.8, 0.1, 0.02]),
            b_gyro=np.array([0.8e-3, -0.3e-3, 0.1e-3]),
            b_accel=np.array([0.012, -0.004, 0.02]),
            g_odom=np.array([0.0, 0.0, -9.81]),
            R_imu_lidar=np.eye(3),
            p_imu_lidar=np.zeros(3),
        )
        cloud = Cloud(
            points,
            ground.labels,
            (20 + 40 * np.abs(np.sin(points[:, 0] * 2))).astype(np.float32),
            world.ring,
            np.zeros(len(points), np.int32),
        )
        used = len(points) // 8
        return StepResult(
            index=frame,
            stamp_ns=stamp,
            status=FrameStatus.TRACKING if frame > 3 else FrameStatus.INITIALISING,
            state=state,
            T_map_odom=np.eye(4),
            cloud=cloud,
            ground=ground,
            registration=Registration(True, 3, used, int(used * 0.86), 0.0123, np.linspace(210.0, 900.0, 6), False),
            points_in=len(points),
            points_reduced=int(len(points) * 0.7),
            points_filter=used,
            timings_ms=stages,
        )
