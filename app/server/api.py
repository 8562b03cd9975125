"""The REST interface for scripts: state, parameters, transport, breakpoints, loops, notes, recordings, exports.

A new action is one entry in `TRANSPORT`, `LABELS` or `LOOPS`.
"""

import functools
import operator
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, BackgroundTasks, Body, HTTPException, Query
from fastapi import Path as PathParam
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field, create_model

from app.export.exports import EXPORTS
from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import Note
from app.mapping.session_file import SUFFIX, Speed
from app.server import protocol
from app.server.folders import Folders
from app.server.keeping import AddNote, EditNote
from app.server.protocol import Command
from app.server.uploads import discard, receive
from app.server.views import LoopsState, StateView, loops_state, state_view
from app.server.worker import RunningEngine
from app.slam.loops.edits import Accept, Add, LoopEdit, Reject, SetWeight, Solve
from app.slam.params import Params
from app.slam.trajectory import truth_beside
from app.slam.types import MOVING, NON_GROUND

EXPORT_TIMEOUT_S = 600.0
MOST_EXPORTS = 4
"""Maximum number of exports at the same time. Each occupies one of the forty threads that answer requests."""


# --- actions -------------------------------------------------------------------------------------
Actions = Mapping[str, tuple[Callable[..., Command], Mapping[str, Any]]]
"""By name: makes the command that `{"action": NAME, ...}` sends to the engine, and the fields of that body, in the form
that `pydantic.create_model` takes.
"""


def _edit(kind: Callable[..., LoopEdit]) -> Callable[..., Command]:
    return lambda **fields: protocol.EditLoop(kind(**fields))


Index = Annotated[int, Field(ge=0, le=10**12 - 1)]  # session files hold no larger numbers
Count = Annotated[int, Field(ge=1)]
Weight = Annotated[float, Field(gt=0, description="Divides the loop's covariance.")]
Registered = Annotated[
    bool, Field(alias="register", description="Register the two submaps; false: keep their pose in the graph.")
]
Label = Annotated[int, Field(ge=NON_GROUND, le=MOVING)]
Labels = Annotated[
    Label | tuple[Label, ...],
    Field(description="One label for all points, or one per point: 0 not ground, 1 ground, 2 seed, 3 moving."),
]
PAIR = {"older": (Index, ...), "newer": (Index, ...)}

TRANSPORT: Actions = {
    "play": (protocol.Play, {}),
    "pause": (protocol.Pause, {}),
    "restart": (protocol.Restart, {}),
    "step": (protocol.StepFrame, {"frames": (Count, 1)}),
    "seek": (protocol.Seek, {"frame": (Index, ...)}),
    "speed": (protocol.SetSpeed, {"factor": (Speed, ...)}),
}
LABELS: Actions = {
    "set": (protocol.EditLabels, {"keyframe": (Index, ...), "labels": (Labels, ...)}),
    "undo": (protocol.UndoLabels, {}),
}
LOOPS: Actions = {
    "accept": (_edit(Accept), PAIR),
    "reject": (_edit(Reject), PAIR),
    "weigh": (_edit(SetWeight), PAIR | {"weight": (Weight, 1.0)}),
    "add": (_edit(Add), PAIR | {"register_": (Registered, True)}),
    "solve": (_edit(Solve), {}),
    "undo": (protocol.UndoLoop, {}),
    "redo": (protocol.RedoLoop, {}),
}


class _Body(BaseModel):
    """The body of a request."""

    model_config = ConfigDict(extra="forbid")


def _bodies(actions: Actions) -> Any:
    """The type of a request body that names one of the actions."""
    models = [
        create_model(f"{name.title()}Action", __base__=_Body, **dict(fields, action=(Literal[name], ...)))
        for name, (_, fields) in actions.items()
    ]
    return Annotated[functools.reduce(operator.or_, models), Field(discriminator="action")]


def _add_actions(router: APIRouter, path: str, engine: RunningEngine, actions: Actions, summary: str) -> None:
    """Add a route that takes the name of an action in the body and sends its command to the engine."""

    def post(body: Any) -> None:
        fields = body.model_dump(by_alias=True)
        command, _ = actions[fields.pop("action")]
        _send(engine, command(**fields))

    post.__annotations__["body"] = _bodies(actions)
    router.add_api_route(path, post, methods=["POST"], status_code=202, name=path.strip("/"), description=summary)


# --- other bodies --------------------------------------------------------------------------------
class NoteBody(_Body):
    text: str = Field(min_length=1, max_length=1000, pattern=r"^[^\x00]*$")


class OpenBody(_Body):
    path: str = Field(description="A recording or session in the folders given by --folder.")
    truth: str | None = Field(
        None, description="A TUM file in the same folders; null: the truth file beside the recording, if any."
    )


class CompareBody(_Body):
    path: str | None = Field(None, description="A TUM file in the folders given by --folder; null ends the comparison.")


EXPORTED: Final = (*(export.name for export in EXPORTS), f"session{SUFFIX}")
_ANY_OF_THESE: Final = "|".join(f"^{re.escape(name)}$" for name in EXPORTED)
ExportName = Annotated[str, PathParam(pattern=_ANY_OF_THESE, json_schema_extra={"enum": [*EXPORTED]})]


def make_router(engine: RunningEngine, folders: Folders) -> APIRouter:
    """All routes below /api. HemislamError raised here becomes status 422."""
    router = APIRouter(prefix="/api")
    exporting = threading.BoundedSemaphore(MOST_EXPORTS)

    @router.get("/state")
    def state() -> StateView:
        """Get the state of the session."""
        return state_view(engine.snapshot)

    @router.get("/params")
    def params() -> Params:
        """Get all parameters. Their ranges, units and meanings are in the schema."""
        return engine.snapshot.params

    @router.get("/params.yaml", response_class=PlainTextResponse)
    def params_yaml() -> str:
        """Get all parameters as commented YAML, which --config accepts."""
        return engine.snapshot.params.to_yaml()

    @router.patch("/params")
    def change(tree: dict[str, dict[str, Any]]) -> Params:
        """Change parameters, for example {"ground": {"alpha": 30}}. If one value is invalid, none is changed."""
        after = engine.snapshot.params.merged(tree)
        values = {f"{section}.{name}": value for section, part in tree.items() for name, value in part.items()}
        _send(engine, protocol.SetParams(values))
        return after

    _add_actions(
        router,
        "/transport",
        engine,
        TRANSPORT,
        'Play, pause, step, seek, set the speed ("max": no limit), or restart.',
    )

    @router.get("/breakpoints")
    def breakpoints() -> Breakpoints:
        """Get the conditions at which playback pauses."""
        return engine.snapshot.breakpoints

    @router.put("/breakpoints")
    def set_breakpoints(body: Breakpoints) -> Breakpoints:
        """Replace the breakpoints. The notices in the state say why playback paused."""
        _send(engine, protocol.SetBreakpoints(body))
        return body

    @router.get("/loops")
    def loops() -> LoopsState:
        """List the loop candidates with their verdicts, and the user's edits."""
        return loops_state(engine.snapshot.loops)

    _add_actions(
        router,
        "/loops",
        engine,
        LOOPS,
        "Accept, reject or add a loop, or change its weight; solve all factors at once (Levenberg-Marquardt);"
        " undo or redo an edit.",
    )

    _add_actions(
        router, "/labels", engine, LABELS, "Change the labels of a keyframe's points, or undo the last change."
    )

    @router.post("/notes", status_code=202)
    def add_note(body: NoteBody) -> None:
        """Add a note on the current frame to the session. The state lists all notes."""
        _send(engine, AddNote(body.text))

    @router.put("/notes/{place}", status_code=202)
    def edit_note(place: Index, body: NoteBody) -> None:
        """Replace the text of a note. `place` is its index in the list of notes in the state."""
        _send(engine, EditNote(_note(engine, place), body.text))

    @router.delete("/notes/{place}", status_code=202)
    def delete_note(place: Index) -> None:
        """Delete a note. `place` is its index in the list of notes in the state."""
        _send(engine, EditNote(_note(engine, place), ""))

    @router.get("/recordings")
    def recordings() -> list[str]:
        """List the recordings and sessions that can be opened."""
        return [str(path) for path in folders.recordings()]

    @router.post("/recordings", status_code=202)
    def open_recording(body: OpenBody) -> None:
        """Open a recording or session. If this fails, a notice in the state says why."""
        path = folders.openable(body.path)
        _send(engine, protocol.OpenRecording(path, folders.inside(body.truth) if body.truth else truth_beside(path)))

    @router.put("/recordings/{name}", status_code=204)
    def upload(
        name: str,
        offset: Annotated[int, Query(ge=0)],
        size: Annotated[int, Query(ge=1)],
        piece: Annotated[bytes, Body(media_type="application/octet-stream")],
        copy: Annotated[str, Query(pattern="^[0-9a-z]{0,16}$")] = "",
    ) -> None:
        """Upload a recording into the first folder, piece by piece.

        `offset`: the position of this piece in the file, in bytes. `size`: the size of the whole file, in bytes.
        `copy`: an identifier of this upload, the same for all its pieces.
        """
        receive(folders, name, offset, size, piece, copy)

    @router.delete("/recordings/{name}", status_code=204)
    def discard_upload(name: str) -> None:
        """Remove the pieces of an incomplete upload."""
        discard(folders, name)

    @router.post("/truth", status_code=202)
    def compare_with(body: CompareBody) -> None:
        """Compare the whole trajectory with another one, or end the comparison."""
        _send(engine, protocol.CompareWith(folders.inside(body.path) if body.path else None))

    @router.get("/export/{name}", response_class=FileResponse)
    def export(name: ExportName, background: BackgroundTasks) -> FileResponse:
        """Get the results of the frames processed so far, as `hemislam run` or `hemislam export` writes them."""
        if not exporting.acquire(blocking=False):
            raise HTTPException(503, "Too many exports are running; ask again in a moment.")
        try:
            return _exported(engine, name, background)
        finally:
            exporting.release()

    return router


def _send(engine: RunningEngine, command: Command) -> None:
    if not engine.snapshot.engine_alive and not isinstance(command, protocol.Restart | protocol.OpenRecording):
        raise HTTPException(503, "The engine's process has ended; send the action `restart` to start it again.")
    engine.send(command)


def _note(engine: RunningEngine, place: int) -> Note:
    notes = engine.snapshot.notes
    if place >= len(notes):
        raise HTTPException(404, f"There are {len(notes)} notes.")
    return notes[place]


def _exported(engine: RunningEngine, name: str, background: BackgroundTasks) -> FileResponse:
    if engine.snapshot.earth.survey is None and any(export.on_earth for export in EXPORTS if export.name == name):
        raise HTTPException(409, f"{name} needs a georeferenced map; georeference it in the page first.")
    folder = Path(tempfile.mkdtemp(prefix="hemislam-export-"))
    background.add_task(shutil.rmtree, folder, ignore_errors=True)
    try:
        _save(engine, folder, tuple(export.format for export in EXPORTS if export.name == name and export.format))
        if not (folder / name).exists():
            raise HTTPException(404, f"There is no {name}, because the loop search is off; set loops.enabled.")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return FileResponse(folder / name, filename=name, background=background)


def _save(engine: RunningEngine, folder: Path, formats: tuple[str, ...]) -> None:
    """Tell the engine to save into a folder, and wait until it has finished."""
    snapshot = engine.snapshot
    if snapshot.transport.frame < 0:
        raise HTTPException(409, "No frame has been processed yet; open a recording and play it first.")
    _send(engine, protocol.Save(folder, formats, fetched=True))
    deadline = time.monotonic() + EXPORT_TIMEOUT_S
    while time.monotonic() < deadline:
        for saved in snapshot.saved:
            if saved.folder == folder:
                if saved.error:
                    raise HTTPException(409 if saved.mendable else 500, saved.error)
                return
        if not snapshot.engine_alive:
            raise HTTPException(503, "The engine's process ended while it was saving.")
        snapshot = engine.wait(snapshot.revision, timeout=1.0)
    raise HTTPException(504, f"Saving took longer than {EXPORT_TIMEOUT_S:.0f} s.")
