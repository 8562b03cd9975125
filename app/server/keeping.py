"""Commands that change the user data of a session, such as notes and measures, and their effects."""

from dataclasses import replace
from typing import Any, Final

from app.mapping.kept import Kept, KeptView, Measure, Note
from app.mapping.painted import Stroke, undone
from app.server.protocol import Command
from app.slam.errors import HemislamError

MOST_NOTES: Final = 1000
"""Limits, because every page and every REST response holds all notes and measures."""
MOST_VIEWS: Final = 6
MOST_MEASURES: Final = 200


class KeptCommand(Command, frozen=True):
    """A change of the session's user data."""


class AddNote(KeptCommand, frozen=True):
    """Add a note on the present frame to the session."""

    text: str


class EditNote(KeptCommand, frozen=True):
    """Replace the text of a note of the session; an empty text deletes it."""

    note: Note
    text: str


class KeepView(KeptCommand, frozen=True):
    """Keep a camera's position and the point that it looks at in the session."""

    view: KeptView


class KeepMeasure(KeptCommand, frozen=True):
    """Keep a measure in the session."""

    measure: Measure


class EditMeasure(KeptCommand, frozen=True):
    """Rename a measure of the session; an empty name deletes it."""

    measure: Measure
    name: str


class SetClip(KeptCommand, frozen=True):
    """Show only a part of the map, or all of it. changes: new values of fields of `Clip`; the others stay."""

    changes: dict[str, Any]


class Paint(KeptCommand, frozen=True):
    """Mark points of a frame as ground or not; new marks override earlier ones."""

    stroke: Stroke


class UndoPaint(KeptCommand, frozen=True):
    """Undo the last `Paint`, with those that it is joined to."""


def changed(kept: Kept, command: KeptCommand, frame: int) -> Kept:
    """The kept values after a command given at a frame.

    Raises:
        HemislamError: there are too many notes or measures, the edited one is not there any more, or as `Clip`.
    """
    notes, measures = kept.notes, kept.measures
    match command:
        case AddNote(text) if text.strip():
            if len(notes) >= MOST_NOTES:
                raise HemislamError(f"A session holds at most {MOST_NOTES:,} notes; this one was not added.")
            return replace(kept, notes=(*notes, Note(max(frame, 0), text.strip())))  # -1 before the first frame
        case EditNote(note, text) if note in notes:
            place = notes.index(note)
            now = (Note(note.frame, text.strip()),) if text.strip() else ()
            return replace(kept, notes=(*notes[:place], *now, *notes[place + 1 :]))
        case EditNote(text=text) if text.strip():
            raise HemislamError(
                f"Another page has changed or deleted that note meanwhile; it was not replaced by “{text.strip()}”."
            )
        case KeepView(view):
            return replace(kept, views=(*kept.views, view)[-MOST_VIEWS:])
        case KeepMeasure(measure):
            if len(measures) >= MOST_MEASURES:
                raise HemislamError(
                    f"A session holds at most {MOST_MEASURES} measures; this one was not added. Delete one first."
                )
            return replace(kept, measures=(*measures, measure))
        case EditMeasure(measure, name):
            if name and measure not in measures:
                raise HemislamError(
                    f"Another page has changed or deleted that measure meanwhile; it was not renamed to “{name}”."
                )
            left = (one for one in measures if name or one != measure)
            return replace(kept, measures=tuple(replace(one, name=name) if one == measure else one for one in left))
        case SetClip(changes):
            return replace(kept, clip=replace(kept.clip, **changes))
        case Paint(stroke):
            return replace(kept, painted=(*kept.painted, stroke))
        case UndoPaint():
            return replace(kept, painted=undone(kept.painted))
    return kept
