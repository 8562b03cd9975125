"""Folding deltas gives the same snapshot however seldom they are taken."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import server_fakes as fakes
from hypothesis import given, settings
from hypothesis import strategies as st

from app.server.chunks import one_per_voxel
from app.server.delta import Fold, Outbox
from app.server.protocol import (
    SERIES,
    Command,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.server.session import Session
from app.slam.params import Params
from app.slam.rows import table

COMMANDS: list[Command] = [
    Play(),
    Pause(),
    StepFrame(3),
    Seek(25),
    Seek(2),
    Seek(13),
    StepFrame(-1),
    StepFrame(-7),
    SetSpeed(float("inf")),
    SetParams({"ground.sigma": 0.1}),
    SetParams({"ground.alpha": 1e6}),
    OpenRecording(Path("walk-20.mcap")),
    OpenRecording(Path("nothing.mcap")),
    Restart(),
]


def content(snapshot: Snapshot) -> dict[str, Any]:
    """What the page would draw, comparable; wall-clock rates and the count of revisions left out."""
    result = snapshot.result
    return {
        "session": snapshot.session,
        "params": snapshot.params,
        "transport": replace(snapshot.transport, frames_per_second=0.0),
        "recording": snapshot.recording and snapshot.recording.path,
        "labels": None if result is None else (result.index, result.cloud.labels.tobytes()),
        "trajectory": None if snapshot.trajectory is None else snapshot.trajectory.tolist(),
        "poses": None if snapshot.keyframe_poses is None else snapshot.keyframe_poses.tolist(),
        "chunks": [(chunk.index, chunk.points.tobytes(), chunk.labels.tobytes()) for chunk in snapshot.chunks],
        "series": {name: np.nan_to_num(column, nan=-1).tolist() for name, column in snapshot.series.items()},
        "progress": repr(snapshot.progress),
        "notices": snapshot.notices,
    }


@settings(deadline=None, max_examples=40)
@given(script=st.lists(st.tuples(st.sampled_from(COMMANDS), st.integers(1, 12)), max_size=8), data=st.data())
def test_a_reader_that_misses_updates_ends_with_the_same_snapshot(
    script: list[tuple[Command, int]], data: st.DataObject
) -> None:
    def drive(take_after: list[bool]) -> Snapshot:
        outbox, fold, now = Outbox(Params()), Fold(), 0.0
        session = Session(outbox, Params(), fakes.open_fake, clock=lambda: now)
        session.open(Path("walk-40.mcap"), None)
        for (command, pieces), take in zip(script, take_after, strict=True):
            session.handle(command)
            for _ in range(pieces):
                session.work()
                now += 0.05
                if take and outbox.filled:
                    fold.apply(outbox.take())
        session.close()
        if outbox.filled:
            fold.apply(outbox.take())
        return fold.snapshot

    attentive = drive([True] * len(script))
    lazy = drive(data.draw(st.lists(st.booleans(), min_size=len(script), max_size=len(script))))
    assert content(attentive) == content(lazy)


def test_poses_that_stay_are_held_once_however_many_snapshots_there_are_of_them() -> None:
    fold, outbox = Fold(), Outbox(Params())

    def told(poses: np.ndarray) -> np.ndarray:
        outbox.put(keyframe_poses=poses.copy())
        shown = fold.apply(outbox.take()).keyframe_poses
        assert shown is not None
        np.testing.assert_array_equal(shown, poses)
        return shown

    walk = np.random.default_rng(0).normal(size=(102, 4, 4))
    first, longer, corrected = told(walk[:100]), told(walk), told(walk + 1.0)
    assert np.shares_memory(first, longer) and not np.shares_memory(longer, corrected)
    np.testing.assert_array_equal(longer, walk, "what was shown stays as it was")


def test_nothing_is_kept_for_a_reader_that_has_it() -> None:
    outbox = Outbox(Params())
    outbox.frame(np.zeros(3), [0.0] * len(SERIES))
    outbox.notice("info", "one")
    outbox.take()
    assert not outbox.filled and not outbox.urgent


@given(st.lists(st.integers(0, 400), max_size=8))
def test_views_of_a_growing_table_stay_as_they_were(lengths: list[int]) -> None:
    rows, views, expected = table(2), [], np.zeros((0, 2))
    for number, length in enumerate(lengths):
        block = np.full((length, 2), float(number))
        rows.extend(block)
        expected = np.vstack([expected, block])
        views.append((rows.view(), expected))
    for view, then in views:
        assert not view.flags.writeable
        np.testing.assert_array_equal(view, then)


@given(seed=st.integers(0, 1000), size=st.sampled_from([0.05, 0.3, 1.0]), shift=st.floats(-500, 500))
def test_thinning_keeps_exactly_one_point_of_every_occupied_voxel(seed: int, size: float, shift: float) -> None:
    points = (np.random.default_rng(seed).normal(0, 2, (500, 3)) + shift).astype(np.float32)
    chosen = one_per_voxel(points, size, seed)
    cells = [tuple(cell) for cell in np.floor(points * np.float32(1 / size)).astype(int)]
    assert len({cells[index] for index in chosen}) == len(chosen) == len(set(cells))
