"""The layer of moving points: which points of each keyframe are on moving objects, found once and kept.

This layer depends only on the surrounding keyframes and on two parameters. So a session file does not hold it, and the
same keyframes always give the same points. The last keyframes are judged again as others follow.
"""

import threading

import numpy as np

from app.slam import moving
from app.slam.ply import Keyframes
from app.slam.sections import MovingParams
from app.slam.types import Keyframe, Mask


class MovingPoints:
    """Finds the moving points of keyframes. Any thread may call `find`.

    Attributes:
        params: change them with `choose`.
    """

    def __init__(self, keyframes: Keyframes, params: MovingParams) -> None:
        self._keyframes, self.params = keyframes, params
        self._found: dict[int, tuple[int, int, bytes]] = {}  # points; number of keyframes then, or 0; packed mask
        self._sights: dict[int, moving.Sight] = {}
        self._finished = 0  # this many of the first keyframes were judged with all keyframes around them
        self._lock = threading.Lock()

    def choose(self, params: MovingParams) -> None:
        """Use these parameters from now on; known masks stay until their keyframes are judged again."""
        if params != self.params:
            with self._lock:
                self.params, self._finished = params, 0
                self._found = {index: (points, 0, mask) for index, (points, _, mask) in self._found.items()}

    def forget_after(self, count: int) -> None:
        """All keyframes after the first `count` will be different ones."""
        with self._lock:
            whole = max(count - moving.AROUND, 0)  # this many of the first keyframes keep all keyframes around them
            self._finished = min(self._finished, whole)
            self._found = {
                index: found for index, found in self._found.items() if index < whole or 0 < found[1] <= count
            }
            self._sights = {index: sight for index, sight in self._sights.items() if index < count}

    def known(self, index: int) -> Mask | None:
        """(n,) the mask last found; None if there is none."""
        points, _, mask = self._found.get(index, (0, 0, b""))
        return np.unpackbits(np.frombuffer(mask, np.uint8), count=points).astype(np.bool_) if points else None

    def find(self, keyframe: Keyframe, count: int, params: MovingParams) -> Mask:
        """(n,) whether each point of a keyframe moves, as the first `count` keyframes show."""
        with self._lock:
            index = keyframe.index
            end = min(index + moving.AROUND + 1, count)
            same = params == self.params
            known_end = self._found[index][1] if same and index in self._found else 0
            if known_end == end and (known := self.known(index)) is not None:
                return known
            mask = np.zeros(len(keyframe.cloud), np.bool_)
            if params.enabled:
                mask = moving.find(keyframe, self._around(index, end), params)
            if same and end > known_end:
                self._found[index] = len(mask), end, np.packbits(mask).tobytes()
            return mask

    def next(self, count: int, *, last: bool) -> tuple[int, bool] | None:
        """Find the moving points of one more keyframe. Returns its index and whether they changed; None: all are found.

        Args:
            last: include the last keyframes, to be judged again as others follow.
        """
        for index in range(self._finished, count):
            whole = index + moving.AROUND < count
            if not (whole or last):
                return None
            before = self._found.get(index, (0, 0, b""))
            if before[1] < min(index + moving.AROUND + 1, count):
                found = self.find(self._keyframes[index], count, self.params)
                return index, self._found[index][2] != before[2] if before[0] else bool(found.any())
            self._finished += whole
        return None

    def _around(self, index: int, end: int) -> list[moving.Sight]:
        begin = max(index - moving.AROUND, 0)
        self._sights = {place: sight for place, sight in self._sights.items() if begin <= place < end}
        for place in range(begin, end):
            if place not in self._sights:
                self._sights[place] = moving.sight(self._keyframes[place])
        return [self._sights[place] for place in moving.around(index, end)]
