"""Keyframes of several sessions have different names, and those of one session are in order."""

import copy
import pickle

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.slam.keyframe_id import KeyframeId

NAMES = st.tuples(st.integers(0, 100_000), st.integers(0, 10**9))


@given(NAMES, NAMES)
def test_a_name_holds_session_and_index_and_sorts_by_them(one: tuple[int, int], other: tuple[int, int]) -> None:
    a, b = KeyframeId(*one), KeyframeId(*other)
    assert (a.session, a.index) == one
    assert (a < b, a == b, hash(a) == hash(b)) == (one < other, one == other, one == other)


@given(NAMES)
def test_a_name_survives_pickling_and_copying(one: tuple[int, int]) -> None:
    for again in (pickle.loads(pickle.dumps(KeyframeId(*one), protocol=5)), copy.deepcopy(KeyframeId(*one))):
        assert (type(again), again.session, again.index) == (KeyframeId, *one)


def test_in_the_first_session_a_name_is_the_index() -> None:
    assert np.arange(10)[KeyframeId(0, 7)] == 7
    assert [f"{KeyframeId(session, 7)}" for session in (0, 2)] == ["7", "2/7"]
