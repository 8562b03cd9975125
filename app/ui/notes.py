"""Notes on frames: kept in the session, marked in the timeline."""

import viser

from app.mapping.session_file import Note
from app.server.protocol import AddNote, Snapshot
from app.ui.html import panel
from app.ui.widgets import Page, by_user

_SHOWN = 30


class NotesPanel:
    """A field for a note on the present frame, and the notes made so far."""

    def __init__(self, page: Page) -> None:
        self._send = page.send
        self._drawn: tuple[Note, ...] = ()
        self._text = page.gui.add_text("note", "", hint="On the frame that is shown; kept in the session.")
        self._add = page.gui.add_button("Add note", icon=viser.Icon.NOTE, color="gray")
        self._list = page.gui.add_html("", visible=False)
        self._add.on_click(by_user(lambda _value, _client: self._note()))

    def draw(self, snapshot: Snapshot) -> None:
        """Show the session's notes, the newest first."""
        if snapshot.notes == self._drawn:
            return
        self._drawn = snapshot.notes
        self._list.content = panel("notes", snapshot.notes[-_SHOWN:][::-1])
        self._list.visible = bool(snapshot.notes)

    def _note(self) -> None:
        if self._text.value.strip():
            self._send(AddNote(self._text.value))
            self._text.value = ""  # type: ignore[misc]  # mypy overlooks viser's setter
