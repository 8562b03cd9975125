"""What the user adds to the map and a session keeps: notes, views, measures, marks of the brush, the clip box."""

from dataclasses import dataclass, fields
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator, TypeAdapter

from app.export.box import Box
from app.georeference.survey import Pick
from app.mapping.painted import Stroke, entry_of, stroke_of
from app.slam.arrays import Vector
from app.slam.errors import HemislamError
from app.slam.ply import Keyframes


@dataclass(frozen=True, slots=True)
class Note:
    """A remark of the user, or a record of what was done with forks."""

    frame: int
    text: str


KeptView = tuple[Vector, Vector]
"""Where a camera stands and what it looks at, (x, y, z) each, m, in the map."""


@dataclass(frozen=True, slots=True)
class Spot:
    """A place relative to a keyframe, so that it moves with the map.

    Attributes:
        at: (x, y, z), m, in the keyframe's IMU frame. frame: of the keyframe, since other settings choose other
            keyframes; -1: unknown, as in older files.
    """

    keyframe: int
    at: Vector
    frame: int = -1


def is_there(spot: Spot | Pick, keyframes: Keyframes) -> bool:
    """Whether the keyframe that it was picked on still exists and has not been replaced by another one."""
    return 0 <= spot.keyframe < len(keyframes) and spot.frame in (-1, keyframes[spot.keyframe].frame)


@dataclass(frozen=True, slots=True)
class Measure:
    """A named annotation: of one spot its coordinates, of two their distance, of three the angle at the second."""

    name: str
    spots: tuple[Spot, ...]


@dataclass(frozen=True, slots=True)
class Clip:
    """The part of the map that is shown, and that exports may be limited to.

    Attributes:
        box: None if none was chosen yet. on: whether points outside it are hidden.
        unrolled: the map is shown as a profile along the walked path. slab: m, how wide that is.

    Raises:
        HemislamError: the slab is too thin or too thick.
    """

    box: Box | None = None
    on: bool = False
    unrolled: bool = False
    slab: float = 1.0

    def __post_init__(self) -> None:
        if not 0.01 <= self.slab <= 100:
            raise HemislamError(f"A slab cannot be {self.slab:g} m thick; give 0.01 to 100.")

    @property
    def hiding(self) -> Box | None:
        """The box outside which points are hidden, if there is one."""
        return self.box if self.on else None


WHOLE = Clip()
_NOTE = TypeAdapter(tuple[int, str])
_Note = Annotated[
    Note,
    PlainValidator(lambda entry: Note(*_NOTE.validate_python(entry))),
    PlainSerializer(lambda note: (note.frame, note.text)),
]
_Stroke = Annotated[Stroke, PlainValidator(stroke_of), PlainSerializer(entry_of)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """All of it.

    Attributes:
        notes, views, measures, painted: in the order in which they were made. painted: points marked as ground or not.
        clip: the part of the map that is shown.
    """

    notes: tuple[_Note, ...] = ()
    views: tuple[KeptView, ...] = ()
    measures: tuple[Measure, ...] = ()
    painted: tuple[_Stroke, ...] = ()
    clip: Clip = WHOLE

    def kept(self) -> dict[str, Any]:
        """The attributes of this class by name, of a value that may have more."""
        return {field.name: getattr(self, field.name) for field in fields(Kept)}


NOTHING_KEPT = Kept()
