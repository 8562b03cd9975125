"""Notes: a new note becomes a command, the session's notes are listed and pinned, and their text is never HTML."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser

from app.mapping.kept import Note
from app.server.keeping import AddNote, EditNote
from app.server.protocol import Command, OpenedRecording, Seek, Snapshot
from app.slam.errors import HemislamError
from app.ui.notes import _SHOWN_NOTES, NotesPanel
from app.ui.widgets import View
from tests.ui.conftest import Browser, BusyThreads, Wire, browser_sends, page_of, user_clicks, user_sets

LIFT = Note(12_345, "the lift")


class Notes:
    """A panel and what it sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.panel = NotesPanel(page_of(server, self.sent.append, lambda: self.snapshot))
        self.snapshot = Snapshot(recording=OpenedRecording(Path("walk.mcap"), 0, 60.0, 600, ()))

    def write(self, text: str) -> None:
        user_sets(self.panel._text, text)
        user_clicks(self.panel._add)

    def show(self, *notes: Note) -> str:
        self.snapshot = replace(self.snapshot, notes=notes)
        self.panel.draw(self.snapshot, View())
        return str(self.panel._list.content)


@pytest.fixture
def notes(server: viser.ViserServer) -> Notes:
    return Notes(server)


def test_a_remark_is_sent_once_and_the_field_is_free_for_the_next(notes: Notes) -> None:
    notes.write("the door opens")
    assert notes.sent == [AddNote("the door opens")] and notes.panel._text.value == ""
    user_clicks(notes.panel._add)
    assert len(notes.sent) == 1, "pressed again without a word"


@pytest.mark.parametrize("text", ["", "   ", "\t"])
def test_an_empty_note_is_not_sent(notes: Notes, text: str) -> None:
    notes.write(text)
    assert notes.sent == []


def test_what_was_typed_last_is_noted_however_late_the_threads_are(
    server: viser.ViserServer, notes: Notes, busy: BusyThreads
) -> None:
    for typed in ("the d", "the door"):
        browser_sends(server, notes.panel._text, typed)
    browser_sends(server, notes.panel._add, True)
    busy.catch_up()
    assert notes.sent == [AddNote("the door")]


def test_the_newest_is_on_top_with_its_frame_and_without_notes_there_is_no_list(notes: Notes) -> None:
    assert not notes.panel._list.content
    shown = notes.show(Note(70, "a turn"), Note(12_345, "the lift"))
    assert notes.panel._list.content
    assert shown.index("12,345") < shown.index("the lift") < shown.index("70") < shown.index("a turn")
    notes.show()
    assert not notes.panel._list.content, "another session is open"


def test_of_many_the_last_are_shown(notes: Notes) -> None:
    shown = notes.show(*(Note(frame, f"remark {frame}.") for frame in range(100)))
    assert (
        shown.count("remark") == _SHOWN_NOTES and "remark 99." in shown and f"remark {99 - _SHOWN_NOTES}." not in shown
    )


@pytest.mark.parametrize(
    ("word", "command"),
    [
        ("go 70", Seek(70)),
        ("delete {lift:x}", EditNote(LIFT, "")),
        ("delete", None),
        ("go x", None),
        ("edit -1", None),
    ],
)
def test_a_note_is_gone_to_and_deleted_by_a_click(notes: Notes, word: str, command: Command | None) -> None:
    turn = Note(70, "a turn")
    word = word.format(lift=hash(LIFT), turn=hash(turn))  # another in each process
    shown = notes.show(turn, LIFT)
    assert command is None or f'data-hs="{word}"' in shown
    user_sets(notes.panel._bridge._field, word + " #1")
    assert notes.sent == ([command] if command else [])


def test_a_remark_is_no_html(notes: Notes) -> None:
    shown = notes.show(Note(1, "<script>alert(1)</script> & so on"))
    assert "<script>" not in shown and "&lt;script&gt;" in shown and "&amp; so on" in shown


def test_nothing_is_sent_to_the_page_while_no_note_is_added(notes: Notes, wire: Wire) -> None:
    notes.show(Note(3, "here"))
    wire.clear()
    notes.panel.draw(replace(notes.snapshot, revision=9), View())
    assert wire.messages == []
    notes.show(Note(3, "here"), Note(4, "and there"))
    assert wire.messages


def test_an_emptied_note_is_not_deleted_without_a_word(
    server: viser.ViserServer, notes: Notes, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes.show(Note(70, "a turn"))
    browser = Browser(server, monkeypatch)
    notes.panel._act(f"edit {hash(Note(70, 'a turn')):x}", browser)  # type: ignore[arg-type]
    user_sets(browser.added["note"], " ")
    browser.clicks("Keep")
    assert notes.sent == [] and "The note is empty" in browser.told[0]
    user_sets(browser.added["note"], "a left turn")
    browser.clicks("Keep")
    assert notes.sent == [EditNote(Note(70, "a turn"), "a left turn")] and len(browser.told) == 1


def test_a_note_without_a_recording_is_refused_and_stays_in_its_field(notes: Notes) -> None:
    notes.snapshot = Snapshot()
    user_sets(notes.panel._text, "the door opens")
    with pytest.raises(HemislamError, match="No recording is open"):
        notes.panel._note()
    assert notes.sent == [] and notes.panel._text.value == "the door opens"


# --- pins ----------------------------------------------------------------------------------------
WALK = np.column_stack((np.arange(100.0), np.zeros(100), np.zeros(100)))
"""m, a frame at every metre along x."""


def click(x: float, y: float = 0.0, ratio: int = 1) -> Any:
    """A click on the map at (x, y, 0), seen from 10 m above it; the picture's top is +y, and 900 pixels show 20 m.

    ratio: of the device's pixels to those of CSS.
    """
    camera = SimpleNamespace(
        position=np.array([50.0, 0.0, 10.0]), wxyz=np.array([0.0, 1.0, 0.0, 0.0]), fov=np.pi / 2, aspect=2.0,
        image_width=1800 * ratio, image_height=900 * ratio,
    )  # fmt: skip
    seen = np.array([(x - 50.0) / 40 + 0.5, 0.5 - y / 20])
    return SimpleNamespace(client=SimpleNamespace(camera=camera), screen_pos=seen)


def labels(server: viser.ViserServer) -> dict[str, np.ndarray]:
    """Where each label stands, by its text, as a browser has them that connects now."""
    kept = list(server._websock_server._broadcast_buffer.message_from_id.values())
    texts = {m.name: m.props.text for m in kept if type(m).__name__ == "LabelMessage"}  # type: ignore[attr-defined]
    places = {m.name: m.position for m in kept if type(m).__name__ == "SetPositionMessage"}  # type: ignore[attr-defined]
    return {text: np.array(places[name]) for name, text in texts.items()}


def test_notes_stand_where_the_sensor_was_and_move_with_the_trajectory(server: viser.ViserServer, notes: Notes) -> None:
    notes.snapshot = replace(notes.snapshot, trajectory=WALK)
    notes.show(Note(40, "a door"), Note(40, "open"), Note(45, "a lift " * 20), Note(300, "not reached"))
    found = labels(server)
    assert found["a door · open"].tolist() == [40.0, 0.0, 0.0] and len(found) == 2
    assert max(map(len, found)) <= 32, "a long note does not cover the map"
    notes.panel.draw(replace(notes.snapshot, trajectory=WALK + np.array([0.0, 2.0, 0.0])), View())  # a loop closed
    assert labels(server)["a door · open"].tolist() == [40.0, 2.0, 0.0]
    notes.panel.draw(notes.snapshot, View(notes=False))
    assert labels(server) == {}


@pytest.mark.parametrize(
    ("at", "frame"),
    [
        ((40.0, 0.0), 40),
        ((40.9, 0.1), 40),  # on the text
        ((39.5, 0.0), None),  # left of it
        ((40.0, 0.6), None),  # above it
        ((45.1, 0.0), 45),
    ],
)
@pytest.mark.parametrize("ratio", [1, 2, 3])
def test_a_click_on_a_pin_goes_to_its_frame_on_any_screen(
    notes: Notes, at: tuple[float, float], frame: int | None, ratio: int
) -> None:
    notes.snapshot = replace(notes.snapshot, trajectory=WALK)
    notes.show(Note(40, "a door"), Note(45, "a lift"))
    assert notes.panel.clicked(click(*at, ratio)) is (frame is not None)
    assert notes.sent == ([Seek(frame)] if frame is not None else [])


def test_a_pin_behind_the_camera_is_not_clicked(notes: Notes) -> None:
    notes.snapshot = replace(notes.snapshot, trajectory=WALK + np.array([0.0, 0.0, 20.0]))
    notes.show(Note(50, "above"))
    assert not notes.panel.clicked(click(50.0))
