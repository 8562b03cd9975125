"""A run that cannot be right reports doubts; a plausible run reports none."""

from collections.abc import Sequence

import numpy as np
import pytest

from app.slam.doubts import doubts
from app.slam.frames import READOUTS, Frame
from app.slam.run_log import RunLog
from app.slam.types import F64, FrameStatus

WALK = np.column_stack([0.12 * np.arange(200), 0.1 * np.sin(np.arange(200)), np.zeros(200)])
"""(200, 3) m at 10 Hz: a walk at 1.2 m/s that sways."""


def log(positions: F64, statuses: Sequence[FrameStatus] = (), dropped: int = 0, **readouts: float) -> RunLog:
    nothing = np.array([{"accel_bias": 0.0, **readouts}.get(name, np.nan) for name in READOUTS])
    frames = [Frame(n * 100_000_000, False, p, np.array([0.0, 0, 0, 1]), nothing) for n, p in enumerate(positions)]
    for n, status in enumerate(statuses):
        object.__setattr__(frames[n], "status", status)
    return RunLog(frames, ("it was dark",) * dropped)


def test_a_walk_a_rest_and_nothing_at_all_raise_no_doubt() -> None:
    for positions in (WALK, 0 * WALK, WALK[:2], WALK[:0], np.repeat(WALK, 3, axis=0) * 2):
        assert doubts(log(positions)) == ()


def test_one_leap_is_reported_with_its_size_and_time() -> None:
    moved = WALK.copy()
    moved[120:] += [0.0, 0.7, 0.0]
    (doubt,) = doubts(log(moved))
    assert "leaps by up to 0.8 m" in doubt and "first at 12.0 s" in doubt


def test_missing_scans_are_no_leaps() -> None:
    kept = np.random.default_rng(0).random(len(WALK)) > 0.5
    frames = [frame for frame, keep in zip(log(WALK).frames, kept, strict=True) if keep]
    assert np.diff([frame.position[0] for frame in frames]).max() > 0.5
    assert doubts(RunLog(frames)) == ()


def test_no_person_moves_at_a_hundred_metres_a_second() -> None:
    (doubt,) = doubts(log(WALK * [100, 1, 1]))
    assert "120 m/s, first at 0.1 s" in doubt


def test_a_zigzag_that_no_hand_makes_is_reported() -> None:
    (doubt,) = doubts(log(np.where(np.arange(200) % 2, 1.0, 0.0)[:, None] * [0.6, 0, 0]))
    assert "accelerated by up to 120 m/s²" in doubt


@pytest.mark.parametrize(("lost", "told"), [(10, False), (100, True)])
def test_a_walk_that_is_mostly_lost_is_reported(lost: int, told: bool) -> None:
    found = doubts(log(WALK, [FrameStatus.LOST] * lost))
    assert found == ((f"Tracking was lost in {lost} of 200 frames, first at 0.0 s.",) if told else ())


@pytest.mark.parametrize(("gap_s", "told"), [(0.005, False), (12.0, True)])
def test_a_few_frames_in_which_neither_sensor_shows_the_motion_are_reported(gap_s: float, told: bool) -> None:
    found = doubts(log(WALK, [FrameStatus.TRACKING] * 20 + [FrameStatus.LOST] * 10, imu_gap_s=gap_s))
    assert bool(found) is told and all("In 10 frames the IMU is silent" in doubt for doubt in found)
    assert all("first at 2.0 s" in doubt for doubt in found)


@pytest.mark.parametrize(("imu_gap_s", "told"), [(0.005, False), (2.0, True), (0.0, True)])
def test_a_recorder_that_was_paused_is_reported_if_the_imu_does_not_tell_the_way_either(
    imu_gap_s: float, told: bool
) -> None:
    whole = log(WALK, imu_gap_s=imu_gap_s)
    paused = RunLog([*whole.frames[:50], *whole.frames[70:]])
    assert doubts(whole) == ()
    assert len(found := doubts(paused)) == told
    assert all("neither scans nor IMU samples for 2.1 s, first at 4.9 s;" in doubt for doubt in found)
    assert not doubts(paused, paused.stamps_ns[50:51] - 10_000_000), "a loop ties it"
    assert doubts(paused, paused.stamps_ns[49:50] - 10_000_000) == found, "that is no loop across it"


def test_a_walk_of_which_most_scans_were_dropped_is_reported() -> None:
    (doubt,) = doubts(log(WALK, dropped=300))
    assert doubt == "300 of 500 scans were dropped, mostly because it was dark."


def test_poses_that_are_not_finite_are_reported() -> None:
    broken = WALK.copy()
    broken[50, 2] = np.nan
    assert doubts(log(broken)) == ("1 poses are not finite, first at 5.0 s.",)


def test_scans_that_contradict_the_imu_in_every_frame_are_reported() -> None:
    assert doubts(log(WALK, predicted_change=0.25, correction=0.01)) == ()
    (doubt,) = doubts(log(WALK, predicted_change=0.25, correction=0.06))
    assert "they take 24% back" in doubt


def test_a_cart_that_hardly_changes_its_velocity_raises_no_doubt() -> None:
    assert doubts(log(WALK, predicted_change=0.004, correction=0.003)) == ()


def test_scans_that_contradict_the_predicted_motion_in_a_few_frames_are_reported() -> None:
    assert doubts(log(WALK, surprise=2.7)) == ()
    calm, surprised = (log(WALK, surprise=value).frames for value in (0.5, 9.0))
    assert doubts(RunLog([*calm[:50], *surprised[50:52], *calm[52:]])) == ()
    (doubt,) = doubts(RunLog([*calm[:50], *surprised[50:59], *calm[59:]]))
    assert "In 9 frames the scan and the IMU contradict each other about the motion, first at 5.0 s." in doubt


@pytest.mark.parametrize(("late", "told"), [(0.006, ""), (0.053, "53 ms late"), (-0.02, "20 ms early")])
def test_a_clock_that_is_far_off_is_reported_though_it_was_corrected(late: float, told: str) -> None:
    found = doubts(log(WALK, clock_late_s=late))
    assert len(found) == bool(told) and all(told in doubt and "hemislam calibrate" in doubt for doubt in found)


def test_a_position_that_the_filter_itself_does_not_know_is_reported() -> None:
    sure, unsure = (log(WALK, position_sigma=value, imu_gap_s=0.005).frames for value in (0.03, 0.44))
    assert doubts(RunLog([*sure[:50], *unsure[50:52], *sure[52:]])) == ()
    (doubt,) = doubts(RunLog([*sure[:50], *unsure[50:59], *sure[59:]]))
    assert "In 9 frames the scans leave a direction unobserved, first at 5.0 s" in doubt and "up to 0.4 m" in doubt
