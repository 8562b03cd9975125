"""The REST interface for scripts: state, parameters, transport, recordings, exports."""

import math
import shutil
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, BackgroundTasks, HTTPException
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel, Field

from app.server.folders import Folders
from app.server.fork import Engine
from app.server.protocol import (
    Command,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Save,
    Seek,
    SetParams,
    SetSpeed,
    StepFrame,
)
from app.server.views import Speed, StateView, state_view
from app.slam.params import Params

EXPORT_PATIENCE_S = 600.0


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


class OpenBody(BaseModel):
    path: str = Field(description="Of a recording in the folders given at the start.")
    truth: str | None = None


Export = Literal["trajectory.tum", "timings.csv", "map.ply", "report.json"]


def make_router(engine: Engine, folders: Folders) -> APIRouter:
    """All routes below /api. HemislamError raised here becomes status 422."""
    router = APIRouter(prefix="/api")

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

    @router.get("/recordings")
    def recordings() -> list[str]:
        """What can be opened."""
        return [str(path) for path in folders.recordings()]

    @router.post("/recordings", status_code=202)
    def open_recording(body: OpenBody) -> None:
        """Open one. Whether that worked, the notices in the state tell."""
        truth = folders.inside(body.truth) if body.truth else None
        _send(engine, OpenRecording(folders.openable(body.path), truth))

    @router.get("/export/{name}", response_class=FileResponse)
    def export(name: Export, background: BackgroundTasks) -> FileResponse:
        """What was processed so far, as `hemislam run` writes it."""
        folder = Path(tempfile.mkdtemp(prefix="hemislam-export-"))
        background.add_task(shutil.rmtree, folder, ignore_errors=True)
        try:
            _save(engine, folder, trajectory_only=name == "trajectory.tum")
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return FileResponse(folder / name, filename=name, background=background)

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
