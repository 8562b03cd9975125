"""Notes: a field for a new note, the list of notes, and pins in the scene at the sensor's positions."""

from typing import Final

import numpy as np
import viser

from app.mapping.kept import Note
from app.server.keeping import AddNote, EditNote
from app.server.protocol import Seek, Snapshot
from app.slam.errors import HemislamError
from app.slam.types import F64
from app.ui.html import panel
from app.ui.nodes import add_exact_points, clear, label_text
from app.ui.viser_adapter import Bridge
from app.ui.widgets import ROOT, Changes, Page, View, add_button, ask_text, show

_SHOWN_NOTES: Final = 30
_PINNED: Final = 100
_PIN_COLOUR: Final = (255, 190, 60)
_PIN_M: Final = 0.16
_REACH_PX: Final = 14.0
_LETTER_PX: Final = 6.0
"""A click within this distance of a pin, or on the text to its right, selects the pin. In pixels of CSS, as labels."""
_HIGH_PX: Final = 950.0
"""CSS pixels of a usual page's height. viser tells only the device's pixels, of which a HiDPI screen has more."""


class NotesPanel:
    """A field for a note on the present frame, the notes made so far, and their pins."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._changes = Changes()
        self._nodes: list[viser.SceneNodeHandle] = []
        self._pinned: list[tuple[int, str]] = []  # frame and text
        self._where: F64 = np.empty((0, 3))
        self._bridge = Bridge(page.gui, "notes", self._act)
        self._text = page.gui.add_text("note", "", hint="A note on the frame shown; kept in the session.")
        self._add = add_button(page.gui, "Add note", lambda _: self._note(), viser.Icon.NOTE)
        self._list = page.gui.add_html("")

    def draw(self, snapshot: Snapshot, view: View) -> None:
        self._draw_pins(snapshot, view)
        listed = [(_word(note), note) for note in snapshot.notes[-_SHOWN_NOTES:][::-1]]
        self._list.content = self._bridge.live(panel("notes", listed)) if listed else ""

    def _note(self) -> None:
        if self._text.value.strip():
            if self._page.snapshot().recording is None:
                raise HemislamError("No recording is open to keep the note with; open one first.")
            self._page.send(AddNote(self._text.value))
            show(self._text, "")

    def _act(self, word: str, client: viser.ClientHandle) -> None:
        """Handle what the list sends: "go 812", "edit 91c5", "delete 91c5"; see `_word`."""
        verb, _, what = word.partition(" ")
        if verb == "go" and what.isdecimal():
            self._page.send(Seek(int(what)))
        for note in {note for note in self._page.snapshot().notes if what == _word(note)}:
            if verb == "delete":
                self._page.send(EditNote(note, ""))
            elif verb == "edit":
                self._ask(note, client)

    def _ask(self, note: Note, client: viser.ClientHandle) -> None:
        def keep(text: str) -> None:
            if not text.strip():
                raise HemislamError("The note is empty; write something, or cancel and delete it by ✕ in the list.")
            self._page.send(EditNote(note, text))

        ask_text(client, "Edit note", "note", note.text, "Keep", keep)

    # --- pins ------------------------------------------------------------------------------------
    def _draw_pins(self, snapshot: Snapshot, view: View) -> None:
        """Draw pins for the newest notes whose frames are in the trajectory."""
        pinned = pins(snapshot.notes, len(snapshot.trajectory)) if view.notes else []
        where = snapshot.trajectory[[frame for frame, _ in pinned]].reshape(-1, 3)
        if not self._changes(str(pinned), str(where.round(2).tolist())):
            return
        self._pinned, self._where = pinned, where
        clear(self._nodes)
        scene, root = self._page.scene, f"{ROOT}/notes"
        if pinned:
            self._nodes.append(add_exact_points(scene, f"{root}/knobs", where.astype(np.float32), _PIN_COLOUR, _PIN_M))
        for (frame, text), position in zip(pinned, where, strict=True):
            self._nodes.append(scene.add_label(f"{root}/{frame}", text, position=position, anchor="center-left"))

    def _pin_at(self, event: viser.SceneClickEvent) -> int | None:
        """The frame of the clicked pin."""
        if not self._pinned:
            return None
        pixels = np.array([event.client.camera.aspect, 1.0]) * _HIGH_PX
        x, y = ((event.screen_pos - self._page.in_picture(event.client, self._where)) * pixels).T
        width = _REACH_PX + _LETTER_PX * np.array([len(text) for _, text in self._pinned])
        hit = np.flatnonzero((np.abs(y) <= _REACH_PX) & (x >= -_REACH_PX) & (x <= width))
        return self._pinned[int(hit[np.hypot(x, y)[hit].argmin()])][0] if len(hit) else None

    def clicked(self, event: viser.SceneClickEvent) -> bool:
        """Go to the frame of the pin clicked in the scene. Returns whether a pin was clicked."""
        if (frame := self._pin_at(event)) is not None:
            self._page.send(Seek(frame))
        return frame is not None


def _word(note: Note) -> str:
    """Names a note to the server, also in an outdated list."""
    return f"{hash(note):x}"


def pins(notes: tuple[Note, ...], frames: int) -> list[tuple[int, str]]:
    """Frame and text of each pin; notes on the same frame share a pin. frames: number in the trajectory."""
    texts: dict[int, str] = {}
    for note in notes[-_PINNED:]:
        if 0 <= note.frame < frames:
            texts[note.frame] = f"{texts[note.frame]} · {note.text}" if note.frame in texts else note.text
    return [(frame, label_text(text)) for frame, text in texts.items()]
