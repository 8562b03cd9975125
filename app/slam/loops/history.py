"""What was found with one keyframe after the other: appended to or cut off. Going back is to look at less."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from app.slam.loops.factors import Factor, Factors, Step
from app.slam.loops.scan_context import Contexts, ScanContext
from app.slam.loops.search import Found
from app.slam.loops.types import LoopEdge
from app.slam.params import LoopsParams
from app.slam.rows import Rows


@dataclass(frozen=True, slots=True)
class Record:
    """What one keyframe was looked at with, and what was found when it came."""

    params: LoopsParams
    found: Found


class History:
    """Records in order, the odometry between their keyframes, and what was found where the walk was said to end.

    Attributes:
        ends: by the number of keyframes.
    """

    def __init__(self) -> None:
        self.ends: dict[int, Found] = {}
        self._params: list[LoopsParams] = []
        self._updates: list[LoopEdge] = []
        self._updated = Rows((), np.int64, [0])  # how many of those before the first keyframe, and after each
        self._contexts = Contexts()
        self._described = Rows((), np.int64, [0])  # the same of contexts
        self._odometry = Factors()  # from each keyframe to the next

    def __len__(self) -> int:
        return len(self._params)

    def __getitem__(self, index: int) -> Record:
        begin, end = self._described.view()[index : index + 2]
        contexts = tuple(self._contexts[number] for number in range(begin, end))
        first, last = self._updated.view()[index : index + 2]
        return Record(self._params[index], Found(contexts, tuple(self._updates[first:last])))

    def append(self, record: Record, odometry: Factor | None) -> None:
        """The next keyframe, with the odometry to it; None for the first."""
        self._updates += record.found.updates
        self._updated.append(len(self._updates))
        for context in record.found.contexts:
            self._contexts.append(context)
        self._described.append(len(self._contexts))
        if odometry is not None:
            self._odometry.append(odometry)
        same = self._params and record.params == self._params[-1]
        self._params.append(self._params[-1] if same else record.params)  # kept once

    def cut(self, count: int) -> None:
        """Keep the first `count`."""
        del self._params[count:]
        self._updated.go_to(count + 1)
        del self._updates[self._updated.view()[-1] :]
        self._described.go_to(count + 1)
        self._contexts.cut(int(self._described.view()[-1]))
        self._odometry.cut(max(count - 1, 0))
        self.ends = {end: found for end, found in self.ends.items() if end <= count}

    def contexts(self, count: int, *, finished: bool) -> list[ScanContext]:
        """Found with the first `count`, in order, and if the walk is finished at the end too."""
        end = self.ends[count].contexts if finished else ()
        return [*(self._contexts[number] for number in range(self._described.view()[count])), *end]

    def updates(self, count: int, *, finished: bool) -> list[LoopEdge]:
        """The same of candidates."""
        end = self.ends[count].updates if finished else ()
        return [*self._updates[: self._updated.view()[count]], *end]

    def odometry_to(self, index: int) -> Factor | None:
        """From the keyframe before; None for the first."""
        return self._odometry[index - 1] if index else None

    def odometry(self, count: int) -> list[Factor]:
        """Between the first `count`."""
        return list(self._odometry.stretch(0, count - 1))

    def steps(self, count: int, loops: Mapping[int, Iterable[Factor]]) -> Iterator[Step]:
        """The graph of the first `count`, in the order in which keyframes came, and loops with them."""
        for index in range(count):
            if index:
                yield self._odometry[index - 1]
            if index in loops:
                yield tuple(loops[index])
