"""What was found with one keyframe after the other: appended to or cut off. Going back is to look at less."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from app.slam.loops.factors import Factor, Odometry, Step
from app.slam.loops.search import Found
from app.slam.params import Loops


@dataclass(frozen=True, slots=True)
class Record:
    """What one keyframe was looked at with, and what was found when it came."""

    params: Loops
    found: Found


class History:
    """Records in order, the odometry between their keyframes, and what was found where the walk was said to end.

    Attributes:
        ends: by the number of keyframes.
    """

    def __init__(self) -> None:
        self.ends: dict[int, Found] = {}
        self._records: list[Record] = []
        self._odometry = Odometry()

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, index: int) -> Record:
        return self._records[index]

    def append(self, record: Record, odometry: Factor | None) -> None:
        """The next keyframe, with the odometry to it; None for the first."""
        self._records.append(record)
        if odometry is not None:
            self._odometry.append(odometry)

    def cut(self, count: int) -> None:
        """Keep the first `count`."""
        del self._records[count:]
        self._odometry.cut(max(count - 1, 0))
        self.ends = {end: found for end, found in self.ends.items() if end <= count}

    def found(self, count: int, *, finished: bool) -> list[Found]:
        """With the first `count`, in order, and if the walk is finished at the end too."""
        end = [self.ends[count]] if finished else []
        return [record.found for record in self._records[:count]] + end

    def odometry_to(self, index: int) -> Factor | None:
        """From the keyframe before; None for the first."""
        return self._odometry[index - 1] if index else None

    def odometry(self, count: int) -> list[Factor]:
        """Between the first `count`."""
        return [self._odometry[index] for index in range(count - 1)]

    def steps(self, count: int, loops: Mapping[int, Iterable[Factor]]) -> Iterator[Step]:
        """The graph of the first `count`, in the order in which keyframes came, and loops with them."""
        for index in range(count):
            if index:
                yield self._odometry[index - 1]
            if index in loops:
                yield tuple(loops[index])
