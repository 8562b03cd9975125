"""A loop comes out of its bytes as it went in."""

import math
import pickle
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.loops.types import Evidence, LoopEdge, Origin, Pair, Verdict

NUMBER = st.floats(allow_nan=True, allow_infinity=True)
KEYFRAME = st.integers(0, 2**31 - 1)


@st.composite
def loops(draw: st.DrawFn) -> tuple[dict[str, object], LoopEdge]:
    """What a loop is made of, and it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    T, half = np.eye(4), rng.normal(size=(6, 6))
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix(), rng.normal(0, 100, 3)
    parts: dict[str, object] = {
        "older": draw(KEYFRAME),
        "newer": draw(KEYFRAME),
        "decided_at": draw(KEYFRAME),
        "T_older_newer": T,
        "covariance": half + half.T,
        "verdict": draw(st.sampled_from(Verdict)),
        "reason": draw(st.text(st.characters(codec="utf-8"), max_size=100)),
        "evidence": Evidence(*(draw(NUMBER) for _ in fields(Evidence)[:-1]), support=draw(KEYFRAME)),
        "origin": draw(st.sampled_from(Origin)),
        "overruled": draw(st.booleans()),
        "weight": draw(NUMBER),
        "represented_by": draw(st.none() | st.tuples(KEYFRAME, KEYFRAME)),
    }
    return parts, LoopEdge(**parts)  # type: ignore[arg-type]


def exactly(value: object) -> object:
    """To compare with ==, to the last bit."""
    if isinstance(value, float):
        return value.hex() if not math.isnan(value) else "nan"
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, Evidence):
        return [exactly(getattr(value, field.name)) for field in fields(value)]
    return value


def contents(edge: LoopEdge) -> dict[str, object]:
    return {field.name: exactly(getattr(edge, field.name)) for field in fields(edge)}


@given(loops())
def test_a_loop_is_what_it_was_made_of_to_the_last_bit(made: tuple[dict[str, object], LoopEdge]) -> None:
    parts, edge = made
    expected = {name: exactly(value) for name, value in parts.items()}
    assert contents(edge) == expected
    assert contents(pickle.loads(pickle.dumps(edge))) == expected
    assert contents(replace(edge)) == expected


@given(loops(), st.sampled_from(Verdict), st.none() | st.tuples(KEYFRAME, KEYFRAME))
def test_one_that_differs_in_some_things_is_the_same_in_all_others(
    made: tuple[dict[str, object], LoopEdge], verdict: Verdict, represented_by: Pair | None
) -> None:
    edge = made[1]
    other = replace(edge, verdict=verdict, represented_by=represented_by, weight=2.5)
    assert contents(other) == contents(edge) | {
        "verdict": verdict,
        "represented_by": represented_by,
        "weight": exactly(2.5),
    }
    assert other.counts == (verdict is Verdict.ACCEPTED and represented_by is None)


def test_nobody_changes_a_loop_that_others_hold() -> None:
    edge = LoopEdge(3, 40, 41, np.eye(4), np.eye(6), Verdict.ACCEPTED, "it fits", Evidence())
    with pytest.raises(ValueError, match="read-only"):
        edge.T_older_newer[0, 3] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        edge.covariance *= 2.0  # type: ignore[misc]
    with pytest.raises(AttributeError):
        edge.weight = 2.0  # type: ignore[misc]


def test_a_loop_takes_little_memory_after_a_way_through_a_pipe() -> None:
    """As the processes that show loops hold them: 1.1 kB each before they were packed."""
    reason = "overlap 0.97, residual 6 mm, slide 1 mm, 0.0 σ from odometry; 26 others agree"
    evidence = Evidence(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 26)
    sent = [
        pickle.dumps(LoopEdge(1000 + k, 3000 + k, 3001 + k, np.eye(4), np.eye(6), Verdict.ACCEPTED, reason, evidence))
        for k in range(1000)
    ]
    tracemalloc.start()
    held = [pickle.loads(one) for one in sent]
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held[-1].pair == (1999, 3999)
    assert taken < 650 * len(held)
