"""A session file reads back as written, even if truncated; impossible content is refused or left out with a sentence.

Tests app/mapping/session_file.py, app/mapping/kept.py.
"""

import errno
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import Note
from app.mapping.session_file import (
    Opened,
    SavedSession,
    SessionWriter,
    State,
    new_path,
    read_session,
    size_of,
    write_session,
)
from app.slam.errors import HemislamError
from app.slam.loops.edits import Accept, Add, Reject
from app.slam.params import Params


@pytest.fixture
def saved(tmp_path: Path) -> SavedSession:
    recording = tmp_path / "walk.mcap"
    recording.write_bytes(b"12345")
    coarse = Params().with_values({"ground.alpha": 30.0})
    state = State(
        coarse,
        ((0, Params()), (12, coarse)),
        (Accept(1, 20), Add(2, 30, None, False)),
        (Reject(3, 9),),
        tmp_path / "truth.tum",
        notes=(Note(12, 'the "door" opens\nand closes'),),
        breakpoints=Breakpoints(no_ground=True, residual=0.05),
        speed=math.inf,
    )
    return SavedSession(Opened(recording, 2.0, 30.0, 5), state, 41, ended=True)


def test_what_is_written_is_read(saved: SavedSession, tmp_path: Path) -> None:
    write_session(tmp_path / "a.hemislam", saved)
    assert read_session(tmp_path / "a.hemislam") == saved


def test_a_session_file_cut_anywhere_holds_the_session_up_to_there(saved: SavedSession, tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "b.hemislam", saved.opened)
    writer.write(0, State(Params()))
    for frame in range(1, 40):
        writer.write(frame, State(Params()) if frame < 20 else saved.state)
    writer.close()
    whole = (tmp_path / "b.hemislam").read_bytes()
    frames = []
    for length in (*range(whole.index(b"state"), len(whole), 13), len(whole)):
        (tmp_path / "cut.hemislam").write_bytes(whole[:length])
        try:
            session = read_session(tmp_path / "cut.hemislam")
        except HemislamError:
            continue
        assert session.state == (saved.state if session.frame >= 20 else State(Params()))
        frames.append(session.frame)
    assert frames == sorted(frames) and frames[-1] >= 36


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "not a session"),
        (b"PNG\x00\n", "not a session"),
        (b'{"hemislam": "9.0", "format": 99}\n', "written by hemislam 9.0"),
        (b'{"hemislam": "0.1", "format": 2}\n', "damaged"),
        (b"[" * 100_000 + b"\n", "not a session"),
    ],
)
def test_a_file_that_is_no_session_is_refused_in_a_sentence(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "bad.hemislam"
    path.write_bytes(content)
    with pytest.raises(HemislamError, match=says):
        read_session(path)


@pytest.mark.parametrize(
    "clip",
    [
        {"slab": 0.0},
        {"slab": "wide"},
        {"on": True, "box": {"low": [0, 0, 0], "high": [0, 1, 1]}},
        {"box": {"low": [0, 0, 0], "high": [1, 1, 1], "turn": 999}},
        7,
    ],
)
def test_a_clip_that_cannot_be_is_left_out_with_a_sentence(saved: SavedSession, tmp_path: Path, clip: Any) -> None:
    path = tmp_path / "a.hemislam"
    write_session(path, saved)
    head, entry = map(json.loads, path.read_text().splitlines())
    entry["state"]["clip"] = clip
    path.write_text(f"{json.dumps(head)}\n{json.dumps(entry)}\n")
    read = read_session(path)
    assert "clip box and slab were left out (" in read.left_out
    assert replace(read, left_out="") == saved


@pytest.mark.parametrize(
    ("name", "says", "wrong"),
    [
        ("views", "kept views were left out (", [[[0, 0, math.nan], [1, 1, 1]]]),
        (
            "measures",
            "measures were left out (",
            [{"name": "door", "spots": [{"keyframe": 0, "at": [0, math.inf, 0]}]}],
        ),
    ],
)
def test_places_that_are_nowhere_are_left_out_with_a_sentence(
    saved: SavedSession, tmp_path: Path, name: str, says: str, wrong: Any
) -> None:
    path = tmp_path / "a.hemislam"
    write_session(path, saved)
    head, entry = map(json.loads, path.read_text().splitlines())
    entry["state"][name] = wrong
    path.write_text(f"{json.dumps(head)}\n{json.dumps(entry)}\n")
    read = read_session(path)
    assert says in read.left_out and getattr(read.state, name) == ()
    assert read.state.notes == saved.state.notes and read.state.clip == saved.state.clip


NOTES = [{"notes": [["x", "late"]]}, {"notes": [[1, None]]}]
SURVEYS: list[dict[str, Any]] = [
    {"survey": {"lever": [0, math.nan, 0]}},
    {"survey": {"offset_s": math.inf}},
    {"survey": {"picks": [{"name": "A", "keyframe": 0, "at": [0, 0, math.nan]}]}},
]


@pytest.mark.parametrize("wrong", [{"start_s": math.nan}, {"duration_s": math.inf}, *NOTES, *SURVEYS])
def test_numbers_and_words_that_cannot_be_are_damage(
    saved: SavedSession, tmp_path: Path, wrong: dict[str, Any]
) -> None:
    path = tmp_path / "a.hemislam"
    write_session(path, saved)
    head, entry = map(json.loads, path.read_text().splitlines())
    entry["state"] |= wrong
    path.write_text(f"{json.dumps(head | wrong)}\n{json.dumps(entry)}\n")
    with pytest.raises(HemislamError, match="is damaged"):
        read_session(path)


def test_a_recording_that_is_gone_or_another_is_said(saved: SavedSession, tmp_path: Path) -> None:
    write_session(tmp_path / "a.hemislam", saved)
    saved.opened.recording.write_bytes(b"123456")
    with pytest.raises(HemislamError, match="a different file now"):
        read_session(tmp_path / "a.hemislam")
    saved.opened.recording.unlink()
    with pytest.raises(HemislamError, match="is missing"):
        read_session(tmp_path / "a.hemislam")


def test_a_folder_that_cannot_be_written_ends_the_file_not_the_session(saved: SavedSession, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    writer = SessionWriter(tmp_path / "file" / "a.hemislam", saved.opened)
    assert "are not saved" in writer.error
    writer.write(0, saved.state)
    writer.close()


def test_a_disk_that_fills_up_leaves_the_session_that_was_saved_before(
    saved: SavedSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.hemislam"
    write_session(path, saved)

    def full(path: Path, text: str, **how: str) -> None:
        path.write_bytes(text.encode()[:40])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(HemislamError, match="No space left on device"):
        write_session(path, replace(saved, frame=42))
    assert read_session(path) == saved and [file.name for file in tmp_path.glob("*a.hem*")] == ["a.hemislam"]


def test_two_sessions_at_one_time_have_two_names(tmp_path: Path) -> None:
    first = new_path(tmp_path, Path("walk.mcap"))
    first.write_text("")
    assert new_path(tmp_path, Path("walk.mcap")) != first


def test_size_is_that_of_all_files(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"123")
    (tmp_path / "b").write_bytes(b"4567")
    assert size_of(tmp_path) == 7 and size_of(tmp_path / "a") == 3 and size_of(tmp_path / "none") == 0
