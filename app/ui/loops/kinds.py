"""How the page tells loops apart, what it calls them, and what it says of edits."""

from dataclasses import dataclass
from typing import Final

from app.slam.loops.types import Accept, Add, LoopEdge, LoopEdit, Origin, Pair, SetWeight, Solve, Verdict
from app.ui.colours import Rgb


@dataclass(frozen=True, slots=True)
class LoopKind:
    """Attributes:
    width: of an arch that is in the graph, px. out_width: of one that is not. knob_m: diameter of its knob.
    """

    name: str
    colour: Rgb
    width: float
    out_width: float
    knob_m: float


EDITED: Final = "by hand"
KINDS: Final[dict[str, LoopKind]] = {
    kind.name: kind
    for kind in (
        LoopKind("accepted", (62, 207, 154), 3.0, 1.0, 0.1),
        LoopKind("candidate", (255, 190, 60), 2.0, 2.0, 0.1),
        LoopKind("rejected", (214, 84, 92), 1.0, 1.0, 0.07),
        LoopKind(EDITED, (178, 136, 255), 3.5, 1.0, 0.12),
    )
}
"""By the search's verdict, or by the fact that a person had the last word; in the order shown."""
SIGNS: Final = {Verdict.ACCEPTED: "✓", Verdict.CANDIDATE: "?", Verdict.REJECTED: "✕"}
"""Of a verdict in the table, in the order sorted."""

OLDER: Final[Rgb] = (70, 170, 255)
NEWER: Final[Rgb] = (255, 150, 60)
"""Of the two submaps, wherever they are shown."""


def kind_of(edge: LoopEdge) -> LoopKind:
    return KINDS[EDITED if edge.edited or edge.origin is Origin.USER else edge.verdict.value]


def name(pair: Pair) -> str:
    """`12–340`: older, newer keyframe."""
    return f"{pair[0]}–{pair[1]}"


def describe_edit(command: LoopEdit) -> str:
    """An edit in a few words."""
    if isinstance(command, Solve):
        return "solve all at once"
    pair = name((command.older, command.newer))
    match command:
        case Accept():
            return f"accept {pair}"
        case SetWeight(weight=weight):
            return f"weigh {pair} by {weight:g}"
        case Add(register=register):
            return f"add {pair}" + ("" if register else " as it lies")
        case _:
            return f"reject {pair}"
