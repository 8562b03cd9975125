"""What crosses the border of the engine's process: commands one way, snapshots the other.

Both are plain frozen values. A command is data, so that it can be written to a session file. A snapshot is
cumulative: a reader that misses ten of them loses nothing.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from app.mapping.breakpoints import Breakpoints
from app.mapping.session_file import Note
from app.sensors.findings import Finding
from app.sensors.live.status import LiveState
from app.slam.frames import READOUTS, Frame
from app.slam.loops import types as loops
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.types import F32, F64, I64, U8, U16, StepResult

if TYPE_CHECKING:
    from app.mapping.session import Session

LIVE = Path("live")
"""Stands for the live source wherever a recording is named."""
ACKNOWLEDGED = "acknowledged"
"""Sent to the engine in answer to each delta: the next one may come."""


# --- commands ------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Play:
    """Go on at the chosen speed."""


@dataclass(frozen=True, slots=True)
class Pause:
    """Stop after the frame that is being worked on."""


@dataclass(frozen=True, slots=True)
class StepFrame:
    """Pause and go this many frames on; back, if negative."""

    frames: int = 1


@dataclass(frozen=True, slots=True)
class SetSpeed:
    """Replay speed as a multiple of real time; inf is as fast as it can."""

    factor: float


@dataclass(frozen=True, slots=True)
class Seek:
    """Go to a frame, back or on. One that was processed before is shown as it was, but for ground labels.

    Going on from there, the frames that follow are processed anew, with the present parameters.
    """

    frame: int


@dataclass(frozen=True, slots=True)
class SetBreakpoints:
    """Pause at frames where one of these holds, from now on."""

    breakpoints: Breakpoints


@dataclass(frozen=True, slots=True)
class AddNote:
    """Keep a remark on the present frame in the session."""

    text: str


@dataclass(frozen=True, slots=True)
class SetParams:
    """Change parameters by dotted name, for example {"ground.alpha": 30}."""

    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class LoadParams:
    """Replace all parameters by those of a YAML text."""

    yaml: str


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """Leave the present recording and open another one from its first frame."""

    path: Path
    truth: Path | None = None


@dataclass(frozen=True, slots=True)
class CompareWith:
    """Hold the walk, also what there is of it already, against another trajectory (TUM): the truth, or what another
    program or another run made of the same recording. None: against nothing.
    """

    path: Path | None


@dataclass(frozen=True, slots=True)
class Restart:
    """Start the present recording again with the present parameters."""


@dataclass(frozen=True, slots=True)
class Save:
    """Write trajectory.tum, timings.csv, map.ply and report.json of what was processed so far.

    `trajectory_only` leaves out all but the first, which takes no time. Older results in the folder
    are replaced once the new ones are complete; `Snapshot.saved` tells when.
    """

    folder: Path
    trajectory_only: bool = False


@dataclass(frozen=True, slots=True)
class EditLoop:
    """The user's word on a loop: accept, reject, add or weigh it."""

    command: loops.LoopEdit


@dataclass(frozen=True, slots=True)
class UndoLoop:
    """Take the last `EditLoop` back."""


@dataclass(frozen=True, slots=True)
class RedoLoop:
    """Do again what was undone last."""


@dataclass(frozen=True, slots=True)
class TryLoop:
    """Show in `LoopsView.tried` what the graph would become by a command, without doing it; None: no more."""

    command: loops.LoopEdit | None


@dataclass(frozen=True, slots=True)
class InspectLoop:
    """Show in `LoopsView.inspected` all there is on a candidate; None: no more."""

    pair: loops.Pair | None


LoopCommand = EditLoop | UndoLoop | RedoLoop | TryLoop | InspectLoop
Command = (
    Play
    | Pause
    | StepFrame
    | SetSpeed
    | Seek
    | SetBreakpoints
    | AddNote
    | SetParams
    | LoadParams
    | OpenRecording
    | CompareWith
    | Restart
    | Save
    | LoopCommand
)


# --- snapshots -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Chunk:
    """One keyframe's points, thinned for display, in the LiDAR frame of that keyframe.

    Sent once; a reader thins it further (`app.server.chunks`) when the whole map has too many points.
    T_imu_lidar is fixed per chunk; the keyframe's pose is in `Snapshot.keyframe_poses`.
    Points are in random order: the first k are a fair sample, for a page that must show fewer.

    Attributes:
        index: of the keyframe. frame: that it was. stamp_ns: its time.
        points: (n, 3) float32 m. labels: (n,) uint8. intensity: (n,) float32. ring: (n,) uint16.
        T_imu_lidar: (4, 4). level: how often it was thinned. joined: how many keyframes' points it took over.
    """

    index: int
    frame: int
    stamp_ns: int
    points: F32
    labels: U8
    intensity: F32
    ring: U16
    T_imu_lidar: F64
    level: int = 0
    joined: int = 0


@dataclass(frozen=True, slots=True)
class OpenedRecording:
    """What the page knows of the recording that is open."""

    path: Path
    start_ns: int
    duration_s: float
    frames: int
    findings: tuple[Finding, ...]
    truth_stamps_ns: I64 | None = None
    truth_positions: F64 | None = None
    """(m, 3) truth positions of the IMU, in the truth's own frame, if truth was given."""
    truth: Path | None = None

    @classmethod
    def of(cls, session: "Session") -> "OpenedRecording":
        """What a session works on. A source without an end is as long as what was processed of it."""
        info, truth = session.feed.info, session.truth
        newest = session.frames[session.frame] if session.frame >= 0 else None
        so_far_s = (newest.stamp_ns - info.start_ns) * 1e-9 if newest is not None else 0.0
        return cls(
            path=info.path,
            start_ns=info.start_ns,
            duration_s=so_far_s if info.duration_s is None else info.duration_s,
            frames=session.frame + 1 if info.frames is None else info.frames,
            findings=session.findings,
            truth_stamps_ns=truth.stamps_ns if truth else None,
            truth_positions=truth.positions if truth else None,
            truth=session.truth_path,
        )


@dataclass(frozen=True, slots=True)
class Transport:
    playing: bool = False
    speed: float = 1.0
    frame: int = -1
    """Index of the newest processed frame; -1 before the first."""
    stamp_ns: int = 0
    finished: bool = False
    frames_per_second: float = 0.0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """Long work under way in the engine's process. fraction is 0-1; nan while unknown."""

    title: str
    fraction: float


@dataclass(frozen=True, slots=True)
class Saved:
    """A `Save` that has ended; `error` says why it failed, "" if it did not."""

    folder: Path
    error: str = ""


@dataclass(frozen=True, slots=True)
class Notice:
    """Something to tell the user once. `number` increases by one with every notice."""

    number: int
    level: Literal["info", "warning", "error"]
    text: str


@dataclass(frozen=True, slots=True)
class LoopsView:
    """Loops as they count at the newest frame.

    Attributes:
        edges: all candidates, by keyframes. residuals: of every factor of the graph, odometry first.
        undo, redo: commands that can be taken back (the last one next) or done again (likewise).
        inspected: what `InspectLoop` asked for. tried: what `TryLoop` asked for.
    """

    edges: tuple[loops.LoopEdge, ...] = ()
    residuals: tuple[loops.FactorResidual, ...] = ()
    undo: tuple[loops.LoopEdit, ...] = ()
    redo: tuple[loops.LoopEdit, ...] = ()
    inspected: tuple[loops.Pair, loops.LoopDetail] | None = None
    tried: tuple[loops.LoopEdit, loops.Preview] | None = None


SERIES = ("stamp_s", "distance", "error_m", *READOUTS)
"""Names of the arrays of numbers by frame. `stamp_s` counts from the start of the recording. `distance` is the length
of the trajectory up to the frame (m). `error_m` is the distance to the truth (m), aligned to all frames shown."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All that the page draws, as one immutable value.

    Attributes:
        session: grows when a recording is opened or restarted: the scene starts empty.
        revision: grows with every snapshot.
        params: as chosen; the engine uses them from its next frame on, but for
        pending_restart: names of parameters that were changed and act on restart only.
        result: newest frame, already relabelled with the present ground parameters. Its `keyframe`
            is left out, since that is sent as a chunk.
        chunks: within a session appended, thinned, and taken away at the end when going back.
        keyframe_poses: (k, 4, 4) T_map_imu of each keyframe.
        trajectory: (n, 3) positions of the IMU in the map, every processed frame.
        corrections: by which loops lay odometry in the map.
        loops: candidates, their verdicts and what was asked about them.
        series: (n,) arrays by SERIES name.
        T_map_truth: (4, 4) that lays the truth's positions over the map, None until the walk
            determines it.
        breakpoints: where playing pauses.
        notes: of this session, in the order in which they were made.
        progress: what takes long just now, or None. notices: the newest 50.
        saved: the newest 10 `Save`s that ended.
        engine_alive: False when the engine's process has died.
        live: how the live source is doing; None for a recording.
        session_file: file in which this session is kept; opening it goes on from there.
    """

    session: int = 0
    revision: int = 0
    params: Params = field(default_factory=Params)
    pending_restart: tuple[str, ...] = ()
    recording: OpenedRecording | None = None
    transport: Transport = Transport()
    result: StepResult | None = None
    chunks: tuple[Chunk, ...] = ()
    keyframe_poses: F64 | None = None
    trajectory: F64 | None = None
    corrections: MapFrame = field(default_factory=MapFrame)
    loops: LoopsView = LoopsView()
    series: dict[str, F64] = field(default_factory=dict)
    T_map_truth: F64 | None = None
    breakpoints: Breakpoints = field(default_factory=Breakpoints)
    notes: tuple[Note, ...] = ()
    progress: Progress | None = None
    notices: tuple[Notice, ...] = ()
    saved: tuple[Saved, ...] = ()
    engine_alive: bool = True
    session_file: Path | None = None
    live: LiveState | None = None


@dataclass(frozen=True, slots=True)
class Delta:
    """Changes since the delta before.

    Attributes:
        replaced: new values of fields of `Snapshot`; `loops` without its edges. With `session`, another session
            begins: the reader drops its edges.
        edges: what has changed of the loops' edges.
        keep: the reader keeps so many of its frames and appends `frames`.
        chunks: of the next keyframes whose cloud the reader does not have.
        notices: new since then.
    """

    replaced: dict[str, Any]
    edges: loops.LoopChange | None
    keep: int
    frames: tuple[Frame, ...]
    chunks: tuple[Chunk, ...]
    notices: tuple[Notice, ...]
