"""Labels of points as layers over keyframes, which are immutable.

The base of a layer is what the engine found. Edits lie over it, and the newest edit of a keyframe counts. So labels
can be changed after the fact, by the user or by a later step, and undo is a shorter list.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from app.mapping.log import Log
from app.slam.errors import HemislamError
from app.slam.ply import Keyframes
from app.slam.types import U8, Keyframe


@dataclass(frozen=True, slots=True)
class LabelEdit:
    """New labels (n,) uint8 for all points of a keyframe, in the order of its cloud."""

    keyframe: int
    labels: U8


class LabelLayer:
    """The labels of a session's keyframes.

    Attributes:
        edits: in the order in which they were made.
    """

    def __init__(self) -> None:
        self.edits: Log[LabelEdit] = Log()

    def edit(self, keyframe: Keyframe, labels: U8) -> None:
        """Give a keyframe other labels.

        Raises:
            HemislamError: there is not one label for each point.
        """
        if labels.shape != (len(keyframe.cloud),):
            raise HemislamError(
                f"Keyframe {keyframe.index} has {len(keyframe.cloud):,} points; {labels.size:,} labels do not fit."
            )
        labels = labels.copy()
        labels.setflags(write=False)
        self.edits.append(LabelEdit(keyframe.index, labels))

    def undo(self) -> None:
        """Take the last edit back, if there is one."""
        self.edits.truncate(len(self.edits) - 1)

    def forget(self, count: int) -> None:
        """Drop the edits of all but the first `count` keyframes."""
        kept = [edit for edit in self.edits if edit.keyframe < count]
        if len(kept) < len(self.edits):
            self.edits.truncate(0)
            self.edits.extend(kept)

    def over(self, keyframes: Keyframes) -> "LabelledKeyframes":
        """The present keyframes with their present labels. Later keyframes and edits do not change the answer."""
        return LabelledKeyframes(keyframes, len(keyframes), {edit.keyframe: edit.labels for edit in self.edits})


@dataclass(frozen=True, slots=True)
class LabelledKeyframes:
    """The first `count` of some keyframes, with other labels where `labels`, by keyframe, has them."""

    keyframes: Keyframes
    count: int
    labels: Mapping[int, U8]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> Keyframe:
        if not 0 <= index < self.count:
            raise IndexError(f"keyframe {index} of {self.count}")
        keyframe = self.keyframes[index]
        labels = self.labels.get(index)
        return keyframe if labels is None else replace(keyframe, cloud=replace(keyframe.cloud, labels=labels))
