"""The terms of a keyframe's covariance besides the filter's own covariance."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.slam.certainty import VIEW_M, WRONG_SPEED, Certainty, Doubt
from app.slam.imu import BG, DIM, EXT, EXT_POS, EXT_ROT, POS, POSE, ROT, Belief, mounting_to_pose
from app.slam.params import Params
from app.slam.start import standing
from app.slam.types import ImuSamples, Registration


def belief(x: float = 0.0, yaw: float = 0.0, tilt: float = 0.0, *, exact_mounting: bool = True) -> Belief:
    """After a rest, moved x m along its first heading, turned to the left and pitched, deg."""
    samples = ImuSamples(np.array([0, 5_000_000]), np.zeros((2, 3)), np.tile([0.0, 0.0, 9.81], (2, 1)))
    start = standing(samples, 0, Params())
    P = np.zeros((DIM, DIM))
    P[ROT, ROT], P[POS, POS], P[BG, BG] = 1e-6 * np.eye(3), 1e-4 * np.eye(3), 1e-8 * np.eye(3)
    if not exact_mounting:
        P[EXT_ROT, EXT_ROT], P[EXT_POS, EXT_POS] = 1e-4 * np.eye(3), 1e-4 * np.eye(3)
    R = Rotation.from_euler("zy", [yaw, tilt], degrees=True).as_matrix()
    return Belief(replace(start.state, R_odom_imu=R, p_odom_imu=np.array([x, 0.0, 0.0])), P)


def walked(metres: float, steps: int) -> np.ndarray:
    certainty = Certainty.begin(belief(), refined=False)
    for x in np.linspace(0.0, metres, steps + 1)[1:]:
        certainty = certainty.moved(belief(x))
    return certainty.covariance(belief(metres))


def test_at_the_first_keyframe_the_filter_says_it_all() -> None:
    here = belief(exact_mounting=False)
    np.testing.assert_allclose(Certainty.begin(here, refined=False).covariance(here), here.covariance[:6, :6])


def test_drift_grows_with_the_walk_as_a_random_walk_does() -> None:
    """After two views the map's error is twice the filter's; heading's share moves the end sideways, not ahead."""
    covariance = walked(2 * VIEW_M, 400)
    own = belief().covariance
    assert covariance[2, 2] == pytest.approx(3 * own[2, 2])
    assert covariance[3, 3] == pytest.approx(3 * own[3, 3])
    # integral of the squared lever arm along the walk, for each view
    sideways = own[2, 2] * (2 * VIEW_M) ** 3 / 3 / VIEW_M
    assert covariance[4, 4] == pytest.approx(3 * own[4, 4] + sideways, rel=0.01)


def test_how_finely_a_walk_is_cut_into_keyframes_hardly_matters() -> None:
    np.testing.assert_allclose(walked(50.0, 100), walked(50.0, 200), rtol=0.02, atol=1e-9)


def test_a_rest_adds_no_drift() -> None:
    certainty = Certainty.begin(belief(), refined=False).moved(belief(10.0))
    still = certainty
    for _ in range(1000):
        still = still.moved(belief(10.0))
    np.testing.assert_array_equal(still.drift, certainty.drift)


def test_a_wrong_mounting_leans_to_the_other_side_after_half_a_turn() -> None:
    """Its tilt was levelled out at the start; turned round, it is there twice, while heading stays right."""
    there = belief(yaw=180.0, exact_mounting=False)
    begin = Certainty.begin(belief(exact_mounting=False), refined=False)
    extra = begin.covariance(there) - there.covariance[:6, :6]
    mounting = there.covariance[EXT_ROT, EXT_ROT]
    np.testing.assert_allclose(np.diag(extra)[:3], [4 * mounting[0, 0], 4 * mounting[1, 1], 0.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(extra)[3:], [4e-4, 4e-4, 0.0], atol=1e-12)


@pytest.mark.parametrize("tilt", [10.0, 30.0])
def test_rotation_errors_are_given_in_the_imus_frame(tilt: float) -> None:
    """Heading drift is about the vertical, wherever the IMU's axes point."""
    drift = np.zeros((6, 6))
    drift[2, 2] = 1e-4
    there = belief(tilt=tilt)
    certainty = replace(Certainty.begin(there, refined=False), here=np.zeros(3), drift=drift)
    extra = certainty.covariance(there) - there.covariance[:6, :6]
    up = there.state.R_odom_imu[2]
    np.testing.assert_allclose(extra[:3, :3], 1e-4 * np.outer(up, up), atol=1e-15)


def test_a_mounting_that_is_learnt_leaves_the_first_pose_as_wrong_as_it_was() -> None:
    """The filter's pose becomes right, but it counts from the first one."""
    begin, end = belief(exact_mounting=False), belief(x=1.0)
    follows, P = mounting_to_pose(begin.state), begin.covariance.copy()
    P[POSE, POSE] += follows @ P[EXT, EXT] @ follows.T
    P[POSE, EXT] = follows @ P[EXT, EXT]
    P[EXT, POSE] = P[POSE, EXT].T
    certainty = Certainty.begin(Belief(begin.state, P), refined=True)
    own = begin.covariance[POSE, POSE]
    np.testing.assert_allclose(certainty.covariance(Belief(begin.state, P)), own, atol=1e-12)  # both are as wrong
    np.testing.assert_allclose(certainty.in_map(Belief(begin.state, P)), own, atol=1e-12)
    np.testing.assert_allclose(certainty.covariance(end), own + follows @ P[EXT, EXT] @ follows.T, atol=1e-12)


def scan(*, surprise: float = 0.0, degenerate: bool = False) -> Registration:
    return Registration(True, 2, 500, 400, 0.02, np.ones(6), degenerate, surprise=surprise)


def test_a_contradiction_tells_of_the_time_in_which_scans_left_a_direction_open() -> None:
    doubt = Doubt()
    for _ in range(40):
        doubt = doubt.after(scan(degenerate=True), 0.1)
    for _ in range(10):
        doubt = doubt.after(scan(), 0.1)
    assert doubt.metres == 0.0
    doubt = doubt.after(scan(surprise=9.0), 0.1)
    assert doubt.metres == pytest.approx(WRONG_SPEED * 2.9)
    assert doubt.after(scan(surprise=9.0), 0.1).metres == pytest.approx(doubt.metres)


def test_where_scans_hold_all_directions_a_contradiction_makes_no_doubt_of_the_odometry_before_it() -> None:
    """Else a corridor that looks the same 12 m farther on passed for the right place."""
    doubt = Doubt()
    for _ in range(100):
        doubt = doubt.after(scan(), 0.1)
    assert doubt.after(scan(surprise=9.0), 0.1).metres == 0.0
