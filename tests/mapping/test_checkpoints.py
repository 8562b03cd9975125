"""Checkpoints: at which frames they are kept, and how much space they take."""

import numpy as np
import pytest

from app.mapping.checkpoints import DENSE, DISK_SHARE, EVERY, NEAR, START, Checkpoints


def state(frame: int, size: int = 20_000) -> dict[str, object]:
    """About `size` bytes that tell the frame."""
    return {"frame": frame, "map": np.full(size // 4, frame, dtype=np.int32)}


def walk(checkpoints: Checkpoints, frames: int, size: int = 20_000) -> int:
    """Most bytes at any frame."""
    most = 0
    for frame in range(START, frames):
        if checkpoints.wanted(frame):
            checkpoints.add(frame, state(frame, size))
        most = max(most, checkpoints.nbytes)
    return most


@pytest.mark.parametrize("budget", [100_000, 1_000_000, 3_000_000])
def test_ten_thousand_frames_stay_within_the_budget(budget: int) -> None:
    checkpoints = Checkpoints(budget)
    most = walk(checkpoints, 10_000)
    assert DISK_SHARE * budget / 3 < most <= DISK_SHARE * budget
    assert checkpoints.frames[0] == START
    checkpoints.close()


def test_they_are_dense_near_the_present_and_nowhere_far_apart() -> None:
    checkpoints = Checkpoints(10_000_000)
    walk(checkpoints, DENSE + 4_000, size=2_000)
    gaps = np.diff(checkpoints.frames)[1:]  # without that to the start
    assert gaps.max() == 2 * EVERY
    assert set(gaps[-600:]) == {EVERY}, "ten minutes of them"
    assert np.all(np.diff(gaps) <= EVERY), "sparser the farther back"
    checkpoints.close()


def test_those_on_disk_come_back_as_they_were() -> None:
    checkpoints = Checkpoints(100_000)
    walk(checkpoints, 300)
    assert checkpoints.nbytes > 100_000
    for frame in checkpoints.frames:
        found = checkpoints.get(frame)
        expected = state(frame)
        assert isinstance(found, dict) and found["frame"] == frame
        assert np.array_equal(found["map"], expected["map"])  # type: ignore[arg-type]
    checkpoints.close()


def test_before_a_sought_frame_there_is_one_after_every_frame_until_one_goes_elsewhere() -> None:
    checkpoints = Checkpoints(10_000_000)
    walk(checkpoints, 1_000)
    for frame in range(500, 520):
        if checkpoints.wanted(frame, near=True):
            checkpoints.add(frame, state(frame))
    assert {*range(500, 520)} <= {*checkpoints.frames}
    assert checkpoints.before(509) == 508
    checkpoints.add(509 + 2 * NEAR, state(509 + 2 * NEAR))
    assert checkpoints.before(509) == 500
    checkpoints.close()


def test_nothing_is_left_of_those_that_are_dropped() -> None:
    checkpoints = Checkpoints(100_000)
    walk(checkpoints, 400)
    checkpoints.drop([frame for frame in checkpoints.frames if frame > 203])
    assert checkpoints.frames[-1] <= 203 and checkpoints.before(10_000) == checkpoints.frames[-1]
    checkpoints.drop(checkpoints.frames[1:])
    assert checkpoints.frames == [START]
    assert checkpoints.nbytes < 25_000
    checkpoints.close()


def test_a_budget_smaller_than_one_state_still_leaves_a_few() -> None:
    checkpoints = Checkpoints(1_000)
    walk(checkpoints, 300)
    assert checkpoints.frames[0] == START and len(checkpoints.frames) < 10
    assert checkpoints.before(150) is not None
    checkpoints.close()


def test_a_state_that_the_disk_does_not_take_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    checkpoints = Checkpoints()
    checkpoints.add(START, state(START))
    checkpoints._states.execute("PRAGMA max_page_count = 4")
    checkpoints.add(10, state(10, 1_000_000))
    assert checkpoints.frames == [START] and "frame 10 cannot be kept" in caplog.text
    assert checkpoints.get(START) is not None
    checkpoints.close()


def test_the_same_walk_keeps_the_same_frames() -> None:
    kept = []
    for _ in range(2):
        checkpoints = Checkpoints(200_000)
        walk(checkpoints, 2_000)
        kept.append(checkpoints.frames)
        checkpoints.close()
    assert kept[0] == kept[1]
