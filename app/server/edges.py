"""Loop candidates on their way to another process: of thousands, only those that are others than before are sent."""

from bisect import bisect_left
from dataclasses import dataclass

from app.slam.loops.types import LoopEdge, Pair


@dataclass(frozen=True, slots=True)
class EdgesChange:
    """What makes the candidates that were sent before those that there are now.

    Attributes:
        afresh: whether all that were sent before are void. new: that are others now or were not there.
        gone: that are not there any more.
    """

    afresh: bool
    new: tuple[LoopEdge, ...]
    gone: tuple[Pair, ...]


class EdgesSender:
    """Knows what was sent. A candidate that stays the same object is not sent again."""

    def __init__(self) -> None:
        self._sent: tuple[LoopEdge, ...] | None = None

    def change(self, edges: tuple[LoopEdge, ...]) -> EdgesChange:
        before, self._sent = self._sent, edges
        if before is None:
            return EdgesChange(True, edges, ())
        sent, there = set(before), set(edges)  # as objects
        new = tuple(edge for edge in edges if edge not in sent)
        others = {edge.pair for edge in new}
        lost = (edge.pair for edge in before if edge not in there)
        return EdgesChange(False, new, tuple(pair for pair in lost if pair not in others))


class EdgesReceiver:
    """Puts together again what was sent.

    Attributes:
        edges: by keyframes; the same tuple for as long as none has changed.
    """

    def __init__(self) -> None:
        self.edges: tuple[LoopEdge, ...] = ()

    def take(self, change: EdgesChange) -> None:
        if not (change.afresh or change.new or change.gone):
            return
        held = [] if change.afresh else list(self.edges)
        for edge in change.new:
            place = bisect_left(held, edge.pair, key=_pair)
            there = place < len(held) and held[place].pair == edge.pair
            held[place : place + there] = [edge]
        for pair in change.gone:
            del held[bisect_left(held, pair, key=_pair)]
        self.edges = tuple(held)


def _pair(edge: LoopEdge) -> Pair:
    return edge.pair
