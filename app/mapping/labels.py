"""Labels of points as a layer over keyframes, which are immutable.

The base of the layer is what the engine found. Edits lie over it as a list, and the newest edit of a keyframe counts.
So labels can be changed after the fact, by the user or by a later step, and undo is a shorter list.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from app.slam.errors import HemislamError
from app.slam.ply import Keyframes
from app.slam.types import U8, Keyframe


@dataclass(frozen=True, slots=True)
class LabelEdit:
    """New labels (n,) uint8 for all points of a keyframe, in the order of its cloud."""

    keyframe: int
    labels: U8

    @classmethod
    def of(cls, keyframe: Keyframe, labels: U8) -> "LabelEdit":
        """Give a keyframe these labels. Raises HemislamError: there is not one for each point."""
        if labels.shape != (len(keyframe.cloud),):
            raise HemislamError(
                f"Keyframe {keyframe.index} has {len(keyframe.cloud):,} points; {labels.size:,} labels do not fit."
            )
        labels = labels.copy()
        labels.setflags(write=False)
        return cls(keyframe.index, labels)


class LabelledKeyframes:
    """The present keyframes, labelled by these edits. Later keyframes do not change it."""

    def __init__(self, keyframes: Keyframes, edits: Sequence[LabelEdit]) -> None:
        self._keyframes, self._count = keyframes, len(keyframes)
        self._labels = {edit.keyframe: edit.labels for edit in edits}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> Keyframe:
        if not 0 <= index < self._count:
            raise IndexError(f"keyframe {index} of {self._count}")
        keyframe = self._keyframes[index]
        labels = self._labels.get(index)
        return keyframe if labels is None else replace(keyframe, cloud=replace(keyframe.cloud, labels=labels))
