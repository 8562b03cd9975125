"""Labels of points as a layer over keyframes, which are immutable.

The base layer holds the engine's labels. Over it lie the moving points (`app.mapping.moving`), and over these the
user's edits as a list: the newest edit of a keyframe counts, and undo shortens the list.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.mapping.moving import MovingPoints
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.ply import Keyframes
from app.slam.types import MOVING, U8, Keyframe


@dataclass(frozen=True, slots=True)
class LabelEdit:
    """New labels for all points of a keyframe, a byte each, in the order of its cloud."""

    keyframe: KeyframeId
    labels: bytes

    @classmethod
    def of(cls, keyframe: Keyframe, labels: U8 | Sequence[int] | int) -> "LabelEdit":
        """Give a keyframe these labels, or one label to all its points. Raises HemislamError: the number is wrong."""
        given, count = np.asarray(labels, np.uint8), len(keyframe.cloud)
        if given.shape not in ((), (count,)):
            raise HemislamError(f"Keyframe {keyframe.index} has {count:,} points; {given.size:,} labels do not fit.")
        return cls(KeyframeId(0, keyframe.index), np.broadcast_to(given, count).tobytes())


class LabelledKeyframes:
    """Keyframes with the labels of all layers.

    Args:
        count: of keyframes, if later ones are to be ignored. moving: finds the points that move.

    Attributes:
        edits: the edits in force, oldest first.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        moving: MovingPoints,
        edits: tuple[LabelEdit, ...] = (),
        count: int | None = None,
    ) -> None:
        self._keyframes, self._moving, self.edits, self._count = keyframes, moving, edits, count
        self._params = moving.params

    def __len__(self) -> int:
        return len(self._keyframes) if self._count is None else self._count

    def __getitem__(self, index: int, /) -> Keyframe:
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        keyframe = self._keyframes[index]
        labels = next((edit.labels for edit in reversed(self.edits) if edit.keyframe == index), b"")
        if len(labels) == len(keyframe.cloud):  # else there are none, or an older engine version kept other points
            return replace(keyframe, cloud=replace(keyframe.cloud, labels=np.frombuffer(labels, np.uint8)))
        if self._count is None:
            moves = self._moving.known(keyframe.index)
        else:
            moves = self._moving.find(keyframe, self._count, self._params)
        if moves is None or not moves.any():
            return keyframe
        return replace(keyframe, cloud=replace(keyframe.cloud, labels=np.where(moves, MOVING, keyframe.cloud.labels)))

    def now(self) -> "LabelledKeyframes":
        """The present keyframes with their present labels, frozen.

        The moving points of a keyframe are found when it is read, if they are not known by then.
        """
        return LabelledKeyframes(self._keyframes, self._moving, self.edits, len(self))

    def find_moving(self, *, last: bool) -> tuple[int, bool] | None:
        """As `MovingPoints.next`, for the present keyframes."""
        return self._moving.next(len(self), last=last)

    def forget_after(self, count: int) -> None:
        """All keyframes after the first `count` will be different ones."""
        self.edits = tuple(edit for edit in self.edits if edit.keyframe < count)
        self._moving.forget_after(count)

    def edit(self, keyframe: int, labels: U8 | Sequence[int] | int) -> None:
        """Change a keyframe's labels. Raises HemislamError: as `LabelEdit.of`, or there is no such keyframe."""
        if not 0 <= keyframe < len(self):
            raise HemislamError(f"There is no keyframe {keyframe} to label; there are {len(self)} so far.")
        self.edits = (*self.edits, LabelEdit.of(self._keyframes[keyframe], labels))

    def undo(self) -> KeyframeId:
        """Undo the newest edit. Returns its keyframe. Raises HemislamError: there is none."""
        if not self.edits:
            raise HemislamError("There is no edit of labels to undo.")
        *rest, last = self.edits
        self.edits = tuple(rest)
        return last.keyframe
