"""The page offers the last session and recent recordings.

Tests app/ui/files.py, app/server/folders.py.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viser

from app.export.box import Box
from app.mapping.kept import Clip, Note
from app.mapping.session_file import Opened, SavedSession, State, write_session
from app.server.folders import Folders
from app.server.protocol import Command, OpenedRecording, OpenRecording, Restart, Save, Saved, Snapshot, Transport
from app.slam.errors import HemislamError
from app.slam.loops.edits import Reject
from app.slam.params import Params
from app.ui.files import FilesPanel, RecentPanel
from tests.ui.conftest import Browser, page_of, user_clicks

STATE = State(Params(), edits=(Reject(3, 9), Reject(4, 9)), notes=(Note(4, "a door"),))


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Sessions, from old to new: of walk, of walk, of hall, one of hall never begun, and one of a hidden recording."""
    (tmp_path / "open").mkdir()
    sessions = (("open/walk", 12), ("open/walk", 41), ("open/hall", 7), ("open/hall", -1), ("hidden", 9))
    for number, (name, frame) in enumerate(sessions):
        recording = tmp_path / f"{name}.mcap"
        recording.write_bytes(b"12345")
        path = tmp_path / f"kept/{number}.hemislam"
        write_session(path, SavedSession(Opened(recording.resolve(), nbytes=5), STATE, frame))
        os.utime(path, (number, number))
    return tmp_path / "kept"


def opened(path: Path, frame: int) -> Snapshot:
    recording = OpenedRecording(path, 0, 10.0, 100, ())
    return Snapshot(session=1, recording=recording, transport=Transport(frame=frame))


def test_the_last_session_of_the_recording_is_offered_as_long_as_that_is_open(
    server: viser.ViserServer, kept: Path
) -> None:
    sent: list[Command] = []
    panel = RecentPanel(page_of(server, sent.append), Folders([kept.parent / "open"]), kept, lambda *_: None)
    start = opened(kept.parent / "open/walk.mcap", 0)
    for frame in (0, 99):
        panel.draw(replace(start, transport=Transport(frame=frame)))
        assert panel._buttons[0].hint == "Open it again: walk.mcap, frame 41, 2 loop edits, 1 note."
    assert [button.visible for button in panel._buttons] == [True, False, False, False], "they would move the tabs"
    user_clicks(panel._buttons[0])
    assert sent == [OpenRecording(kept / "1.hemislam", None)]
    panel.draw(replace(start, session=2, session_file=kept / "1.hemislam"))
    assert "frame 12" in str(panel._buttons[0].hint), "not the one that is open"
    panel.draw(replace(start, session=3, recording=OpenedRecording(kept / "new.mcap", 0, 10.0, 100, ())))
    assert not panel._buttons[0].visible


def test_without_a_recording_those_of_before_are_offered_too(server: viser.ViserServer, kept: Path) -> None:
    sent: list[Command] = []
    panel = RecentPanel(page_of(server, sent.append), Folders([kept.parent / "open"]), kept, lambda *_: None)
    panel.draw(Snapshot())
    labels = [button.label for button in panel._buttons if button.visible]
    assert labels == ["Restore last session", "Open hall.mcap", "Open walk.mcap"]
    user_clicks(panel._buttons[2])
    assert sent == [OpenRecording((kept.parent / "open/walk.mcap").resolve(), None)]


def test_an_engine_that_has_ended_for_good_is_started_again_by_a_button(server: viser.ViserServer, kept: Path) -> None:
    sent: list[Command] = []
    panel = RecentPanel(page_of(server, sent.append), Folders([kept.parent / "open"]), kept, lambda *_: None)
    start = opened(kept.parent / "open/walk.mcap", 0)
    panel.draw(start)
    assert not panel._restart.visible
    panel.draw(replace(start, engine_alive=False))
    assert panel._restart.visible
    user_clicks(panel._restart)
    assert sent == [Restart()]


def test_results_that_are_gone_are_not_offered_as_an_empty_list(server: viser.ViserServer, tmp_path: Path) -> None:
    snapshot = replace(opened(tmp_path / "walk.mcap", 9), saved=(Saved(tmp_path / "gone"), Saved(tmp_path, "full")))
    files = FilesPanel(page_of(server, snapshot=lambda: snapshot), Folders([tmp_path]), tmp_path)
    files.add_buttons()
    files.draw(snapshot)
    assert files._download.visible and f"{tmp_path / 'gone'}" in files._saved.content
    with pytest.raises(HemislamError, match="is gone; save the results again"):
        files._offer(None)  # type: ignore[arg-type]


def test_results_are_not_saved_under_the_name_of_a_recording_that_is_no_longer_open(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now, sent = [opened(tmp_path / "walk.mcap", 9)], list[Command]()
    files = FilesPanel(page_of(server, sent.append, lambda: now[0]), Folders([tmp_path]), tmp_path)
    browser = Browser(server, monkeypatch)
    files.ask_where(browser)  # type: ignore[arg-type]
    now[0] = opened(tmp_path / "hall.mcap", 9)  # another page opens it
    browser.clicks("Save")
    assert not sent and browser.told == ["Another recording is open now; cancel, and save its results instead."]
    now[0] = opened(tmp_path / "walk.mcap", 20)
    browser.clicks("Save")
    assert [type(command) for command in sent] == [Save]


def test_results_are_limited_to_the_clip_box_that_the_page_shows_now(
    server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before, after = (Clip(Box.around(np.zeros(3), np.full(3, size)), on=True, slab=size) for size in (1.0, 2.0))
    now, sent = [replace(opened(tmp_path / "walk.mcap", 9), clip=before)], list[Command]()
    files = FilesPanel(page_of(server, sent.append, lambda: now[0]), Folders([tmp_path]), tmp_path)
    browser = Browser(server, monkeypatch)
    files.ask_where(browser)  # type: ignore[arg-type]
    now[0] = replace(now[0], clip=after)  # another page moves the box
    browser.clicks("Save")
    (save,) = sent
    assert isinstance(save, Save) and (save.choice.box, save.choice.slab) == (after.box, after.slab)
