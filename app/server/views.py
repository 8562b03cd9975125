"""The session's state as the REST interface sends it."""

import math
from dataclasses import asdict
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field
from scipy.spatial.transform import Rotation

from app.sensors.live.status import LiveState
from app.server.protocol import LoopsView, OpenedRecording, Snapshot
from app.slam.loops import edit_files
from app.slam.types import StepResult

Speed = Annotated[float, Field(ge=0.1)] | Literal["max"]
"""Times real time; JSON knows no infinity."""


class FindingView(BaseModel):
    subject: str
    verdict: str
    text: str
    option: str


class RecordingView(BaseModel):
    path: str
    duration_s: float
    frames: int
    findings: list[FindingView]


class TransportView(BaseModel):
    playing: bool
    speed: Speed
    frame: int
    stamp_ns: int
    finished: bool
    frames_per_second: float
    dropped: int


class FrameView(BaseModel):
    """The newest frame, without its points."""

    index: int
    stamp_ns: int
    status: str
    position: list[float] = Field(description="Of the IMU in the map, m.")
    quaternion: list[float] = Field(description="x, y, z, w: from the IMU's axes to the map's.")
    velocity: list[float] = Field(description="m/s, odometry frame.")
    ground_found: bool
    ground_reason: str
    planarity: float | None
    seeds: int
    ground_share: float | None
    inliers: int
    residual_rms: float | None
    degenerate: bool
    timings_ms: dict[str, float]
    distance: float | None = Field(description="Walked, m.")
    error: float | None = Field(description="To the truth, aligned to the walk so far, m.")


class NoticeView(BaseModel):
    number: int
    level: str
    text: str


class ProgressView(BaseModel):
    title: str
    fraction: float | None


class LiveView(BaseModel):
    """How the live source is doing."""

    lidar_hz: float
    imu_hz: float
    lidar_age_s: float | None = Field(description="Since the last arrival.")
    imu_age_s: float | None
    backlog: int = Field(description="Scans that wait for the engine.")
    clock: str = Field(description='Whose time is used: "sensor", "host", or "" while that is not settled.')
    imu_lag_s: float | None = Field(description="By how much the IMU's stamps lag behind the LiDAR's.")
    sensor: str
    recorded: int | None = Field(description="Bytes written; null if nothing is recorded.")
    counters: dict[str, int]


class NoteView(BaseModel):
    frame: int
    text: str


class LoopView(BaseModel):
    """A loop candidate, by keyframes."""

    older: int
    newer: int
    verdict: str
    reason: str
    origin: str
    edited: bool = Field(description="Whether the verdict is the user's.")
    weight: float
    represented_by: tuple[int, int] | None = Field(description="A loop that is in the graph for both.")
    repeats: tuple[int, int] | None = Field(
        description="A loop near it that measured the same; both are between its keyframes."
    )


class LoopsState(BaseModel):
    loops: list[LoopView]
    edits: list[dict[str, Any]] = Field(description="The user's word on loops, in order, as in a file of edits.")
    undone: list[dict[str, Any]] = Field(description="That can be done again, the next one last.")


class StateView(BaseModel):
    session: int
    revision: int
    engine_alive: bool
    recording: RecordingView | None
    transport: TransportView
    frame: FrameView | None
    keyframes: int
    progress: ProgressView | None
    pending_restart: list[str]
    notices: list[NoticeView]
    live: LiveView | None
    journal: str | None = Field(description="File in which the session is kept; opening it goes on from there.")
    notes: list[NoteView]


def loops_state(view: LoopsView) -> LoopsState:
    return LoopsState(
        loops=[
            LoopView(
                older=edge.older,
                newer=edge.newer,
                verdict=edge.verdict,
                reason=edge.reason,
                origin=edge.origin,
                edited=edge.edited,
                weight=edge.weight,
                represented_by=edge.represented_by,
                repeats=edge.repeats,
            )
            for edge in view.edges
        ],
        edits=yaml.safe_load(edit_files.write(view.undo)),
        undone=yaml.safe_load(edit_files.write(view.redo)),
    )


def state_view(snapshot: Snapshot) -> StateView:
    recording, transport, progress = snapshot.recording, snapshot.transport, snapshot.progress
    return StateView(
        session=snapshot.session,
        revision=snapshot.revision,
        engine_alive=snapshot.engine_alive,
        recording=_recording(recording) if recording else None,
        transport=TransportView(
            playing=transport.playing,
            speed="max" if math.isinf(transport.speed) else transport.speed,
            frame=transport.frame,
            stamp_ns=transport.stamp_ns,
            finished=transport.finished,
            frames_per_second=transport.frames_per_second,
            dropped=transport.dropped,
        ),
        frame=_frame(snapshot.result, snapshot) if snapshot.result else None,
        keyframes=len(snapshot.chunks),
        progress=ProgressView(title=progress.title, fraction=_finite(progress.fraction)) if progress else None,
        pending_restart=list(snapshot.pending_restart),
        notices=[NoticeView(number=n.number, level=n.level, text=n.text) for n in snapshot.notices],
        live=_live(snapshot.live) if snapshot.live else None,
        journal=str(snapshot.journal) if snapshot.journal else None,
        notes=[NoteView(frame=note.frame, text=note.text) for note in snapshot.notes],
    )


def _live(state: LiveState) -> LiveView:
    return LiveView(
        lidar_hz=state.lidar_hz,
        imu_hz=state.imu_hz,
        lidar_age_s=state.lidar_age_s,
        imu_age_s=state.imu_age_s,
        backlog=state.backlog,
        clock=state.clock,
        imu_lag_s=state.offset_s,
        sensor=state.sensor,
        recorded=state.recorded,
        counters=asdict(state.counters),
    )


def _recording(recording: OpenedRecording) -> RecordingView:
    return RecordingView(
        path=str(recording.path),
        duration_s=recording.duration_s,
        frames=recording.frames,
        findings=[
            FindingView(subject=f.subject, verdict=f.verdict, text=f.text, option=f.option) for f in recording.findings
        ],
    )


def _frame(result: StepResult, snapshot: Snapshot) -> FrameView:
    T, ground, registration = result.T_map_imu, result.ground, result.registration
    newest = {name: column[-1] for name, column in snapshot.series.items() if len(column)}
    return FrameView(
        index=result.index,
        stamp_ns=result.stamp_ns,
        status=result.status.value,
        position=T[:3, 3].tolist(),
        quaternion=Rotation.from_matrix(T[:3, :3]).as_quat().tolist(),
        velocity=result.state.v_odom_imu.tolist(),
        ground_found=ground.found,
        ground_reason=ground.reason,
        planarity=_finite(ground.planarity),
        seeds=ground.seeds,
        ground_share=_finite(ground.share),
        inliers=registration.inliers,
        residual_rms=_finite(registration.residual_rms),
        degenerate=registration.degenerate,
        timings_ms=result.timings_ms,
        distance=_finite(newest.get("distance", math.nan)),
        error=_finite(newest.get("error_m", math.nan)),
    )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
