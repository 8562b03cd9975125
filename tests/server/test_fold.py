"""Applying deltas gives the same snapshot, however rarely they are taken."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import server_fakes as fakes
from hypothesis import given, settings
from hypothesis import strategies as st

from app.server.chunks import one_per_voxel
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import (
    Command,
    OpenedRecording,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
    Transport,
)
from app.server.publisher import Publisher
from app.slam.frames import READOUTS, Frame
from app.slam.log import Log
from app.slam.map_frame import MapFrame
from app.slam.params import Params

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
        "trajectory": snapshot.trajectory.tolist(),
        "poses": snapshot.keyframe_poses.tolist(),
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
        page, fold, now = Publisher(Params()), Fold(), 0.0
        controller = Controller(page, Params(), fakes.open_fake, clock=lambda: now)
        controller.open(Path("walk-40.mcap"), None)
        for (command, pieces), take in zip(script, take_after, strict=True):
            controller.handle(command)
            for _ in range(pieces):
                controller.work()
                now += 0.05
                if take and page.filled:
                    fold.apply(page.take())
        controller.close()
        if page.filled:
            fold.apply(page.take())
        return fold.snapshot

    attentive = drive([True] * len(script))
    lazy = drive(data.draw(st.lists(st.booleans(), min_size=len(script), max_size=len(script))))
    assert content(attentive) == content(lazy)


class Frames:
    """Frames along x without clouds, and a reader of them."""

    def __init__(self) -> None:
        self.log: Log[Frame] = Log()
        self.page, self.fold = Publisher(Params()), Fold()
        self.page.begin(self.log, [])

    def add(self, count: int = 1, *, keyframes: bool = False) -> None:
        for _ in range(count):
            at = len(self.log)
            position, turn = np.array([float(at), 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
            self.log.append(Frame(at, keyframes, position, turn, np.full(len(READOUTS), float(at))))

    def see(self, **changes: Any) -> Snapshot:
        self.page.put(transport=Transport(frame=len(self.log) - 1), **changes)
        return self.fold.apply(self.page.take())


def test_poses_that_stay_are_the_same_object() -> None:
    """So that the page knows at once that no keyframe has moved."""
    frames = Frames()
    frames.add(5, keyframes=True)
    poses = frames.see().keyframe_poses
    frames.add(3)
    assert frames.see().keyframe_poses is poses


def test_a_loop_closure_sends_corrections_and_no_frame() -> None:
    frames = Frames()
    frames.add(10, keyframes=True)
    before = frames.see()
    up = np.tile(np.eye(4), (10, 1, 1))
    up[:, 2, 3] = np.arange(10.0)
    frames.page.put(corrections=MapFrame(np.arange(10), up))
    delta = frames.page.take()
    assert (delta.keep, delta.frames, delta.chunks) == (10, (), ())
    after = frames.fold.apply(delta)
    np.testing.assert_allclose(after.trajectory[:, 2], np.arange(10.0), atol=1e-12)
    np.testing.assert_allclose(after.keyframe_poses[:, 2, 3], np.arange(10.0), atol=1e-12)
    assert not before.trajectory[:, 2].any(), "what was shown before stays as it was"


@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 6), st.floats(-1, 1)), min_size=1, max_size=6))
def test_frames_lie_where_the_newest_corrections_put_them_whatever_came_before(
    steps: list[tuple[int, int, float]],
) -> None:
    """A step goes back to some frames, adds others, and changes the corrections of the later half of keyframes."""
    frames = Frames()
    ups = np.zeros(100)
    for back_to, added, up in steps:
        frames.log.truncate(back_to)
        frames.add(added, keyframes=True)
        count = len(frames.log)
        ups[count // 2 :] += up
        T_map_odom = np.tile(np.eye(4), (count, 1, 1))
        T_map_odom[:, 2, 3] = ups[:count]
        seen = frames.see(corrections=MapFrame(np.arange(count), T_map_odom))
        np.testing.assert_allclose(seen.trajectory[:, 0], np.arange(count), atol=1e-12)
        np.testing.assert_allclose(seen.trajectory[:, 2], ups[:count], atol=1e-12)


def test_the_error_to_the_truth_follows_from_the_trajectory_that_is_shown() -> None:
    frames, turn = Frames(), np.array([0.0, 0.0, 0.0, 1.0])
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1]])
    for stamp, position in enumerate(square):
        frames.log.append(Frame(stamp, False, position, turn, np.zeros(len(READOUTS))))
    theirs = square[:, [1, 0, 2]] * [-1, 1, 1] + 5.0  # turned and shifted
    recording = OpenedRecording(Path("square.mcap"), 0, 4e-9, 4, (), np.arange(4), theirs)
    seen = frames.see(recording=recording)
    np.testing.assert_allclose(seen.series["error_m"], 0.0, atol=1e-9)
    np.testing.assert_allclose(seen.series["distance"][:3], [0.0, 1.0, 2.0])
    assert seen.T_map_truth is not None
    np.testing.assert_allclose(theirs @ seen.T_map_truth[:3, :3].T + seen.T_map_truth[:3, 3], square, atol=1e-9)
    none = frames.see(recording=replace(recording, truth_stamps_ns=None, truth_positions=None))
    assert none.T_map_truth is None and np.isnan(none.series["error_m"]).all()


def test_stamps_of_frames_after_the_shown_one_stay_known() -> None:
    frames = Frames()
    frames.add(3)
    every = frames.see().known_ns
    frames.page.put(transport=Transport(frame=0))
    seen = frames.fold.apply(frames.page.take())
    assert len(seen.trajectory) == 1 and len(every) == 3
    np.testing.assert_array_equal(seen.known_ns, every)


def test_nothing_is_kept_for_a_reader_that_has_it() -> None:
    frames = Frames()
    frames.add()
    frames.page.notice("info", "one")
    assert frames.page.filled
    frames.see()
    assert not frames.page.filled and not frames.page.urgent


@given(seed=st.integers(0, 1000), size=st.sampled_from([0.05, 0.3, 1.0]), shift=st.floats(-500, 500))
def test_thinning_keeps_exactly_one_point_of_every_occupied_voxel(seed: int, size: float, shift: float) -> None:
    points = (np.random.default_rng(seed).normal(0, 2, (500, 3)) + shift).astype(np.float32)
    chosen = one_per_voxel(points, size, seed)
    cells = [tuple(cell) for cell in np.floor(points * np.float32(1 / size)).astype(int)]
    assert len({cells[index] for index in chosen}) == len(chosen) == len(set(cells))
