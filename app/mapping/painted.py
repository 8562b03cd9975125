"""Points marked by a person as ground or not ground with the page's brush: the truth for scoring ground labels.

Marks belong to frames by their stamp, so they survive restarts and hold for any other run of the same recording.
They are a list of strokes; a later stroke covers earlier ones, and undo shortens the list.
"""

import json
import zlib
from base64 import b64decode, b64encode
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from app.slam.errors import HemislamError
from app.slam.types import GROUND, NON_GROUND, U8

UNMARKED: Final = 255
SUFFIX: Final = ".labels.json"
_MARKS: Final = {"ground": GROUND, "not ground": NON_GROUND, "none": UNMARKED}


@dataclass(frozen=True, slots=True)
class Stroke:
    """One mark on points of a frame.

    Attributes:
        stamp_ns: of the frame. count: of points in its cloud. mark: GROUND, NON_GROUND or UNMARKED, which erases.
        touched: a bit for each point of the cloud, in its order, packed by `numpy.packbits`.
        joined: whether it was made by one action with the stroke before it; they are undone together.
    """

    stamp_ns: int
    count: int
    mark: int
    touched: bytes
    joined: bool = False

    @classmethod
    def of(cls, stamp_ns: int, touched: npt.NDArray[np.bool_], mark: int) -> "Stroke":
        return cls(stamp_ns, len(touched), mark, np.packbits(touched).tobytes())

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """(count,) the points that it touched."""
        return np.unpackbits(np.frombuffer(self.touched, np.uint8), count=self.count).astype(np.bool_)


def marks(strokes: Iterable[Stroke]) -> dict[int, U8]:
    """(n,) marks by the stamps of frames, in the order of stamps; frames without any mark are left out.

    If a stroke was made on a cloud of another size, as other range limits give, the marks of this frame start anew.
    """
    found: dict[int, U8] = {}
    for stroke in strokes:
        before = found.get(stroke.stamp_ns)
        if before is None or len(before) != stroke.count:
            before = np.full(stroke.count, UNMARKED, np.uint8)
        found[stroke.stamp_ns] = np.where(stroke.mask, np.uint8(stroke.mark), before)
    return {stamp: found[stamp] for stamp in sorted(found) if (found[stamp] != UNMARKED).any()}


def undone(strokes: tuple[Stroke, ...]) -> tuple[Stroke, ...]:
    """The strokes without those of the last action."""
    return strokes[: max((place for place, stroke in enumerate(strokes) if not stroke.joined), default=0)]


def strokes_of(found: dict[int, U8]) -> tuple[Stroke, ...]:
    """The fewest strokes that leave these marks."""
    return tuple(
        Stroke.of(stamp, labels == mark, mark)
        for stamp, labels in found.items()
        for mark in (GROUND, NON_GROUND)
        if (labels == mark).any()
    )


def entry_of(stroke: Stroke) -> dict[str, Any]:
    """A stroke as JSON holds it."""
    mark = next(name for name, value in _MARKS.items() if value == stroke.mark)
    touched = b64encode(zlib.compress(stroke.touched)).decode()
    entry = {"stamp_ns": stroke.stamp_ns, "points": stroke.count, "mark": mark, "touched": touched}
    return entry | ({"joined": True} if stroke.joined else {})


def stroke_of(entry: dict[str, Any]) -> Stroke:
    """Raises KeyError, TypeError, ValueError, OverflowError or zlib.error: it is not a stroke."""
    count = int(entry["points"])
    packed = zlib.decompressobj().decompress(b64decode(entry["touched"]), max(count, 0) // 8 + 2)
    if len(packed) != -(-count // 8):
        raise ValueError(f"{count} points have another number of bits")
    return Stroke(int(entry["stamp_ns"]), count, _MARKS[entry["mark"]], packed, entry.get("joined") is True)


def to_json(strokes: Iterable[Stroke]) -> str:
    """Marks as the text of a file, `NAME.labels.json`, for `read_json` and for other programs."""
    return (
        json.dumps({"hemislam_labels": 1, "strokes": list(map(entry_of, strokes_of(marks(strokes))))}, indent=1) + "\n"
    )


def read_json(text: str, name: str) -> tuple[Stroke, ...]:
    """The strokes of such a file. Raises HemislamError: it is not one."""
    try:
        tree = json.loads(text)
        if tree["hemislam_labels"] != 1:
            raise ValueError("another version")
        return tuple(map(stroke_of, tree["strokes"]))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError, zlib.error) as error:
        raise HemislamError(f"{name} holds no labels of hemislam ({error}); download them under Study.") from None
