"""What the page calls a loop, how it colours it and what it says of commands."""

from enum import StrEnum
from typing import Final

from app.slam.loops.types import Accept, Add, LoopEdge, LoopEdit, Origin, Pair, SetWeight, Solve
from app.ui.colours import Rgb


class Kind(StrEnum):
    """As the page tells loops apart: by the finder's verdict, or that a person had the last word."""

    ACCEPTED = "accepted"
    CANDIDATE = "candidate"
    REJECTED = "rejected"
    USER = "by hand"


COLOURS: Final[dict[Kind, Rgb]] = {
    Kind.ACCEPTED: (62, 207, 154),
    Kind.CANDIDATE: (255, 190, 60),
    Kind.REJECTED: (214, 84, 92),
    Kind.USER: (178, 136, 255),
}
OLDER: Final[Rgb] = (70, 170, 255)
NEWER: Final[Rgb] = (255, 150, 60)
"""Of the two submaps, wherever they are shown."""
GHOST: Final[Rgb] = (206, 176, 255)


def kind_of(edge: LoopEdge) -> Kind:
    if edge.edited or edge.origin is Origin.USER:
        return Kind.USER
    return Kind(edge.verdict.value)


def name(pair: Pair) -> str:
    """`12–340`: older, newer keyframe."""
    return f"{pair[0]}–{pair[1]}"


def say(command: LoopEdit) -> str:
    """A command in a few words."""
    if isinstance(command, Solve):
        return "solve all at once"
    pair = name((command.older, command.newer))
    match command:
        case Accept():
            return f"accept {pair}"
        case SetWeight(weight=weight):
            return f"weigh {pair} by {weight:g}"
        case Add(register=register):
            return f"tie {pair}" + ("" if register else " as it lies")
        case _:
            return f"reject {pair}"
