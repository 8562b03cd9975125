"""One transform for each keyframe, poses or corrections, to be sent or held: of thousands, only what is new."""

from dataclasses import dataclass

import numpy as np

from app.slam.rows import Rows
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class TransformsChange:
    """What makes the transforms that were sent before those that there are now.

    Attributes:
        kept: how many of the first stay. new: (n, 4, 4), those after them.
    """

    kept: int
    new: F64


class Transforms:
    """What one side has sent, or the other was sent. While none changes they are the same memory, however many come."""

    def __init__(self) -> None:
        self._rows = Rows((4, 4), np.float64)

    def change(self, transforms: F64) -> TransformsChange:
        """What to send, so that the other side has these (k, 4, 4)."""
        before = self._rows.view()
        both = min(len(before), len(transforms))
        differ = (_bits(before[:both]) != _bits(transforms[:both])).any(axis=(1, 2))
        kept = int(np.argmax(differ)) if differ.any() else both
        change = TransformsChange(kept, transforms[kept:])
        self.take(change)
        return change

    def hold(self, transforms: F64) -> F64:
        """The same, read-only, in the memory of those before as far as they are these."""
        self.change(transforms)
        return self._rows.view()

    def take(self, change: TransformsChange) -> F64:
        """All that there are now, (k, 4, 4), read-only; those given before stay as they are."""
        if change.kept < len(self._rows):
            self._rows = self._rows.rewound(change.kept)
        self._rows.extend(change.new)
        return self._rows.view()


def _bits(numbers: F64) -> np.ndarray:
    """To compare to the last bit, the sign of zero too."""
    return np.ascontiguousarray(numbers).view(np.int64)
