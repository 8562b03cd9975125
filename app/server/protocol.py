"""Messages between the engine's process and its users: commands one way, snapshots the other.

Both are frozen values. A snapshot is cumulative: a reader that misses ten of them loses nothing.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from app.export.points import EVERYTHING, Choice
from app.georeference.align import Alignment
from app.georeference.survey import Survey
from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import Kept
from app.mapping.session_file import Speed
from app.sensors.findings import Finding
from app.sensors.live.status import LiveState
from app.slam.frames import READOUTS, Frame
from app.slam.loops import types as loops
from app.slam.loops.edits import LoopEdit
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.types import F32, F64, I64, U8, U16, StepResult

LIVE = Path("live")
"""Stands for the live source wherever a recording is named."""
ACKNOWLEDGED = "acknowledged"
"""Sent to the engine in answer to each delta: the engine may send the next one."""


# --- commands ------------------------------------------------------------------------------------
class Command(msgspec.Struct, frozen=True):
    """A request of the user to the engine."""


class Play(Command, frozen=True):
    """Play at the chosen speed; at the end of a recording, play again from the first frame, as after `Seek(0)`."""


class Pause(Command, frozen=True):
    """Stop after the present frame."""


class StepFrame(Command, frozen=True):
    """Pause and go this many frames forward, or back if negative."""

    frames: int = 1


class SetSpeed(Command, frozen=True):
    """Replay speed as a multiple of real time; inf: as fast as possible."""

    factor: float


class Seek(Command, frozen=True):
    """Go back or forward to a frame. A frame processed before is shown as it was, except for its ground labels.

    The frames after it are processed again, with the present parameters.
    """

    frame: int


class SetBreakpoints(Command, frozen=True):
    """From now on, pause at frames that meet one of these conditions."""

    breakpoints: Breakpoints


class Georeference(Command, frozen=True):
    """From now on, georeference the map by these fixes or control points; None: stop georeferencing."""

    survey: Survey | None


class SetParams(Command, frozen=True):
    """Change parameters by dotted name, for example {"ground.alpha": 30}."""

    values: dict[str, Any]


class LoadParams(Command, frozen=True):
    """Replace all parameters by those of a YAML text."""

    yaml: str


class OpenRecording(Command, frozen=True):
    """Leave the present recording and open another one at its first frame; a live source is played from then on."""

    path: Path
    truth: Path | None = None


class CompareWith(Command, frozen=True):
    """Compare the trajectory with another one (TUM): the truth, or the result of another run or program. None: stop."""

    path: Path | None


class Calibrated(Command, frozen=True):
    """Keep a sentence for the report on what the recording shows about its sensors; "": nothing."""

    text: str


class Restart(Command, frozen=True):
    """Restart the present recording with the present parameters; loop edits and notes stay, but not on a live source.

    stay: return to the frame that was shown, or that the session was going to.
    """

    stay: bool = False


class Save(Command, frozen=True):
    """Write the results of the frames so far, replacing older ones in the folder; `Snapshot.saved` reports the end.

    Attributes:
        formats: as in `hemislam export`; none: all files of a run. choice: of points, as in `hemislam export`.
        fetched: the sender takes the files at once and removes the folder; the page does not mention it.
    """

    folder: Path
    formats: tuple[str, ...] = ()
    choice: Choice = EVERYTHING
    fetched: bool = False


class EditLabels(Command, frozen=True):
    """Change the labels (as in `Cloud`) of a keyframe's points: one label for all, or one per point in order."""

    keyframe: int
    labels: tuple[int, ...] | int


class UndoLabels(Command, frozen=True):
    """Undo the last `EditLabels`."""


class LoopCommand(Command, frozen=True):
    """A command about loops."""


class EditLoop(LoopCommand, frozen=True):
    """Accept, reject, add or weigh a loop."""

    command: LoopEdit


class UndoLoop(LoopCommand, frozen=True):
    """Undo the last `EditLoop`."""


class RedoLoop(LoopCommand, frozen=True):
    """Repeat the last undone edit."""


class TryLoop(LoopCommand, frozen=True):
    """Show the effect of an edit on the graph in `LoopsView.tried`, without applying it; None: show nothing."""

    command: LoopEdit | None


class InspectLoop(LoopCommand, frozen=True):
    """Show all details of a candidate in `LoopsView.inspected`; None: show nothing."""

    pair: loops.Pair | None


# --- snapshots -----------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Chunk:
    """One keyframe's points, thinned for display (`app.server.chunks`). Sent once; its pose may change.

    Points are in random order, so the first k are a fair sample.

    Attributes:
        index, frame, stamp_ns: of the keyframe. T_imu_lidar: (4, 4).
        points: (n, 3) float32 m, LiDAR frame. labels: (n,) uint8. intensity: (n,) float32. ring: (n,) uint16.
        level: how often it was thinned.
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


@dataclass(frozen=True, slots=True)
class OpenedRecording:
    """The open recording, or the processed part of it, from `start_s` to `end_s` after `start_ns`."""

    path: Path
    start_ns: int
    end_s: float
    frames: int
    findings: tuple[Finding, ...]
    truth_stamps_ns: I64 | None = None
    truth_positions: F64 | None = None
    """(m, 3) positions of the IMU, in the truth's own frame."""
    truth: Path | None = None
    fixes: bool = False
    """Whether the recording holds satellite fixes."""
    start_s: float = 0.0

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True, slots=True)
class Transport:
    playing: bool = False
    speed: Speed = 1.0
    frame: int = -1
    """Index of the newest processed frame; -1 before the first."""
    stamp_ns: int = 0
    finished: bool = False
    frames_per_second: float = 0.0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """Long work in progress. fraction: 0-1, nan while unknown. frame: to which it goes, if it is a seek."""

    title: str
    fraction: float
    frame: int | None = None

    @classmethod
    def opening(cls, recording: Path | None) -> "Progress":
        if recording is None:
            return cls("Starting", math.nan)
        return cls("Connecting to the sensor" if recording == LIVE else f"Opening {recording.name}", math.nan)


@dataclass(frozen=True, slots=True)
class Saved:
    """A `Save` that has ended.

    Attributes:
        error: why it failed; "" if it did not. mendable: whether the user can fix that. fetched: as in `Save`.
    """

    folder: Path
    error: str = ""
    fetched: bool = False
    mendable: bool = True


@dataclass(frozen=True, slots=True)
class Notice:
    """A message to the user. number: increases by one with every notice. recording: name of the one open then."""

    number: int
    level: Literal["info", "warning", "error"]
    text: str
    recording: str = ""


@dataclass(frozen=True, slots=True)
class LoopsView:
    """Loops at the newest frame.

    Attributes:
        edges: all candidates, by keyframes. residuals: of every factor of the graph, odometry first.
        undo, redo: edits that can be undone or redone, the next one last.
        inspected: answer to `InspectLoop`. tried: answer to `TryLoop`.
    """

    edges: tuple[loops.LoopEdge, ...] = ()
    residuals: tuple[loops.FactorResidual, ...] = ()
    undo: tuple[LoopEdit, ...] = ()
    redo: tuple[LoopEdit, ...] = ()
    inspected: tuple[loops.Pair, loops.LoopDetail] | None = None
    tried: tuple[LoopEdit, loops.Preview] | None = None


SERIES = ("stamp_s", "distance", "error_m", *READOUTS)
"""Numbers by frame. stamp_s: since the start of the recording. distance: length of the trajectory so far (m).
error_m: to the truth (m), aligned to all frames shown."""


@dataclass(frozen=True, slots=True)
class Earth:
    """Georeference of the map.

    Attributes:
        survey: the fixes or control points to use; None: none.
        found: their alignment with the map; None until it is known.
        problem: why they cannot be aligned, in a sentence.
    """

    survey: Survey | None = None
    found: Alignment | None = None
    problem: str = ""


_NO_POSES, _NO_POSITIONS, _NO_SERIES = np.empty((0, 4, 4)), np.empty((0, 3)), dict.fromkeys(SERIES, np.empty(0))
"""Empty values. All snapshots share these objects, which tells the page that nothing has changed."""


@dataclass(frozen=True, slots=True)
class Snapshot(Kept):
    """Everything that the page draws, as one immutable value.

    Attributes:
        session: increases when a recording is opened or restarted. revision: increases with every snapshot.
        params: as chosen. pending_restart: names of changed parameters that take effect only on restart.
        result: of the newest frame, labelled with the present ground parameters, without its `keyframe`.
        chunks: of all keyframes up to the frame. keyframe_poses: (k, 4, 4) T_map_imu.
        trajectory: (n, 3) m, positions of the IMU in the map. corrections: of odometry, by loops and by
            `adjustment`, which levels or georeferences the map.
        series: (n,) arrays by SERIES name. known_ns: (m,) stamps of all frames, also of those after the shown one.
        T_map_truth: (4, 4), aligns the truth with the trajectory; None until the trajectory determines it.
        notices: the newest 50. saved: the newest 10.
        live: state of the live source; None for a recording.
        earth: for the map when the session last stood still.
        session_file: keeps this session; opening it resumes the session. resumed: whether this session was resumed.
    """

    session: int = 0
    revision: int = 0
    params: Params = field(default_factory=Params)
    pending_restart: tuple[str, ...] = ()
    recording: OpenedRecording | None = None
    transport: Transport = Transport()
    result: StepResult | None = None
    chunks: tuple[Chunk, ...] = ()
    keyframe_poses: F64 = field(default_factory=lambda: _NO_POSES)
    trajectory: F64 = field(default_factory=lambda: _NO_POSITIONS)
    corrections: MapFrame = field(default_factory=MapFrame)
    adjustment: MapFrame = field(default_factory=MapFrame)
    loops: LoopsView = LoopsView()
    series: dict[str, F64] = field(default_factory=lambda: _NO_SERIES)
    known_ns: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    T_map_truth: F64 | None = None
    breakpoints: Breakpoints = field(default_factory=Breakpoints)
    progress: Progress | None = None
    notices: tuple[Notice, ...] = ()
    saved: tuple[Saved, ...] = ()
    engine_alive: bool = True
    session_file: Path | None = None
    resumed: bool = False
    live: LiveState | None = None
    earth: Earth = Earth()

    @property
    def last_notice(self) -> int:
        """The number of the newest notice, 0 if there is none."""
        return self.notices[-1].number if self.notices else 0


@dataclass(frozen=True, slots=True)
class Delta:
    """Changes since the last delta.

    Attributes:
        replaced: new values of fields of `Snapshot`; `loops` without its edges. If it contains `session`, another
            session begins, and the reader drops its edges.
        edges: changed edges. keep: how many of its frames the reader keeps before it appends `frames`.
        chunks: of the next keyframes, and of earlier ones whose labels changed. notices: new ones.
    """

    replaced: dict[str, Any]
    edges: loops.LoopChange | None
    keep: int
    frames: tuple[Frame, ...]
    chunks: tuple[Chunk, ...]
    notices: tuple[Notice, ...]
