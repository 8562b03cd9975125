"""However long the walk, the server has one memory for what it shows: the map gives up what the rest of it takes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.server import chunks as chunks_module
from app.server.chunks import CANDIDATE_POINTS, FRAME_POINTS, KEYFRAME_POINTS, room
from app.server.delta import Fold, Outbox
from app.server.protocol import SERIES, LoopsView
from app.server.setup import POINT_BUDGET
from app.slam.loops.types import Evidence, LoopEdge, Measured, Verdict
from app.slam.params import Params
from tests.server.test_chunks import chunk, walk

COUNTS = st.integers(0, 10_000_000)


@given(budget=st.integers(10_000, 20_000_000), frames=COUNTS, keyframes=COUNTS, candidates=COUNTS, more=COUNTS)
def test_room_shrinks_with_the_walk_from_the_whole_budget_to_half_of_it(
    budget: int, frames: int, keyframes: int, candidates: int, more: int
) -> None:
    assert room(budget, 0, 0, 0) == budget
    there = room(budget, frames, keyframes, candidates)
    assert budget // 2 <= there <= budget
    assert room(budget, frames + more, keyframes, candidates) <= there
    beside = FRAME_POINTS * frames + KEYFRAME_POINTS * keyframes + CANDIDATE_POINTS * candidates
    if there > budget // 2:
        assert there + beside <= max(budget, POINT_BUDGET)


def test_who_lets_the_page_draw_few_points_is_not_left_fewer_as_long_as_memory_is_that_of_many() -> None:
    assert room(100_000, 36_000, 8_000, 5_000) == 100_000  # an hour's walk
    assert room(POINT_BUDGET, 36_000, 8_000, 5_000) == POINT_BUDGET - 180_000 - 176_000 - 180_000


def test_a_reader_holds_fewer_points_the_longer_the_walk(monkeypatch: pytest.MonkeyPatch) -> None:
    budget = 50_000
    monkeypatch.setattr(chunks_module, "POINT_BUDGET", budget)
    outbox, fold, held = Outbox(Params()), Fold(point_budget=budget), []
    for index in range(300):
        for _ in range(5):
            outbox.frame(np.zeros(3), [0.0] * len(SERIES))
        outbox.chunk(chunk(index))
        outbox.put(keyframe_poses=walk(index + 1))
        shown = fold.apply(outbox.take()).chunks
        held.append(sum(len(one.points) for one in shown))
        assert held[-1] <= room(budget, 5 * (index + 1), index + 1, 0)
    assert max(held[30:60]) > budget * 0.9
    assert budget * 0.6 < max(held[270:]) <= room(budget, 1355, 271, 0)


def test_candidates_that_come_with_a_keyframe_are_counted_with_it_and_those_of_another_walk_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    budget = 50_000
    monkeypatch.setattr(chunks_module, "POINT_BUDGET", budget)
    outbox, fold = Outbox(Params()), Fold(point_budget=budget)
    for index in range(40):
        outbox.chunk(chunk(index))
    measured = Measured(np.eye(4), np.eye(6), Evidence())
    edges = tuple(LoopEdge(0, newer, newer, measured, Verdict.ACCEPTED, "") for newer in range(1, 401))
    outbox.put(keyframe_poses=walk(40), loops=LoopsView(edges=edges))
    shown = fold.apply(outbox.take()).chunks
    assert sum(len(one.points) for one in shown) <= room(budget, 0, 40, 400) < 0.75 * budget
    outbox.begin()
    for index in range(40):
        outbox.chunk(chunk(index))
    outbox.put(keyframe_poses=walk(40))
    shown = fold.apply(outbox.take()).chunks
    assert sum(len(one.points) for one in shown) > 0.9 * budget


def test_at_rest_too_the_map_gives_up_what_the_frames_take(monkeypatch: pytest.MonkeyPatch) -> None:
    budget = 50_000
    monkeypatch.setattr(chunks_module, "POINT_BUDGET", budget)
    outbox, fold = Outbox(Params()), Fold(point_budget=budget)
    for index in range(40):
        outbox.chunk(chunk(index))
    outbox.put(keyframe_poses=walk(40))
    fold.apply(outbox.take())
    thinned = 0
    for frames in range(1, 3001):
        outbox.frame(np.zeros(3), [0.0] * len(SERIES))
        before = fold.snapshot.chunks
        shown = fold.apply(outbox.take()).chunks
        thinned += shown is not before
        assert sum(len(one.points) for one in shown) <= room(budget, frames, 40, 0)
    assert 2 <= thinned <= 30, "a share of it at a time"
