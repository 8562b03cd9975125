"""Corrections transform odometry into the map."""

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam import lie
from app.slam.map_frame import MapFrame
from app.slam.trajectory import Trajectory

RNG = np.random.default_rng(0)
ODOMETRY = Trajectory(
    np.arange(100) * 100_000_000,
    RNG.normal(0, 100, (100, 3)),
    Rotation.from_rotvec(RNG.normal(size=(100, 3))).as_quat(),
)
KEYFRAMES = np.arange(0, 100, 10)


def test_without_corrections_the_map_frame_is_the_odometry_frame() -> None:
    assert MapFrame().trajectory(ODOMETRY) is ODOMETRY
    np.testing.assert_array_equal(MapFrame().poses(ODOMETRY.poses), ODOMETRY.poses)
    np.testing.assert_array_equal(MapFrame().newest, np.eye(4))


def test_a_keyframe_lies_in_the_trajectory_where_its_pose_is() -> None:
    frame = MapFrame(ODOMETRY.stamps_ns[KEYFRAMES], lie.exp_se3(RNG.normal(0, 0.1, (10, 6))))
    laid = frame.trajectory(ODOMETRY).poses
    np.testing.assert_allclose(laid[KEYFRAMES], frame.poses(ODOMETRY.poses[KEYFRAMES]), atol=1e-9)


def test_later_frames_take_the_last_correction() -> None:
    frame = MapFrame(ODOMETRY.stamps_ns[KEYFRAMES], lie.exp_se3(RNG.normal(0, 0.1, (5, 6))))
    np.testing.assert_allclose(frame.trajectory(ODOMETRY).poses[41:], frame.newest @ ODOMETRY.poses[41:], atol=1e-9)
    np.testing.assert_array_equal(frame.at(7), frame.newest)


def test_a_piece_of_a_trajectory_lies_where_it_does_in_the_whole() -> None:
    frame = MapFrame(ODOMETRY.stamps_ns[KEYFRAMES], lie.exp_se3(RNG.normal(0, 0.1, (10, 6))))
    piece = Trajectory(ODOMETRY.stamps_ns[37:], ODOMETRY.positions[37:], ODOMETRY.quaternions[37:])
    np.testing.assert_array_equal(frame.trajectory(piece).positions, frame.trajectory(ODOMETRY).positions[37:])


def test_frames_on_either_side_of_a_pause_go_with_the_nearest_keyframe() -> None:
    before, after = np.eye(4), lie.transform(np.eye(3), np.array([5.0, 0, 0]))
    frame = MapFrame(ODOMETRY.stamps_ns[[10, 20, 30]], np.stack([before, after, after]), ODOMETRY.stamps_ns[[14]])
    moved = (frame.trajectory(ODOMETRY).positions - ODOMETRY.positions)[:, 0]
    np.testing.assert_allclose(moved[:14], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved[14:], 5.0, atol=1e-9)
    again = frame.over(frame).trajectory(ODOMETRY).positions - ODOMETRY.positions
    np.testing.assert_allclose(again[14:, 0], 10.0, atol=1e-9)


def test_levelling_turns_gravity_down_and_keeps_the_heading() -> None:
    g_map = np.array([0.03, -0.05, -9.8])
    R = MapFrame.levelling(g_map).newest[:3, :3]
    np.testing.assert_allclose(R @ g_map, [0, 0, -np.linalg.norm(g_map)], atol=1e-12)
    assert abs(Rotation.from_matrix(R).as_rotvec()[2]) < 1e-12


def test_a_level_map_stays_as_it_is() -> None:
    assert not len(MapFrame.levelling(np.array([0.0, 0.0, -9.81])).T_map_odom)
