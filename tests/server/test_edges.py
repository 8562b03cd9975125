"""Loop candidates that are sent as differences arrive as they are."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.server.edges import EdgesReceiver, EdgesSender
from app.slam.loops.types import Evidence, LoopEdge, Measured, Pair, Verdict

PAIRS = [(older, newer) for newer in range(8, 12) for older in range(3)]


def edge(pair: Pair) -> LoopEdge:
    measured = Measured(np.eye(4), np.eye(6), Evidence())
    return LoopEdge(*pair, pair[1], measured, Verdict.ACCEPTED, "it fits")


@given(st.lists(st.tuples(st.booleans(), st.dictionaries(st.sampled_from(PAIRS), st.integers(0, 2))), max_size=8))
def test_whatever_comes_changes_and_goes_the_receiver_holds_the_same(
    walk: Sequence[tuple[bool, dict[Pair, int]]],
) -> None:
    """Also when another sender, which knows nothing of the one before, takes over."""
    versions = {(pair, number): edge(pair) for pair in PAIRS for number in range(3)}
    sender, receiver = EdgesSender(), EdgesReceiver()
    for another, chosen in walk:
        sender = EdgesSender() if another else sender
        edges = tuple(versions[pair, chosen[pair]] for pair in sorted(chosen))
        receiver.take(sender.change(edges))
        assert len(receiver.edges) == len(edges)
        assert all(one is other for one, other in zip(receiver.edges, edges, strict=True))


def test_what_stays_the_same_is_not_sent_again_and_makes_no_other_tuple() -> None:
    edges = tuple(edge(pair) for pair in sorted(PAIRS))
    sender, receiver = EdgesSender(), EdgesReceiver()
    receiver.take(sender.change(edges))
    held = receiver.edges
    again = sender.change(edges)
    assert not again.new and not again.gone
    receiver.take(again)
    assert receiver.edges is held
