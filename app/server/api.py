"""The REST interface for scripts: state, parameters, transport, breakpoints, loops, notes, recordings, exports."""

import math
import re
import shutil
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, BackgroundTasks, HTTPException
from fastapi import Path as PathParam
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field

from app.server.breakpoints import Breakpoints
from app.server.folders import Folders
from app.server.fork import Engine
from app.server.journal import SUFFIX
from app.server.protocol import (
    AddNote,
    Command,
    CompareWith,
    EditLoop,
    OpenRecording,
    Pause,
    Play,
    RedoLoop,
    Restart,
    Save,
    Seek,
    SetBreakpoints,
    SetParams,
    SetSpeed,
    StepFrame,
    UndoLoop,
)
from app.server.views import LoopsState, Speed, StateView, loops_state, state_view
from app.slam.loops.types import Accept, Add, Reject, SetWeight, Solve
from app.slam.params import Params
from app.slam.results import EXPORTS
from app.slam.trajectory import truth_beside

EXPORT_PATIENCE_S = 600.0
MOST_EXPORTS = 4
"""At once: each keeps one of the threads that answer, of which there are forty."""


class Simple(BaseModel):
    action: Literal["play", "pause", "restart"]


class StepBody(BaseModel):
    action: Literal["step"]
    frames: int = Field(1, ge=1)


class SeekBody(BaseModel):
    action: Literal["seek"]
    frame: int = Field(ge=0)


class SpeedBody(BaseModel):
    action: Literal["speed"]
    factor: Speed


Action = Annotated[Simple | StepBody | SeekBody | SpeedBody, Field(discriminator="action")]


class BreakpointsBody(BaseModel):
    """Where playing pauses. A limit pauses where it is exceeded; left out or null it does not."""

    model_config = ConfigDict(extra="forbid")

    loop_found: bool = Field(False, description="A loop was accepted.")
    loop_rejected: bool = Field(False, description="A loop candidate was rejected.")
    no_ground: bool = Field(False, description="A frame without a ground plane.")
    degenerate: bool = Field(False, description="A scan leaves a direction open.")
    dropped: bool = Field(False, description="A scan was left out.")
    planarity: float | None = Field(None, ge=0, description="λ3/λ2 of the ground's seeds.")
    residual: float | None = Field(None, ge=0, description="RMS of the filter's update, m.")
    frame_ms: float | None = Field(None, ge=0, description="Time that the engine took for the frame, ms.")
    error: float | None = Field(None, ge=0, description="To the truth, m.")


class EditBody(BaseModel):
    """The user's word on the loop of two keyframes."""

    action: Literal["accept", "reject", "weigh", "add"]
    older: int = Field(ge=0)
    newer: int = Field(ge=0)
    weight: float = Field(1.0, gt=0, description="Of `weigh`: divides the loop's covariance.")
    register_: bool = Field(True, alias="register", description="Of `add`: register the two, or tie them as they are.")


class GraphBody(BaseModel):
    action: Literal["undo", "redo", "solve"]


LoopAction = Annotated[EditBody | GraphBody, Field(discriminator="action")]


class NoteBody(BaseModel):
    text: str = Field(min_length=1, max_length=1000)


class OpenBody(BaseModel):
    path: str = Field(description="Of a recording in the folders given at the start.")
    truth: str | None = Field(None, description="A TUM file there; null: the one beside the recording, if any.")


class CompareBody(BaseModel):
    path: str | None = Field(None, description="A TUM file in the folders given at the start; null: against nothing.")


EXPORTED: Final = (*(export.name for export in EXPORTS), f"session{SUFFIX}")
_ANY_OF_THESE: Final = "|".join(f"^{re.escape(name)}$" for name in EXPORTED)
ExportName = Annotated[str, PathParam(pattern=_ANY_OF_THESE, json_schema_extra={"enum": [*EXPORTED]})]


def make_router(engine: Engine, folders: Folders) -> APIRouter:
    """All routes below /api. HemislamError raised here becomes status 422."""
    router = APIRouter(prefix="/api")
    exporting = threading.BoundedSemaphore(MOST_EXPORTS)

    @router.get("/state")
    def state() -> StateView:
        """What the session is doing now."""
        return state_view(engine.snapshot)

    @router.get("/params")
    def params() -> Params:
        """All parameters as chosen; the schema holds their ranges, units and meanings."""
        return engine.snapshot.params

    @router.get("/params.yaml", response_class=PlainTextResponse)
    def params_yaml() -> str:
        """The same as commented YAML, fit for --config."""
        return engine.snapshot.params.to_yaml()

    @router.patch("/params")
    def change(tree: dict[str, dict[str, Any]]) -> Params:
        """Change some, for example {"ground": {"alpha": 30}}. One that can not be used refuses them all."""
        before = engine.snapshot.params
        after = before.merged(tree)
        _send(
            engine,
            SetParams({f"{section}.{name}": value for section, part in tree.items() for name, value in part.items()}),
        )
        return after

    @router.post("/transport", status_code=202)
    def transport(action: Action) -> None:
        """Play, pause, step, seek, set the speed ("max": as fast as it can), start again."""
        _send(engine, _command(action))

    @router.get("/breakpoints")
    def breakpoints() -> BreakpointsBody:
        """Where playing pauses."""
        return BreakpointsBody(**asdict(engine.snapshot.breakpoints))

    @router.put("/breakpoints")
    def set_breakpoints(body: BreakpointsBody) -> BreakpointsBody:
        """Pause where one of these holds, in place of those before. Why it paused, the notices in the state tell."""
        _send(engine, SetBreakpoints(Breakpoints(**body.model_dump())))
        return body

    @router.get("/loops")
    def loops() -> LoopsState:
        """Loop candidates with their verdicts, and the user's word on them."""
        return loops_state(engine.snapshot.loops)

    @router.post("/loops", status_code=202)
    def edit_loops(body: LoopAction) -> None:
        """Accept, reject, weigh or add a loop; solve all factors at once (Levenberg-Marquardt); undo or redo that."""
        _send(engine, _loop_command(body))

    @router.post("/notes", status_code=202)
    def add_note(body: NoteBody) -> None:
        """Keep a remark on the present frame in the session; the state lists them."""
        _send(engine, AddNote(body.text))

    @router.get("/recordings")
    def recordings() -> list[str]:
        """What can be opened."""
        return [str(path) for path in folders.recordings()]

    @router.post("/recordings", status_code=202)
    def open_recording(body: OpenBody) -> None:
        """Open one. Whether that worked, the notices in the state tell."""
        path = folders.openable(body.path)
        _send(engine, OpenRecording(path, folders.inside(body.truth) if body.truth else truth_beside(path)))

    @router.post("/truth", status_code=202)
    def compare_with(body: CompareBody) -> None:
        """Hold the walk against another trajectory, also what there is of it already."""
        _send(engine, CompareWith(folders.inside(body.path) if body.path else None))

    @router.get("/export/{name}", response_class=FileResponse)
    def export(name: ExportName, background: BackgroundTasks) -> FileResponse:
        """What was processed so far, as `hemislam run` writes it."""
        if not exporting.acquire(blocking=False):
            raise HTTPException(503, "Enough is being exported at present; ask again in a moment.")
        try:
            return _exported(engine, name, background)
        finally:
            exporting.release()

    return router


def _send(engine: Engine, command: Command) -> None:
    if not engine.snapshot.engine_alive and not isinstance(command, Restart | OpenRecording):
        raise HTTPException(503, "The engine's process has ended; the action `restart` starts it again.")
    engine.send(command)


def _command(action: Simple | StepBody | SeekBody | SpeedBody) -> Command:
    match action:
        case StepBody(frames=frames):
            return StepFrame(frames)
        case SeekBody(frame=frame):
            return Seek(frame)
        case SpeedBody(factor=factor):
            return SetSpeed(math.inf if factor == "max" else factor)
        case Simple(action="play"):
            return Play()
        case Simple(action="pause"):
            return Pause()
        case _:
            return Restart()


def _loop_command(body: EditBody | GraphBody) -> Command:
    match body:
        case EditBody(action="accept", older=older, newer=newer):
            return EditLoop(Accept(older, newer))
        case EditBody(action="reject", older=older, newer=newer):
            return EditLoop(Reject(older, newer))
        case EditBody(action="weigh", older=older, newer=newer):
            return EditLoop(SetWeight(older, newer, body.weight))
        case EditBody(older=older, newer=newer):
            return EditLoop(Add(older, newer, register=body.register_))
        case GraphBody(action="solve"):
            return EditLoop(Solve())
        case GraphBody(action="undo"):
            return UndoLoop()
        case _:
            return RedoLoop()


def _exported(engine: Engine, name: str, background: BackgroundTasks) -> FileResponse:
    folder = Path(tempfile.mkdtemp(prefix="hemislam-export-"))
    background.add_task(shutil.rmtree, folder, ignore_errors=True)
    try:
        _save(engine, folder, trajectory_only=name == "trajectory.tum")
        if not (folder / name).exists():
            raise HTTPException(404, f"There is no {name}, since loops are not looked for; set loops.enabled.")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return FileResponse(folder / name, filename=name, background=background)


def _save(engine: Engine, folder: Path, *, trajectory_only: bool) -> None:
    """Let the engine save into a folder and wait for it."""
    snapshot = engine.snapshot
    if snapshot.transport.frame < 0:
        raise HTTPException(409, "No frame was processed yet; open a recording and play it first.")
    _send(engine, Save(folder, trajectory_only))
    deadline = time.monotonic() + EXPORT_PATIENCE_S
    while time.monotonic() < deadline:
        for saved in snapshot.saved:
            if saved.folder == folder:
                if saved.error:
                    raise HTTPException(500, saved.error)
                return
        if not snapshot.engine_alive:
            raise HTTPException(503, "The engine's process has ended while it was saving.")
        snapshot = engine.wait(snapshot.revision, timeout=1.0)
    raise HTTPException(504, f"Saving took longer than {EXPORT_PATIENCE_S:.0f} s.")
