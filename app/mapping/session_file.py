"""Session files: what was opened, and everything that determines the present state.

Lines of JSON are only appended, so a truncated file still holds the session up to its last complete line. The engine is
deterministic: the recording, the parameters by frame, the loop edits and the newest frame are all that is needed.

    {"hemislam": "0.3.0", "format": 2, "recording": "/data/walk.mcap", ...}    what was opened
    {"frame": 120, "state": {...}}                                             all of the state, where it changed
    {"frame": 131}                                                             where the session is
    {"frame": 90, "known": 131}                                                after going back, and how far it had come
    {"frame": 512, "ended": true}                                              that the recording has ended
"""

import contextlib
import json
import logging
import math
import zlib
from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import IO, Annotated, Any

from pydantic import (
    BeforeValidator,
    Field,
    FiniteFloat,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
)

from app import __version__
from app.georeference.survey import Survey
from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import Clip, Kept, KeptView, Measure
from app.mapping.labels import LabelEdit
from app.mapping.painted import marks, read_json
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops import edit_files
from app.slam.loops.edits import LoopEdit
from app.slam.params import Params
from app.slam.text_files import free_path, make_folder, named, shortened, write_texts
from app.slam.user_text import read_text

log = logging.getLogger(__name__)

SUFFIX = ".hemislam"
FORKS, FORK_START = "forks", f"start{SUFFIX}"
"""Subfolder of the folder of session files that holds the folders of forks, and the file that each fork began with."""
FORMAT = 2
MOST_POINTS = 1 << 24
"""Most points of a keyframe: far more than any scan has."""


@dataclass(frozen=True, slots=True)
class Opened:
    """The recording that a session was opened on.

    Attributes:
        recording: file or folder. start_s, duration_s: the part that was opened. nbytes: its size, to recognise it.
    """

    recording: Path
    start_s: FiniteFloat = 0.0
    duration_s: FiniteFloat | None = None
    nbytes: int = 0


_Params = Annotated[Params, PlainValidator(Params().with_values), PlainSerializer(Params().changed)]
_Edits = Annotated[
    tuple[LoopEdit, ...],
    PlainValidator(edit_files.edits_of),
    PlainSerializer(edit_files.entries_of),
]


def _unpacked(labels: str) -> bytes:
    """The labels of a keyframe; their number is limited, so that a damaged file cannot fill the memory."""
    packed = zlib.decompressobj()
    unpacked = packed.decompress(b64decode(labels), MOST_POINTS)
    if packed.unconsumed_tail:
        raise ValueError(f"more than {MOST_POINTS:,} labels of one keyframe")
    return unpacked


_LabelEdit = Annotated[
    LabelEdit,
    PlainValidator(lambda entry: LabelEdit(KeyframeId(*entry[:2]), _unpacked(entry[2]))),
    PlainSerializer(
        lambda edit: (edit.keyframe.session, edit.keyframe.index, b64encode(zlib.compress(edit.labels)).decode())
    ),
]
_Path = Annotated[Path, PlainSerializer(lambda path: str(path.resolve()))]
Speed = Annotated[
    float,
    Field(ge=0.1),
    BeforeValidator(lambda speed: math.inf if speed == "max" else speed),
    PlainSerializer(lambda speed: "max" if math.isinf(speed) else speed, when_used="json"),
    WithJsonSchema({"anyOf": [{"type": "number", "minimum": 0.1}, {"const": "max"}]}),
]
"""Playing speed in multiples of real time; inf is `max` in JSON."""


@dataclass(frozen=True, slots=True)
class State(Kept):
    """Attributes:
    params: as chosen now. history: parameters by the frame from which they apply, ascending.
    edits: of loops, in force. undone: those that can be redone, the next one last. labels: edits of labels.
    truth: trajectory to compare with. speed: to play at. survey: what the map is georeferenced by.
    calibration: what the recording shows about its sensors, in a sentence; "" if nothing.
    """

    params: _Params
    history: tuple[tuple[int, _Params], ...] = ()
    edits: _Edits = ()
    undone: _Edits = ()
    truth: _Path | None = None
    breakpoints: Breakpoints = field(default_factory=Breakpoints)
    speed: Speed = 1.0
    labels: tuple[_LabelEdit, ...] = ()
    survey: Survey | None = None
    calibration: str = ""


_OPENED, _STATE = TypeAdapter(Opened), TypeAdapter(State)
_SHOWN: Mapping[str, tuple[str, TypeAdapter[Any]]] = {
    "clip": ("clip box and slab", TypeAdapter(Clip)),
    "views": ("kept views", TypeAdapter(tuple[KeptView, ...])),
    "measures": ("measures", TypeAdapter(tuple[Measure, ...])),
}
"""Parts of a state that do not affect results, and their names."""


@dataclass(frozen=True, slots=True)
class SavedSession:
    """What a session file holds. frame: the newest, -1 before the first. ended: whether the recording had ended, so
    that loops were searched at the last keyframes too. known: the last valid frame: `frame`, or a later one before
    going back. left_out: which parts of the file could not be read, in a sentence; "" if none.
    """

    opened: Opened
    state: State
    frame: int
    ended: bool = False
    known: int = -1
    left_out: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "known", max(self.frame, self.known))

    @property
    def first_params(self) -> Params:
        """The parameters with which the first frame was processed."""
        return self.state.history[0][1] if self.state.history else self.state.params

    def forked(self, frame: int, params: Params) -> "SavedSession":
        """A session that is the same up to this frame and continues with these parameters."""
        history = tuple(entry for entry in self.state.history if entry[0] <= frame)
        notes = tuple(note for note in self.state.notes if note.frame <= frame)
        state = replace(self.state, params=params, history=history, notes=notes)
        ended = self.ended and frame == self.frame
        return SavedSession(self.opened, state, frame, ended, left_out=self.left_out)


class SessionWriter:
    """Writes a session file while the session runs. If the disk fails, the file ends, but the session goes on.

    Args:
        path, opened: None: nothing is written.

    Attributes:
        path: of the file; None once it cannot be written, since the session can then not be repeated from it.
        error: why it cannot be written any more, in a sentence; "" if it can.
    """

    def __init__(self, path: Path | None = None, opened: Opened | None = None) -> None:
        self.path = path
        self.error = ""
        self._state: State | None = None
        self._at: tuple[int, bool, int] | None = None
        self._file: IO[str] | None = None
        if path is None or opened is None:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("x", encoding="utf-8", errors="backslashreplace")  # a path need not be UTF-8
        except OSError as error:
            self._failed(error)
        self._line(_head(opened))

    def write(self, frame: int, state: State, *, ended: bool = False, known: int = -1) -> None:
        """Write the session's frame and state, if they have changed. Arguments as in `SavedSession`."""
        at = frame, ended, max(frame, known)
        if state != self._state:
            self._line(_entry(*at, state))
        elif at != self._at:
            self._line(_entry(*at))
        self._state, self._at = state, at

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _line(self, entry: Mapping[str, Any]) -> None:
        if self._file is None:
            return
        try:
            self._file.write(json.dumps(entry, ensure_ascii=False) + "\n")
            self._file.flush()  # so that nothing is lost if the process is killed
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        self.error = (
            f"The session file {self.path} cannot be written ({error.strerror}); changes from now on are not saved."
        )
        log.warning(self.error)
        self.path = None
        with contextlib.suppress(OSError):  # the rest of the line is lost
            self.close()
        self._file = None


def new_path(folder: Path, recording: Path) -> Path:
    """A free name for the session file of a recording; names sort by time."""
    return free_path(folder / f"{shortened(named(recording).stem)}-{datetime.now():%Y%m%d-%H%M%S}", SUFFIX)


def write_session(path: Path, session: SavedSession) -> None:
    """Write a session file as a whole; its folder need not exist yet. Raises HemislamError: that is not possible."""
    entries = (_head(session.opened), _entry(session.frame, session.ended, session.known, session.state))
    make_folder(path.parent)
    write_texts(path.parent, {path.name: "".join(json.dumps(entry, ensure_ascii=False) + "\n" for entry in entries)})


def read_session(path: Path) -> SavedSession:
    """What a session file holds, up to its last whole line.

    Raises:
        HemislamError: it cannot be read, is not a session, is of another version, or its recording is gone or changed.
    """
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except OSError as error:
        raise HemislamError(f"The session {path} cannot be read: {error.strerror}; check the path.") from None
    entries = []
    for line in lines:
        try:
            entries.append(json.loads(line))
        except (ValueError, RecursionError):
            break  # cut by a crash; later lines cannot be trusted
    if not entries or not isinstance(entries[0], dict) or "hemislam" not in entries[0]:
        raise HemislamError(f"{path} is not a session of hemislam; open one that the workbench has written.")
    head = entries[0]
    if head.get("format") != FORMAT:
        raise HemislamError(
            f"The session {path} was written by hemislam {head['hemislam']}; open it with that version."
        )
    try:
        opened = _OPENED.validate_python(head)
        states = [entry for entry in entries if "state" in entry]
        state, left_out = _state_of(states[-1]["state"]) if states else (State(Params()), "")
        place: dict[str, Any] = next((entry for entry in reversed(entries) if "frame" in entry), {})
        frame, ended, known = int(place.get("frame", -1)), bool(place.get("ended")), int(place.get("known", -1))
    except (HemislamError, AttributeError, KeyError, TypeError, ValueError, OverflowError, zlib.error) as error:
        raise HemislamError(
            f"The session {path} is damaged ({_why(error)}); use an older copy, if you have one."
        ) from None
    if not states:
        raise HemislamError(f"The session {path} ends before its first frame; open its recording {opened.recording}.")
    try:
        same = size_of(opened.recording) == opened.nbytes
    except OSError as error:
        raise HemislamError(f"The session {path} names {opened.recording}: {error.strerror}.") from None
    if not same:
        gone = "is a different file now" if opened.recording.exists() else "is missing"
        raise HemislamError(f"The recording {opened.recording} of the session {path} {gone}; put it back there.")
    return SavedSession(opened, state, frame, ended, known, left_out)


def _state_of(entry: Mapping[str, Any]) -> tuple[State, str]:
    """The state in a line, and `left_out` as in `SavedSession`: unreadable parts that are only shown."""
    entry, left_out = dict(entry), []
    for name, (what, adapter) in _SHOWN.items():
        try:
            if name in entry:
                adapter.validate_python(entry[name])
        except (HemislamError, ValidationError) as error:
            del entry[name]
            left_out.append(f"The session's {what} were left out ({_why(error)}).")
    return _STATE.validate_python(entry), " ".join(left_out)


def _why(error: Exception) -> str:
    if isinstance(error, HemislamError):
        return str(error)[:200].rstrip(".")
    if not isinstance(error, ValidationError):
        return repr(error)[:200]
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:200]


def read_marks(path: Path) -> tuple[tuple[int, bytes], ...]:
    """Marks of frames, by their stamps, from a session file or NAME.labels.json.

    Raises:
        HemislamError: it cannot be read, or holds none.
    """
    if path.suffix == SUFFIX:
        strokes = read_session(path).state.painted
    else:
        strokes = read_json(read_text(path, "give NAME.labels.json, as the page saves it"), path.name)
    if not (found := marks(strokes)):
        raise HemislamError(f"{path} holds no labelled points; label some frames under Study first.")
    return tuple((stamp, labels.tobytes()) for stamp, labels in found.items())


def session_files(folder: Path) -> list[Path]:
    """The session files in a folder and of its forks, the newest first."""
    found = []
    of_forks = (path for path in folder.glob(f"{FORKS}/*/*{SUFFIX}") if path.name != FORK_START)
    for path in (*folder.glob(f"*{SUFFIX}"), *of_forks):
        with contextlib.suppress(OSError):  # it was deleted meanwhile
            found.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(found, reverse=True)]


def opened_in(path: Path) -> Opened | None:
    """What a session file was opened on; None if it cannot be read."""
    try:
        with path.open(encoding="utf-8") as lines:
            return _OPENED.validate_json(lines.readline())
    except (OSError, ValueError):  # of pydantic too
        return None


def size_of(recording: Path) -> int:
    """Bytes of a recording, be it a file or a folder."""
    files = recording.rglob("*") if recording.is_dir() else [recording]
    return sum(file.stat().st_size for file in files if file.is_file())


def _head(opened: Opened) -> dict[str, Any]:
    return {"hemislam": __version__, "format": FORMAT, **_OPENED.dump_python(opened, mode="json")}


def _entry(frame: int, ended: bool, known: int, state: State | None = None) -> dict[str, Any]:
    """The line for the session's frame, and for its state if that has changed."""
    entry: dict[str, Any] = {"frame": frame} | ({"known": known} if known > frame else {})
    entry |= {"ended": True} if ended else {}
    return entry if state is None else entry | {"state": _STATE.dump_python(state, mode="json")}
