"""States to go back to: where there are some, and how much room they take."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.mapping.checkpoints import DISK_SHARE, EVERY, NEAR, START, Checkpoints
from app.mapping.spill import Spill


def state(frame: int, size: int = 20_000) -> dict[str, object]:
    """About `size` bytes that tell the frame."""
    return {"frame": frame, "map": np.full(size // 4, frame, dtype=np.int32)}


def walk(checkpoints: Checkpoints, frames: int, size: int = 20_000) -> tuple[int, int]:
    """Most bytes in memory and on disk at any frame."""
    memory = disk = 0
    for frame in range(START, frames):
        if checkpoints.wanted(frame):
            checkpoints.add(frame, state(frame, size))
        memory, disk = max(memory, checkpoints.memory), max(disk, checkpoints.disk)
    return memory, disk


@pytest.mark.parametrize("budget", [100_000, 1_000_000, 3_000_000])
def test_ten_thousand_frames_stay_within_the_budget(budget: int) -> None:
    checkpoints = Checkpoints(budget)
    memory, disk = walk(checkpoints, 10_000)
    assert 0.5 * budget < memory <= budget
    assert disk <= DISK_SHARE * budget
    assert checkpoints.frames[0] == START
    checkpoints.close()


def test_they_are_dense_near_the_present_and_nowhere_far_apart() -> None:
    checkpoints = Checkpoints(10_000_000)
    walk(checkpoints, 12_000, size=2_000)
    gaps = np.diff(checkpoints.frames)[1:]  # without that to the start
    assert gaps.max() == 2 * EVERY
    assert set(gaps[-600:]) == {EVERY}, "ten minutes of them"
    assert np.all(np.diff(gaps) <= EVERY), "sparser the farther back"
    checkpoints.close()


def test_those_on_disk_come_back_as_they_were() -> None:
    checkpoints = Checkpoints(100_000)
    walk(checkpoints, 300)
    assert checkpoints.disk > 0
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


def test_nothing_is_left_of_a_future_that_is_forgotten() -> None:
    checkpoints = Checkpoints(100_000)
    walk(checkpoints, 400)
    checkpoints.forget_after(203)
    assert checkpoints.frames[-1] <= 203 and checkpoints.before(10_000) == checkpoints.frames[-1]
    checkpoints.forget_after(START)
    assert checkpoints.frames == [START]
    assert checkpoints.memory + checkpoints.disk < 25_000
    checkpoints.close()


def test_a_budget_smaller_than_one_state_still_leaves_the_start() -> None:
    checkpoints = Checkpoints(1_000)
    walk(checkpoints, 300)
    assert checkpoints.frames[0] == START and checkpoints.memory <= 1_000
    assert checkpoints.before(150) is not None
    checkpoints.close()


def test_the_same_walk_keeps_the_same_frames() -> None:
    kept = []
    for _ in range(2):
        checkpoints = Checkpoints(200_000)
        walk(checkpoints, 2_000)
        kept.append(checkpoints.frames)
        checkpoints.close()
    assert kept[0] == kept[1]


@settings(deadline=None, max_examples=50)
@given(sizes=st.lists(st.integers(0, 30_000), min_size=1, max_size=20), released=st.sets(st.integers(0, 19)))
def test_values_on_disk_never_overlap_and_their_space_is_used_again(sizes: list[int], released: set[int]) -> None:
    spill = Spill()
    values = [bytes([number]) * size for number, size in enumerate(sizes)]
    slots = {number: spill.put(value) for number, value in enumerate(values)}
    end = max(slot.end for slot in slots.values())
    for number in released & slots.keys():
        spill.release(slots[number])
        slots[number] = spill.put(values[number])
    assert max(slot.end for slot in slots.values()) <= end
    for number, slot in slots.items():
        assert spill.get(slot) == values[number]
    assert spill.nbytes == sum(slot.end - slot.begin for slot in slots.values())
    spill.close()
