"""A submap consists of its keyframes' clouds: each is thinned and placed by odometry, then all are thinned together."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.slam.loops.submap import Submaps
from app.slam.types import F32, F64, Cloud, Keyframe
from app.slam.voxel import VoxelGrid

VOXEL, RADIUS, FAR = 0.25, 20.0, 40.0


def keyframe(index: int, points: F32, T_odom_imu: F64) -> Keyframe:
    n = len(points)
    cloud = Cloud(points, np.zeros(n, np.uint8), np.zeros(n, np.float32), np.zeros(n, np.uint16), np.zeros(n, np.int32))
    return Keyframe(index, index, index, T_odom_imu, np.eye(4), np.eye(6), cloud)


def walk(count: int) -> F64:
    """(count, 4, 4), a step of half a metre each."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 0.5 * np.arange(count)
    return poses


def cloud_of(count: int, seed: int) -> F32:
    return np.random.default_rng(seed).uniform(-8, 8, (count, 3)).astype(np.float32)


def one_by_one(clouds: list[F32], poses: F64, index: int) -> tuple[F32, F32]:
    """Points and eyes of the submap of all clouds about a keyframe, each cloud by itself."""
    grid, points, eyes = VoxelGrid(), [], []
    for cloud, T in zip(clouds, poses, strict=True):
        eye = (T[:3, 3] - poses[index, :3, 3]).astype(np.float32)
        thin = grid.downsample(cloud, VOXEL).points + eye
        points.append(thin[np.linalg.norm(thin, axis=1) < RADIUS])
        eyes.append(np.tile(eye, (len(points[-1]), 1)))
    both = grid.downsample(np.concatenate(points), VOXEL)
    return both.points, np.concatenate(eyes)[both.source]


@pytest.fixture
def submaps() -> Iterator[Submaps]:
    made = Submaps(VOXEL, RADIUS, FAR)
    yield made
    made.close()


@settings(deadline=None, max_examples=40)
@given(sizes=st.lists(st.sampled_from([0, 0, 1, 40, 700]), min_size=1, max_size=8))
def test_a_submap_is_that_of_its_clouds_one_by_one(sizes: list[int]) -> None:
    made = Submaps(VOXEL, RADIUS, FAR)
    poses, clouds = walk(len(sizes)), [cloud_of(size, seed) for seed, size in enumerate(sizes)]
    for index, (cloud, T) in enumerate(zip(clouds, poses, strict=True)):
        made.append(keyframe(index, cloud, T))
    for index in {0, len(sizes) // 2, len(sizes) - 1}:
        got = made.around(index, poses, 0, len(sizes) - 1)
        points, eyes = one_by_one(clouds, poses, index)
        assert np.array_equal(got.points, points) and np.array_equal(got.eyes, eyes)
    made.close()


def test_what_was_made_stays_as_it_is_when_others_are(submaps: Submaps) -> None:
    poses = walk(6)
    for index in range(6):
        submaps.append(keyframe(index, cloud_of(500, index), poses[index]))
    first = submaps.around(1, poses, 0, 2)
    copy = replace(first, points=first.points.copy(), eyes=first.eyes.copy())
    submaps.around(4, poses, 3, 5)
    assert np.array_equal(first.points, copy.points) and np.array_equal(first.eyes, copy.eyes)


def test_clouds_that_take_the_place_of_forgotten_ones_are_read_as_they_are(submaps: Submaps) -> None:
    poses = walk(4)
    clouds = [cloud_of(size, seed) for seed, size in enumerate((300, 900, 900, 900))]
    for index, cloud in enumerate(clouds):
        submaps.append(keyframe(index, cloud, poses[index]))
    submaps.truncate(2)
    clouds[2:] = [cloud_of(60, 7), cloud_of(200, 8)]
    for index in (2, 3):
        submaps.append(keyframe(index, clouds[index], poses[index]))
    got = submaps.around(2, poses, 0, 3)
    points, eyes = one_by_one(clouds, poses, 2)
    assert np.array_equal(got.points, points) and np.array_equal(got.eyes, eyes)


def test_what_is_far_is_in_far_submaps_only(submaps: Submaps) -> None:
    near, far = np.float32([[5.0, 0.0, 0.0]]), np.float32([[0.0, 35.0, 0.0]])
    submaps.append(keyframe(0, np.concatenate([near, far, np.float32([[50.0, 0.0, 0.0]])]), np.eye(4)))
    assert np.array_equal(submaps.around(0, walk(1), 0, 0).points, near)
    wide = submaps.around(0, walk(1), 0, 0, far=True)
    assert {tuple(point) for point in wide.points} == {(5.0, 0.0, 0.0), (0.0, 35.0, 0.0)}
    assert wide.reach == FAR
