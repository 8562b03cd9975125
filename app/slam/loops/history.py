"""What was found with each keyframe. It is only appended to or truncated; going back means reading less of it."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from app.slam.loops.factors import Factor, Step
from app.slam.loops.scan_context import ScanContext
from app.slam.loops.search import Found
from app.slam.loops.types import LoopEdge
from app.slam.sections import LoopsParams


@dataclass(frozen=True, slots=True)
class Record:
    """The parameters for one keyframe, what was found when it came, and the odometry to it (None for the first)."""

    params: LoopsParams
    found: Found
    odometry: Factor | None


class History:
    """Records in the order of their keyframes.

    Attributes:
        ends: what was found in addition where the session ended, by the number of keyframes.
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

    def truncate(self, count: int) -> None:
        """Keep the first `count`."""
        del self._records[count:]
        self.ends = {end: found for end, found in self.ends.items() if end <= count}

    def contexts(self, count: int, *, finished: bool) -> list[ScanContext]:
        """Those found with the first `count` keyframes, in order; if `finished`, also those found at the end."""
        return [context for found in self._found(count, finished) for context in found.contexts]

    def updates(self, count: int, *, finished: bool) -> list[LoopEdge]:
        """The same for loop candidates."""
        return [edge for found in self._found(count, finished) for edge in found.updates]

    def odometry(self, count: int) -> list[Factor]:
        """Between the first `count` keyframes."""
        return [record.odometry for record in self._records[:count] if record.odometry is not None]

    def steps(self, count: int, loops: Mapping[int, Iterable[Factor]]) -> Iterator[Step]:
        """The graph of the first `count`, in the order in which keyframes came, with the loops that came with each."""
        for index, record in enumerate(self._records[:count]):
            if record.odometry is not None:
                yield record.odometry
            if index in loops:
                yield tuple(loops[index])

    def _found(self, count: int, finished: bool) -> list[Found]:
        end = [self.ends[count]] if finished else []
        return [*(record.found for record in self._records[:count]), *end]
