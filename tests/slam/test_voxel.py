"""Voxel-grid downsampling compared with a dictionary.

Tests app/slam/kernels/clouds.py.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.slam.voxel import VoxelGrid, spread

GRID = VoxelGrid()


def by_dictionary(points: np.ndarray, size: float, chosen: np.ndarray) -> tuple[list[np.ndarray], list[int]]:
    """Centroids and first indices in order of first appearance."""
    places: dict[object, int] = {}
    members: list[list[int]] = []
    for j, p in enumerate(points.astype(np.float64)):
        key: object = tuple(np.floor(p / size).astype(int)) if chosen[j] else ("alone", j)
        if key not in places:
            places[key] = len(members)
            members.append([])
        members[places[key]].append(j)
    return [points[m].astype(np.float64).mean(axis=0) for m in members], [m[0] for m in members]


@given(
    seed=st.integers(0, 2**32),
    n=st.integers(0, 300),
    size=st.sampled_from([0.05, 0.3, 0.5, 1.0, 5.0]),
    width=st.sampled_from([0.2, 3.0, 80.0]),
    share=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_centroids_are_those_of_a_dictionary(seed: int, n: int, size: float, width: float, share: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=width, size=(n, 3)).astype(np.float32)
    chosen = (rng.random(n) < share).astype(np.uint8) * 2  # any value but zero takes part
    result = GRID.downsample(points, size, chosen)
    centroids, first = by_dictionary(points, size, chosen)
    assert result.source.tolist() == first
    np.testing.assert_allclose(result.points, np.array(centroids).reshape(-1, 3), rtol=1e-6, atol=1e-6 * width)


def test_points_that_do_not_take_part_are_unchanged_to_the_bit() -> None:
    points = np.random.default_rng(0).normal(scale=0.1, size=(500, 3)).astype(np.float32)
    chosen = np.zeros(500, np.uint8)
    chosen[::3] = 1
    result = GRID.downsample(points, 1.0, chosen)
    kept = chosen[result.source] == 0
    np.testing.assert_array_equal(result.points[kept], points[chosen == 0])
    assert np.count_nonzero(~kept) <= 8  # the thinned ones fill the 8 voxels around the origin


def test_without_a_choice_all_points_take_part() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3)).astype(np.float32)
    everything = GRID.downsample(points, 0.7, np.ones(200, np.uint8))
    np.testing.assert_array_equal(GRID.downsample(points, 0.7).points, everything.points)


def test_points_on_either_side_of_zero_are_not_merged() -> None:
    points = np.array([[-0.01, 0, 0], [0.01, 0, 0]], np.float32)
    assert len(GRID.downsample(points, 1.0).points) == 2


def test_thinning_again_leaves_at_most_as_many() -> None:
    points = np.random.default_rng(2).uniform(-5, 5, size=(5000, 3)).astype(np.float32)
    once = GRID.downsample(points, 0.5)
    twice = GRID.downsample(once.points, 0.5)
    np.testing.assert_array_equal(twice.points, once.points)


def test_the_grid_grows_with_the_largest_cloud_and_serves_small_ones_after() -> None:
    grid, fresh = VoxelGrid(), VoxelGrid()
    rng = np.random.default_rng(3)
    big = rng.uniform(-200, 200, size=(150_000, 3)).astype(np.float32)  # nearly a voxel for every point
    small = rng.uniform(-1, 1, size=(100, 3)).astype(np.float32)
    result = grid.downsample(big, 0.5)
    keys = np.unique(np.floor(big.astype(np.float64) / 0.5).astype(np.int64), axis=0)
    assert len(result.points) == len(keys)
    np.testing.assert_array_equal(grid.downsample(small, 0.5).points, fresh.downsample(small, 0.5).points)


def test_results_are_not_overwritten_by_the_next_call() -> None:
    rng = np.random.default_rng(4)
    first = GRID.downsample(rng.normal(size=(50, 3)).astype(np.float32), 0.5)
    points, source = first.points.copy(), first.source.copy()
    GRID.downsample(rng.normal(size=(60, 3)).astype(np.float32), 0.5)
    np.testing.assert_array_equal(first.points, points)
    np.testing.assert_array_equal(first.source, source)


def test_no_points_give_no_points() -> None:
    result = GRID.downsample(np.empty((0, 3), np.float32), 0.5)
    assert result.points.shape == (0, 3)
    assert len(result.source) == 0


def hall() -> np.ndarray:
    """(n, 3) voxels that a floor and two walls go through, in no order."""
    floor = [(x, y, 0) for x in range(60) for y in range(60)]
    walls = [(x, 0, z) for x in range(60) for z in range(1, 20)] + [
        (0, y, z) for y in range(1, 60) for z in range(1, 20)
    ]
    rng = np.random.default_rng(7)
    return rng.permutation(np.array(floor + walls)) - 30


def in_voxels(cells: np.ndarray, seed: int) -> np.ndarray:
    return ((cells + np.random.default_rng(seed).uniform(0.05, 0.95, cells.shape)) * 0.4).astype(np.float32)


@given(seed=st.integers(0, 2**32), most=st.integers(1, 6000), gone=st.integers(0, 20))
def test_a_point_more_or_less_and_noise_leave_the_choice_of_all_others(seed: int, most: int, gone: int) -> None:
    cells = hall()
    all_chosen = spread(in_voxels(cells, seed), most, 0.4)
    assert len(all_chosen) == min(most, len(cells))
    left = np.delete(cells, np.random.default_rng(seed).choice(len(cells), gone, replace=False), axis=0)
    chosen = spread(in_voxels(left, seed + 1), most, 0.4)
    before, after = ({tuple(cell) for cell in np.floor(points / 0.4)} for points in (all_chosen, chosen))
    assert len(before - after) <= gone
    assert len(after - before) <= gone


@pytest.mark.parametrize("most", [300, 600, 1000, 2000, 4000])
def test_what_is_chosen_is_even_over_every_surface(most: int) -> None:
    cells = hall()
    share = most / len(cells)
    chosen = np.floor(spread(in_voxels(cells, 0), most, 0.4) / 0.4) + 30
    by_chance = np.sqrt(share * (1.0 - share) * 100)
    for flat, across in ((2, (0, 1)), (1, (0, 2)), (0, (1, 2))):
        surface = chosen[chosen[:, flat] == 0][:, across]
        sides = [60 if axis < 2 else 20 for axis in across]
        squares, *_ = np.histogram2d(
            *surface.T, bins=[side // 10 for side in sides], range=[[0, side] for side in sides]
        )
        assert np.std(squares) < 0.7 * by_chance  # of squares of 4 m


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("share", [0.05, 0.1, 0.2, 0.4])
def test_along_a_line_none_is_long_without_a_point(axis: int, share: float) -> None:
    line = np.zeros((2000, 3))
    line[:, axis] = np.arange(2000) - 1000
    chosen = np.floor(spread(in_voxels(line, 0), round(share * 2000), 0.4) / 0.4)
    assert np.diff(chosen[:, axis]).max() < 3.0 / share  # by chance it would be over 5 somewhere


def test_what_is_chosen_keeps_its_order() -> None:
    points = in_voxels(hall(), 0)
    places = {tuple(point): index for index, point in enumerate(points)}
    order = [places[tuple(point)] for point in spread(points, 1000, 0.4)]
    assert order == sorted(order)


def test_few_points_are_all_chosen() -> None:
    points = in_voxels(hall(), 0)
    assert spread(points, len(points), 0.4) is points
