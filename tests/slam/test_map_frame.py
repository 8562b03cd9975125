"""A walk is laid into the map a piece at a time, and nobody can tell."""

import tracemalloc

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam.loops import se3
from app.slam.loops.corrections import corrected
from app.slam.map_frame import PIECE, MapFrame
from app.slam.trajectory import Trajectory

RNG = np.random.default_rng(0)


def walk(frames: int) -> Trajectory:
    quaternions = Rotation.from_rotvec(RNG.normal(size=(frames, 3))).as_quat()
    return Trajectory(np.arange(frames) * 100_000_000, RNG.normal(0, 100, (frames, 3)), quaternions)


def corrections(odometry: Trajectory, keyframes: int) -> MapFrame:
    stamps = odometry.stamps_ns[np.linspace(0, len(odometry) - 1, keyframes).astype(int)]
    return MapFrame(stamps, se3.exp(RNG.normal(0, 0.1, (keyframes, 6))))


def test_frames_before_and_after_the_end_of_a_piece_lie_where_they_would_in_one() -> None:
    odometry = walk(2 * PIECE + 3)
    frame = corrections(odometry, 300)
    laid = frame.trajectory(odometry)
    T = np.tile(np.eye(4), (len(odometry), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = odometry.rotations.as_matrix(), odometry.positions
    truth = corrected(odometry.stamps_ns, T, frame.stamps_ns, frame.T_map_odom)
    np.testing.assert_array_equal(laid.stamps_ns, odometry.stamps_ns)
    np.testing.assert_array_equal(laid.positions, truth[:, :3, 3])
    np.testing.assert_allclose(laid.rotations.as_matrix(), truth[:, :3, :3], atol=1e-12)


def test_a_long_walk_takes_no_more_memory_for_a_moment_than_it_is_large() -> None:
    odometry = walk(30 * PIECE)
    frame = corrections(odometry, 300)
    frame.trajectory(odometry.since(len(odometry) - 10))
    tracemalloc.start()
    laid = frame.trajectory(odometry)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * (laid.positions.nbytes + laid.quaternions.nbytes)


def test_a_correction_that_is_kept_keeps_no_others() -> None:
    frame = MapFrame(np.arange(50), np.tile(np.eye(4), (50, 1, 1)))
    assert frame.at(3).base is None and frame.newest.base is None
