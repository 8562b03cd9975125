"""Loop candidates on their way to another process: of thousands, only those that are others than before are sent."""

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
        self._sent: dict[Pair, LoopEdge] | None = None

    def change(self, edges: tuple[LoopEdge, ...]) -> EdgesChange:
        before, now = self._sent, {edge.pair: edge for edge in edges}
        self._sent = now
        if before is None:
            return EdgesChange(True, edges, ())
        new = tuple(edge for pair, edge in now.items() if before.get(pair) is not edge)
        return EdgesChange(False, new, tuple(pair for pair in before if pair not in now))


class EdgesReceiver:
    """Puts together again what was sent.

    Attributes:
        edges: by keyframes; the same tuple for as long as none has changed.
    """

    def __init__(self) -> None:
        self.edges: tuple[LoopEdge, ...] = ()
        self._held: dict[Pair, LoopEdge] = {}

    def take(self, change: EdgesChange) -> None:
        if not (change.afresh or change.new or change.gone):
            return
        if change.afresh:
            self._held.clear()
        self._held.update((edge.pair, edge) for edge in change.new)
        for pair in change.gone:
            del self._held[pair]
        self.edges = tuple(self._held[pair] for pair in sorted(self._held))
