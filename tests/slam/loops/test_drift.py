from dataclasses import replace

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.drift import PAUSE_M, PAUSE_TILT, PAUSE_TURN, POSITION_M, ROTATION, Drift, expect
from app.slam.loops.types import Evidence, LoopEdge, Verdict
from app.slam.types import F64

DRIFT = Drift(0.01, 0.002, np.radians(0.02))


def path(points: F64) -> F64:
    """(k, 4, 4) poses along (k, 2) points, without turning."""
    return np.array([lie.transform(np.eye(3), np.array([x, y, 0.0])) for x, y in points])


def square(side: float = 10.0, step: float = 0.5) -> F64:
    s = np.arange(0.0, side, step)
    zero, full = np.zeros_like(s), np.full_like(s, side)
    return np.vstack([np.c_[s, zero], np.c_[full, s], np.c_[side - s, full], np.c_[zero, side - s], [[0.0, 0.0]]])


def loop(older: int, newer: int, poses: F64, off: tuple[float, float, float] = (0, 0, 0)) -> LoopEdge:
    T = lie.inverse(poses[older]) @ poses[newer]
    T[:3, 3] += off
    return LoopEdge(older, newer, newer, T, np.eye(6) * 1e-4, Evidence(), Verdict.ACCEPTED, "")


def test_doubt_grows_with_the_way_not_with_the_distance() -> None:
    expectation = expect(80, path(square()), [], DRIFT)
    np.testing.assert_allclose(expectation.way, np.arange(80, -1, -1) * 0.5, atol=1e-3)
    assert expectation.position_sigmas()[0] > 0.4 > expectation.position_sigmas()[60]


def test_where_odometry_may_have_gone_astray_all_before_is_in_doubt() -> None:
    points = square()
    astray = 2.0 * (np.arange(len(points)) == 40)
    sigmas = expect(80, path(points), [], DRIFT, astray=astray).position_sigmas()
    assert (sigmas[40:] < 0.5).all() and (sigmas[:40] > 2.0).all()


def test_the_lever_arm_is_what_a_steady_turn_does_to_the_end_of_the_walk() -> None:
    """Against walking the square again with a small steady turn."""
    poses, rate = path(square()), 1e-5
    expectation = expect(80, poses, [], Drift(1e-9, 1e-9, rate))
    steps = np.diff(square(), axis=0)
    turned = np.cumsum(np.linalg.norm(steps, axis=1)) * rate - 0.25 * rate
    rotated = np.c_[steps[:, 0] - turned * steps[:, 1], steps[:, 1] + turned * steps[:, 0]]
    moved = rotated.sum(axis=0) - steps.sum(axis=0)
    covariance = expectation.covariance(0)[3:5, 3:5] - POSITION_M**2 * np.eye(2)
    np.testing.assert_allclose(covariance, np.outer(moved, moved), rtol=0.01, atol=1e-12)
    heading = expectation.covariance(0)[2, 2] - ROTATION**2
    assert np.sqrt(heading) == pytest.approx(40 * rate, rel=0.01)


def test_across_a_pause_the_heading_is_unknown_and_turns_all_that_follows() -> None:
    """Against turning what was walked after the pause, half of the square, about where it happened."""
    points = square()
    resumed = np.arange(len(points)) == 40
    expectation = expect(80, path(points), [], Drift(1e-9, 1e-9, 1e-9), resumed)
    arm = points[80] - points[40]
    moved = PAUSE_TURN * np.array([-arm[1], arm[0]])
    near, far = expectation.covariance(60), expectation.covariance(0)
    np.testing.assert_allclose(far[3:5, 3:5] - POSITION_M**2 * np.eye(2), np.outer(moved, moved), rtol=0.05, atol=1e-2)
    assert np.sqrt(far[2, 2]) == pytest.approx(np.sqrt(PAUSE_TURN**2 + PAUSE_TILT**2 + ROTATION**2))
    assert np.sqrt(near[2, 2]) == pytest.approx(ROTATION), "nothing happened since"
    assert expectation.way[0] == pytest.approx(40 + PAUSE_M, abs=0.1)


def test_a_loop_is_a_short_cut_and_one_that_is_not_met_a_longer_one() -> None:
    poses = path(square())
    met = expect(78, poses, [loop(2, 80, poses)], DRIFT)
    assert met.way[0] == pytest.approx(2.0, abs=0.01)
    missed = expect(78, poses, [loop(2, 80, poses, (0.15, 0.0, 0.0))], DRIFT)
    assert missed.way[0] == pytest.approx(2.0 + (0.15 - POSITION_M) / DRIFT.translation, abs=0.01)


def test_a_loop_across_a_pause_stands_in_for_the_step_between_its_ends() -> None:
    """As a loop made by hand does; what is known before the pause is then as sure as what came after it."""
    poses, resumed = path(square()), np.arange(81) == 60
    apart = expect(80, poses, [], DRIFT, resumed)
    tied = expect(80, poses, [loop(59, 60, poses)], DRIFT, resumed)
    without = expect(80, poses, [], DRIFT)
    assert apart.way[0] > PAUSE_M and apart.pauses[0] == 1
    assert tied.way[0] == pytest.approx(without.way[0] - 0.5, abs=1e-3) and tied.pauses[0] == 0


def test_what_odometry_expects_is_no_deviation_and_a_sigma_off_is_one() -> None:
    poses = path(square())
    expectation = expect(80, poses, [], DRIFT)
    exact = lie.inverse(poses[0]) @ poses[80]
    assert expectation.deviation(0, exact) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    lower = exact.copy()
    sigma = np.hypot(DRIFT.height * 40.0, POSITION_M)
    lower[2, 3] -= sigma
    assert expectation.deviation(0, lower) == pytest.approx((1.0, 1.0, -sigma), rel=1e-3)
    tilted = lie.transform(lie.exp(np.array([2 * ROTATION, 0.0, 0.0])), np.zeros(3)) @ exact
    assert expectation.deviation(0, tilted) == pytest.approx((2.0, 0.0, 0.0), rel=1e-3, abs=1e-9)


def test_gravity_knows_the_height_better_than_the_place() -> None:
    poses = path(square())
    expectation = expect(80, poses, [], replace(DRIFT, rotation=0.0))
    exact = lie.inverse(poses[0]) @ poses[80]
    beside, above = exact.copy(), exact.copy()
    beside[0, 3] += 0.5
    above[2, 3] += 0.5
    assert expectation.deviation(0, beside).sigmas == pytest.approx(0.5 / np.hypot(0.4, POSITION_M), rel=1e-3)
    assert expectation.deviation(0, above).sigmas == pytest.approx(0.5 / np.hypot(0.08, POSITION_M), rel=1e-3)


def test_a_loop_that_leaves_a_direction_open_is_no_short_cut() -> None:
    poses = path(square())
    across = replace(loop(2, 80, poses), covariance=np.diag([1e-4] * 3 + [100.0, 1e-4, 1e-4]))
    assert across.open
    np.testing.assert_array_equal(expect(78, poses, [across], DRIFT).way, expect(78, poses, [], DRIFT).way)
