"""Loop candidates as values, and the difference between two states of them.

Tests app/slam/arrays.py.
"""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.slam.loops.types import Evidence, LoopEdge, Verdict, changed_by, difference


def edge(newer: int, verdict: Verdict = Verdict.CANDIDATE) -> LoopEdge:
    return LoopEdge(0, newer, newer, np.eye(4), np.eye(6), Evidence(0.5), verdict, "it fits")


def test_a_measurement_is_read_only_and_survives_pickling() -> None:
    rng = np.random.default_rng(0)
    measured = replace(
        edge(10),
        T_older_newer=rng.normal(size=(4, 4)),
        covariance=rng.normal(size=(6, 6)),
        evidence=Evidence(0.1, support=3),
    )
    with pytest.raises(ValueError, match="read-only"):
        measured.T_older_newer[0, 3] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        measured.covariance[0, 0] = 2.0
    other = pickle.loads(pickle.dumps(measured))
    assert other.T_older_newer.tobytes() == measured.T_older_newer.tobytes()
    assert other.covariance.tobytes() == measured.covariance.tobytes()
    assert other.evidence.support == 3


def test_the_difference_lists_new_changed_and_lost_candidates() -> None:
    first, second, third = edge(10), edge(20), edge(30)
    accepted = replace(second, verdict=Verdict.ACCEPTED)
    assert difference((), (first, second)) == ((first, second), ())
    assert difference((first, second), (first, accepted, third)) == ((accepted, third), ())
    assert difference((first, second), (second,)) == ((), (first.pair,))
    copied = pickle.loads(pickle.dumps((first, second)))
    assert difference((first, second), copied) == ((), ()), "equal values are no change"


def test_a_candidate_differs_if_its_place_in_the_graph_or_its_measurement_does() -> None:
    one = edge(10)
    moved = replace(one, T_older_newer=np.diag([2.0, 1.0, 1.0, 1.0]))
    surer = replace(one, covariance=np.eye(6) / 2)
    judged = replace(one, evidence=Evidence(0.5, mahalanobis=1.2))
    renamed = replace(one, reason="other")
    for other in (replace(one, weight=2.0), replace(one, represented_by=(0, 9)), moved, renamed, surer, judged):
        assert difference((one,), (other,)) == ((other,), ())


@given(st.lists(st.dictionaries(st.integers(1, 9), st.sampled_from(Verdict)), max_size=6))
def test_a_reader_that_applies_every_difference_holds_the_same_candidates(states: list[dict[int, Verdict]]) -> None:
    sent: tuple[LoopEdge, ...] = ()
    held: tuple[LoopEdge, ...] = ()
    for state in states:
        edges = tuple(edge(newer, verdict) for newer, verdict in sorted(state.items()))
        held, sent = changed_by(difference(sent, edges), held), edges
        assert [one.pair for one in held] == [one.pair for one in edges]
        assert difference(held, edges) == ((), ())
