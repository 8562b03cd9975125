"""The notes panel: a remark becomes a command, what the session keeps is listed, and none of it is taken for html."""

from dataclasses import replace

import pytest
import viser

from app.mapping.session_file import Note
from app.server.protocol import AddNote, Command, EditNote, Seek, Snapshot
from app.ui.transport import _SHOWN_NOTES, NotesPanel
from tests.ui.conftest import BusyThreads, Wire, browser_sends, page_of, user_clicks, user_sets


class Notes:
    """A panel and what it sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.panel = NotesPanel(page_of(server, self.sent.append, lambda: self.snapshot))
        self.snapshot = Snapshot()

    def write(self, text: str) -> None:
        user_sets(self.panel._text, text)
        user_clicks(self.panel._add)

    def show(self, *notes: Note) -> str:
        self.snapshot = replace(self.snapshot, notes=notes)
        self.panel.draw(self.snapshot)
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
    assert not notes.panel._list.visible
    shown = notes.show(Note(70, "a turn"), Note(12_345, "the lift"))
    assert notes.panel._list.visible
    assert shown.index("12,345") < shown.index("the lift") < shown.index("70") < shown.index("a turn")
    notes.show()
    assert not notes.panel._list.visible, "another session is open"


def test_of_many_the_last_are_shown(notes: Notes) -> None:
    shown = notes.show(*(Note(frame, f"remark {frame}.") for frame in range(100)))
    assert (
        shown.count("remark") == _SHOWN_NOTES and "remark 99." in shown and f"remark {99 - _SHOWN_NOTES}." not in shown
    )


@pytest.mark.parametrize(
    ("word", "command"),
    [
        ("go 70", Seek(70)),
        ("delete 1", EditNote(1, "the lift", "")),
        ("delete 2", None),
        ("go x", None),
        ("edit -1", None),
    ],
)
def test_a_note_is_gone_to_and_deleted_by_a_click(notes: Notes, word: str, command: Command | None) -> None:
    notes.show(Note(70, "a turn"), Note(12_345, "the lift"))
    user_sets(notes.panel._bridge._field, word + " #1")
    assert notes.sent == ([command] if command else [])


def test_a_remark_is_no_html(notes: Notes) -> None:
    shown = notes.show(Note(1, "<script>alert(1)</script> & so on"))
    assert "<script>" not in shown and "&lt;script&gt;" in shown and "&amp; so on" in shown


def test_nothing_is_sent_to_the_page_while_no_note_is_added(notes: Notes, wire: Wire) -> None:
    notes.show(Note(3, "here"))
    wire.clear()
    notes.panel.draw(replace(notes.snapshot, revision=9))
    assert wire.messages == []
    notes.show(Note(3, "here"), Note(4, "and there"))
    assert wire.messages
