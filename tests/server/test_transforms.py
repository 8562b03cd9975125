"""Transforms that are sent as differences arrive as they are."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.server.transforms import Transforms


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 600)), max_size=8), st.integers(0, 2**32))
def test_whatever_of_them_changes_the_other_side_has_the_same(walk: list[tuple[int, int]], seed: int) -> None:
    """Each time some from the first on are as they were, and there are more or fewer of them; to the last bit."""
    rng, sender, receiver = np.random.default_rng(seed), Transforms(), Transforms()
    now, seen = np.empty((0, 4, 4)), []
    for kept, count in walk:
        now = np.concatenate([now[:kept], rng.choice([0.0, -0.0, 1.5], size=(count, 4, 4))])
        seen.append((receiver.take(sender.change(now)), now))
    for taken, sent in seen:
        assert taken.shape == sent.shape
        assert taken.tobytes() == sent.tobytes()


def test_what_stays_is_neither_sent_nor_held_again() -> None:
    rng, sender, receiver = np.random.default_rng(0), Transforms(), Transforms()
    first = receiver.take(sender.change(rng.normal(size=(300, 4, 4))))
    change = sender.change(np.concatenate([first, rng.normal(size=(2, 4, 4))]))
    assert change.new.shape == (2, 4, 4)
    assert np.shares_memory(receiver.take(change), first)
