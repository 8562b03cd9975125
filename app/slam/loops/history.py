"""What was found with one keyframe after the other: appended to or cut off. Going back is to look at less."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from app.slam.loops.detection import Head
from app.slam.loops.pose_graph import Factor, Step
from app.slam.loops.search import Found
from app.slam.params import Loops


@dataclass(frozen=True, slots=True)
class Record:
    """One keyframe: itself without its cloud, its odometry (None for the first), and what was found when it came."""

    head: Head
    odometry: Factor | None
    params: Loops
    found: Found


class History:
    """Records in order, and what was found where the walk was said to end.

    Attributes:
        ends: by the number of keyframes.
    """

    def __init__(self) -> None:
        self.ends: dict[int, Found] = {}
        self._records: list[Record] = []

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, index: int) -> Record:
        return self._records[index]

    def append(self, record: Record) -> None:
        self._records.append(record)

    def cut(self, count: int) -> None:
        """Keep the first `count`."""
        del self._records[count:]
        self.ends = {end: found for end, found in self.ends.items() if end <= count}

    def holds(self, index: int, head: Head, params: Loops) -> bool:
        """Whether this is the keyframe there, looked at with the same parameters."""
        if index >= len(self):
            return False
        there = self._records[index]
        return there.params == params and _same(there.head, head)

    def heads(self, count: int) -> list[Head]:
        """Of the first `count`."""
        return [record.head for record in self._records[:count]]

    def found(self, count: int, *, finished: bool) -> list[Found]:
        """With the first `count`, in order, and if the walk is finished at the end too."""
        end = [self.ends[count]] if finished else []
        return [record.found for record in self._records[:count]] + end

    def odometry(self, count: int) -> list[Factor]:
        """Between the first `count`."""
        return [record.odometry for record in self._records[:count] if record.odometry is not None]

    def steps(self, count: int, loops: Mapping[int, Iterable[Factor]]) -> list[Step]:
        """The graph of the first `count`, in the order in which keyframes came, and loops with them."""
        steps = []
        for index, record in enumerate(self._records[:count]):
            if record.odometry is not None:
                steps.append(Step(record.odometry))
            if index in loops:
                steps.append(Step(None, tuple(loops[index])))
        return steps


def _same(a: Head, b: Head) -> bool:
    return (
        a.stamp_ns == b.stamp_ns
        and np.array_equal(a.T_odom_imu, b.T_odom_imu)
        and np.array_equal(a.covariance, b.covariance, equal_nan=True)
    )
