"""A session as a file: what was opened, and all that makes its present state follow from it.

Lines of JSON, only ever appended, each whole or not there: a file cut anywhere tells the session up to
its last whole line. The engine is deterministic, so a session is no more than the recording, the
parameters by the frame they came into force at, the edits of loops, and the frame it is at.

    {"hemislam": "0.3.0", "format": 1, "recording": "/data/walk.mcap", ...}    what was opened
    {"frame": 120, "did": "SetParams", "values": {"ground.alpha": 30}}         what the user did, for people
    {"frame": 120, "state": {...}}                                             all of it, where it changed
    {"frame": 131}                                                             how far it has come
"""

import json
import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from app import __version__
from app.server.breakpoints import Breakpoints
from app.server.protocol import Command, CompareWith, Note
from app.slam.errors import HemislamError
from app.slam.loops import edit_files
from app.slam.loops.types import LoopEdit
from app.slam.params import Params

log = logging.getLogger(__name__)

SUFFIX = ".hemislam"
FORMAT = 1
EVERY_S = 0.5
"""How often the frame is noted: a process that dies loses no more."""


@dataclass(frozen=True, slots=True)
class Opened:
    """Attributes:
    recording, truth: files. start_s, duration_s: the part of it. nbytes: of the recording, to know it again.
    """

    recording: Path
    truth: Path | None = None
    start_s: float = 0.0
    duration_s: float | None = None
    nbytes: int = 0


@dataclass(frozen=True, slots=True)
class State:
    """Attributes:
    params: as chosen now. history: from which frame on which were in force, ascending.
    edits: of loops, in force. undone: that can be done again, the next one last.
    notes: in the order in which they were made. breakpoints: where playing pauses. speed: to play at.
    """

    params: Params
    history: tuple[tuple[int, Params], ...] = ()
    edits: tuple[LoopEdit, ...] = ()
    undone: tuple[LoopEdit, ...] = ()
    notes: tuple[Note, ...] = ()
    breakpoints: Breakpoints = field(default_factory=Breakpoints)
    speed: float = 1.0


@dataclass(frozen=True, slots=True)
class SavedSession:
    """What a session file holds. frame: that it was at, -1 before the first."""

    opened: Opened
    state: State
    frame: int


class Journal:
    """Writes a session file while the session goes on. A disk that fails ends the journal, not the session.

    Attributes:
        path: of the file. error: why it can not be written any more, in a sentence; "" if it can.
    """

    def __init__(self, path: Path, opened: Opened, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.error = ""
        self._clock = clock
        self._noted = -1e9
        self._state: State | None = None
        self._frame: int | None = None
        self._file = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("x", encoding="utf-8")
        except OSError as error:
            self._failed(error)
        self._line({"hemislam": __version__, "format": FORMAT, **_opened_tree(opened)}, now=True)

    def did(self, frame: int, command: Command) -> None:
        """Note what the user did."""
        values = {name: _plain(value) for name, value in asdict(command).items()}
        self._line({"frame": frame, "did": type(command).__name__, **values}, now=True)

    def note(self, frame: int, state: State, *, settled: bool = False) -> None:
        """Note where the session stands, if that is news; the frame alone, unless it stays there, every `EVERY_S`."""
        now = self._clock()
        if state != self._state:
            self._state, self._frame, self._noted = state, frame, now
            self._line({"frame": frame, "state": _state_tree(state)}, now=True)
        elif frame != self._frame and (settled or now - self._noted >= EVERY_S):
            self._frame, self._noted = frame, now
            self._line({"frame": frame}, now=True)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _line(self, entry: Mapping[str, Any], *, now: bool = False) -> None:
        if self._file is None:
            return
        try:
            self._file.write(json.dumps(entry, ensure_ascii=False) + "\n")
            if now:
                self._file.flush()  # a process that dies loses nothing of it then
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        self.error = f"The session can not be kept in {self.path} ({error.strerror}); what is done now is not recorded."
        log.warning(self.error)
        self._file = None


def new_path(folder: Path, recording: Path) -> Path:
    """A name for the session file of a recording, in the order of time."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    names = (f"{recording.stem}-{stamp}{more}{SUFFIX}" for more in ("", *(f"-{n}" for n in range(2, 1000))))
    return next(path for name in names if not (path := folder / name).exists())


def write_session(path: Path, session: SavedSession) -> None:
    """Write a session file as a whole. Raises OSError."""
    entries = [
        {"hemislam": __version__, "format": FORMAT, **_opened_tree(session.opened)},
        {"frame": session.frame, "state": _state_tree(session.state)},
    ]
    path.write_text("".join(json.dumps(entry, ensure_ascii=False) + "\n" for entry in entries), encoding="utf-8")


def read_session(path: Path) -> SavedSession:
    """What a session file holds, up to its last whole line.

    Raises:
        HemislamError: it can not be read, is no session, is of a later version, or its recording is gone or another.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except OSError as error:
        raise HemislamError(f"The session {path} can not be read: {error.strerror}.") from None
    entries = []
    for line in lines:
        try:
            entries.append(json.loads(line))
        except ValueError:
            break  # torn by a crash; what comes after it can not be trusted
    if not entries or not isinstance(entries[0], dict) or "hemislam" not in entries[0]:
        raise HemislamError(f"{path} is no session of hemislam; it must be one that the workbench has written.")
    head = entries[0]
    if head.get("format") != FORMAT:
        raise HemislamError(
            f"The session {path} was written by hemislam {head['hemislam']}; open it with that version."
        )
    try:
        opened = _opened(head)
        for entry in entries:
            if entry.get("did") == CompareWith.__name__:
                opened = replace(opened, truth=Path(entry["path"]) if entry["path"] else None)
        states = [entry for entry in entries if "state" in entry]
        state = _state(states[-1]["state"]) if states else State(Params())
        frame = int(
            next((entry["frame"] for entry in reversed(entries) if "frame" in entry and "did" not in entry), -1)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise HemislamError(f"The session {path} is damaged ({error!r}); an older copy may be whole.") from None
    if not states:
        raise HemislamError(f"The session {path} ends before its first frame; open its recording {opened.recording}.")
    if size_of(opened.recording) != opened.nbytes:
        gone = "is another file now" if opened.recording.exists() else "is not there any more"
        raise HemislamError(f"The recording {opened.recording} of the session {path} {gone}; put it back there.")
    return SavedSession(opened, state, frame)


def size_of(recording: Path) -> int:
    """Bytes of a recording, be it a file or a folder."""
    files = recording.rglob("*") if recording.is_dir() else [recording]
    return sum(file.stat().st_size for file in files if file.is_file())


def _opened_tree(opened: Opened) -> dict[str, Any]:
    return {name: _plain(value) for name, value in asdict(opened).items()}


def _opened(tree: Mapping[str, Any]) -> Opened:
    truth = tree["truth"]
    part = (float(tree["start_s"]), None if tree["duration_s"] is None else float(tree["duration_s"]))
    return Opened(Path(tree["recording"]), Path(truth) if truth else None, *part, int(tree["nbytes"]))


def _state_tree(state: State) -> dict[str, Any]:
    return {
        "params": Params().changed(state.params),
        "history": [[frame, Params().changed(params)] for frame, params in state.history],
        "edits": yaml.safe_load(edit_files.write(state.edits)),
        "undone": yaml.safe_load(edit_files.write(state.undone)),
        "notes": [[note.frame, note.text] for note in state.notes],
        "breakpoints": asdict(state.breakpoints),
        "speed": "max" if math.isinf(state.speed) else state.speed,
    }


def _state(tree: Mapping[str, Any]) -> State:
    return State(
        params=Params().with_values(tree["params"]),
        history=tuple((int(frame), Params().with_values(values)) for frame, values in tree["history"]),
        edits=edit_files.read(yaml.safe_dump(tree["edits"])),
        undone=edit_files.read(yaml.safe_dump(tree["undone"])),
        notes=tuple(Note(int(frame), str(text)) for frame, text in tree.get("notes", ())),
        breakpoints=Breakpoints(**tree.get("breakpoints", {})),
        speed=math.inf if tree.get("speed") == "max" else float(tree.get("speed", 1.0)),
    )


def _plain(value: Any) -> Any:
    """As JSON can hold it."""
    if isinstance(value, Path):
        return str(value.resolve())
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    return value if isinstance(value, str | int | float | bool | None) else str(value)
