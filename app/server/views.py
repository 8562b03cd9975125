"""The session's state as the REST interface sends it.

Most fields are copied by name from the values in `Snapshot`; those with another name or unit are converted.
"""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from app.mapping.kept import Note
from app.sensors.findings import Finding
from app.sensors.live.status import LiveState
from app.server.protocol import LoopsView, Notice, Progress, Snapshot, Transport
from app.slam.loops import edit_files
from app.slam.types import StepResult


class RestModel(BaseModel):
    """NaN becomes null, because JSON has no NaN."""

    model_config = ConfigDict(from_attributes=True)


class RecordingView(RestModel):
    path: Path
    duration_s: float
    frames: int
    findings: list[Finding]


class FrameView(RestModel):
    """The newest frame, without its points."""

    index: int
    stamp_ns: int
    status: str
    position: list[float] = Field(description="Position of the IMU in the map, m.")
    quaternion: list[float] = Field(description="x, y, z, w; rotates from the IMU frame to the map frame.")
    velocity: list[float] = Field(description="Velocity of the IMU in the odometry frame, m/s.")
    ground_found: bool
    ground_reason: str
    planarity: float | None
    seeds: int
    ground_share: float | None
    inliers: int
    residual_rms: float | None
    degenerate: bool
    timings_ms: dict[str, float]
    distance: float | None = Field(description="Length of the trajectory so far, m.")
    error: float | None = Field(
        description="Distance to the truth, m, with the truth aligned to the trajectory so far."
    )


class LoopView(RestModel):
    """A loop candidate between two keyframes."""

    older: int
    newer: int
    verdict: str
    reason: str
    origin: str
    edited: bool = Field(description="Whether the user decided the verdict.")
    weight: float
    represented_by: tuple[int, int] | None = Field(description="The loop that is in the graph in place of this one.")
    repeats: tuple[int, int] | None = Field(
        description="A loop nearby that measured the same; this one adds a measurement between its keyframes."
    )


class LoopsState(BaseModel):
    loops: list[LoopView]
    edits: list[dict[str, Any]] = Field(description="The user's edits in order, in the format of a file of edits.")
    undone: list[dict[str, Any]] = Field(description="Undone edits that can be redone; the last entry is redone first.")


class StateView(RestModel):
    session: int
    revision: int
    engine_alive: bool
    recording: RecordingView | None
    transport: Transport
    frame: FrameView | None
    keyframes: int
    progress: Progress | None
    pending_restart: list[str]
    notices: list[Notice]
    live: LiveState | None
    session_file: Path | None = Field(description="The session file; opening it continues the session.")
    notes: list[Note]


def loops_state(view: LoopsView) -> LoopsState:
    return LoopsState(
        loops=[LoopView.model_validate(edge) for edge in view.edges],
        edits=edit_files.entries_of(view.undo),
        undone=edit_files.entries_of(view.redo),
    )


def state_view(snapshot: Snapshot) -> StateView:
    computed = {
        "frame": _frame(snapshot.result, snapshot) if snapshot.result else None,
        "keyframes": len(snapshot.chunks),
    }
    taken = {name: getattr(snapshot, name) for name in StateView.model_fields if name not in computed}
    return StateView.model_validate(taken | computed)


def _frame(result: StepResult, snapshot: Snapshot) -> FrameView:
    T, ground = result.T_map_imu, result.ground
    newest = {name: column[-1] for name, column in snapshot.series.items() if len(column)}
    return FrameView(
        **{name: getattr(result, name) for name in ("index", "stamp_ns", "status", "timings_ms")},
        **{name: getattr(ground, name) for name in ("planarity", "seeds")},
        **{name: getattr(result.registration, name) for name in ("inliers", "residual_rms", "degenerate")},
        position=T[:3, 3].tolist(),
        quaternion=Rotation.from_matrix(T[:3, :3]).as_quat().tolist(),
        velocity=result.state.v_odom_imu.tolist(),
        ground_found=ground.found,
        ground_reason=ground.reason,
        ground_share=ground.share,
        distance=newest.get("distance"),
        error=newest.get("error_m"),
    )
