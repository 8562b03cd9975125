"""Remarks on frames: kept in the session, marked in the timeline."""

from collections.abc import Callable
from html import escape

import viser

from app.server.protocol import AddNote, Command, Note, Snapshot
from app.ui.html import box
from app.ui.widgets import by_user

_SHOWN = 30


class NotesPanel:
    """A field for a remark on the present frame, and those made so far."""

    def __init__(self, gui: viser.GuiApi, send: Callable[[Command], None]) -> None:
        self._send = send
        self._drawn: tuple[Note, ...] = ()
        self._text = gui.add_text("note", "", hint="On the frame that is shown; kept in the session.")
        self._add = gui.add_button("Note it", icon=viser.Icon.NOTE, color="gray")
        self._list = gui.add_html("", visible=False)
        self._add.on_click(by_user(lambda _value, _client: self._note()))

    def draw(self, snapshot: Snapshot) -> None:
        """Show the session's notes, the newest first."""
        if snapshot.notes == self._drawn:
            return
        self._drawn = snapshot.notes
        rows = (f"<div><b>{note.frame:,}</b> {escape(note.text)}</div>" for note in reversed(snapshot.notes[-_SHOWN:]))
        self._list.content = box(*rows)
        self._list.visible = bool(snapshot.notes)

    def _note(self) -> None:
        if self._text.value.strip():
            self._send(AddNote(self._text.value))
            self._text.value = ""  # type: ignore[misc]
