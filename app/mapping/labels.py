"""Labels of points as a layer over keyframes, which are immutable.

The base of the layer is what the engine found. Edits lie over it as a list, and the newest edit of a keyframe counts.
So labels can be changed after the fact, by the user or by a later step, and undo is a shorter list.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.ply import Keyframes
from app.slam.types import U8, Keyframe


@dataclass(frozen=True, slots=True)
class LabelEdit:
    """New labels for all points of a keyframe, a byte each, in the order of its cloud."""

    keyframe: KeyframeId
    labels: bytes

    @classmethod
    def of(cls, keyframe: Keyframe, labels: U8 | Sequence[int] | int) -> "LabelEdit":
        """Give a keyframe these labels, or all its points one. Raises HemislamError: there are more or fewer."""
        given, count = np.asarray(labels, np.uint8), len(keyframe.cloud)
        if given.shape not in ((), (count,)):
            raise HemislamError(f"Keyframe {keyframe.index} has {count:,} points; {given.size:,} labels do not fit.")
        return cls(KeyframeId(0, keyframe.index), np.broadcast_to(given, count).tobytes())


class LabelledKeyframes:
    """Keyframes with edited labels.

    Attributes:
        edits: those in force, oldest first.
    """

    def __init__(self, keyframes: Keyframes, edits: tuple[LabelEdit, ...] = (), count: int | None = None) -> None:
        self._keyframes, self.edits, self._count = keyframes, edits, count

    def __len__(self) -> int:
        return len(self._keyframes) if self._count is None else self._count

    def __getitem__(self, index: int, /) -> Keyframe:
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        keyframe = self._keyframes[index]
        labels = next((edit.labels for edit in reversed(self.edits) if edit.keyframe == index), b"")
        if len(labels) != len(keyframe.cloud):  # there are none, or another version of the engine kept other points
            return keyframe
        return replace(keyframe, cloud=replace(keyframe.cloud, labels=np.frombuffer(labels, np.uint8)))

    def now(self) -> "LabelledKeyframes":
        """The present ones with their present labels, which do not change any more."""
        return LabelledKeyframes(self._keyframes, self.edits, len(self))

    def edit(self, keyframe: int, labels: U8 | Sequence[int] | int) -> None:
        """Change a keyframe's labels. Raises HemislamError: as `LabelEdit.of`, or there is no such keyframe."""
        if not 0 <= keyframe < len(self):
            raise HemislamError(f"There is no keyframe {keyframe} to label; there are {len(self)} so far.")
        self.edits = (*self.edits, LabelEdit.of(self._keyframes[keyframe], labels))

    def undo(self) -> KeyframeId:
        """Take the newest edit back. Returns its keyframe. Raises HemislamError: there is none."""
        if not self.edits:
            raise HemislamError("There is no edit of labels to undo.")
        *rest, last = self.edits
        self.edits = tuple(rest)
        return last.keyframe
