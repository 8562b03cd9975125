"""The content of the local map compared with a dictionary, and the limits of its memory.

Tests app/slam/kernels/map.py, app/slam/sections.py.
"""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from app.slam.kernels.map import MOST_HITS
from app.slam.local_map import LocalMap, MapState
from app.slam.sections import MapParams

from .local_maps import HERE, LOOSE, SMALL, equal, filled, stored, surface


# --- insertion -----------------------------------------------------------------------------------
def by_dictionary(points: np.ndarray, p: MapParams) -> dict[tuple[int, ...], list[list[np.ndarray]]]:
    """The hits of each stored point, voxel by voxel."""
    voxels: dict[tuple[int, ...], list[list[np.ndarray]]] = {}
    for point in points:
        inside = voxels.setdefault(tuple(np.floor(point.astype(float) / p.voxel_size).astype(int)), [])
        squares = [np.sum((np.mean(hits[:MOST_HITS], axis=0) - point) ** 2) for hits in inside]
        if squares and min(squares) < p.spacing**2:
            inside[int(np.argmin(squares))].append(point)
        elif len(inside) < p.points_per_voxel:
            inside.append([point])
    return voxels


@given(
    seed=st.integers(0, 2**32),
    voxel=st.sampled_from([0.5, 1.0, 2.0]),
    spacing=st.sampled_from([0.0, 0.1, 0.3]),
    room=st.sampled_from([1, 5, 40]),
)
def test_what_is_stored_is_what_a_dictionary_stores(seed: int, voxel: float, spacing: float, room: int) -> None:
    params = MapParams(voxel_size=voxel, spacing=spacing, points_per_voxel=room, max_voxels=5000)
    points = np.random.default_rng(seed).normal(scale=1.5, size=(300, 3)).astype(np.float32)
    state = filled(points, params).checkpoint()
    expected = by_dictionary(points, params)
    assert {tuple(cell) for cell in state.cells.tolist()} == set(expected)
    voxels = np.split(state.points, np.cumsum(state.counts)[:-1])
    for cell, stored_there in zip(state.cells.tolist(), voxels, strict=True):
        means = [np.mean(hits[:MOST_HITS], axis=0) for hits in expected[tuple(cell)]]
        np.testing.assert_allclose(stored_there[:, :3], means, atol=1e-5)
        assert stored_there[:, 3].tolist() == [min(len(hits), MOST_HITS) for hits in expected[tuple(cell)]]


def test_standing_still_piles_up_nothing() -> None:
    points = surface(1)
    local_map = filled(points)
    before = len(stored(local_map))
    rng = np.random.default_rng(2)
    for _ in range(20):
        local_map.insert((points + rng.normal(scale=0.003, size=points.shape)).astype(np.float32), HERE, SMALL)
    assert len(stored(local_map)) < 1.3 * before


# --- bounds --------------------------------------------------------------------------------------
def size_of(local_map: LocalMap) -> int:
    """Bytes of everything the map holds on to."""
    return sum(v.nbytes for v in vars(local_map).values() if isinstance(v, np.ndarray))


def test_far_voxels_are_dropped_and_near_ones_stay_as_they_are() -> None:
    params = MapParams(radius=10.0, max_voxels=5000)
    rng = np.random.default_rng(0)
    local_map = LocalMap(params)
    ahead = surface(1, at=20.0)
    local_map.insert(surface(1).astype(np.float32), HERE, params)
    local_map.insert(ahead.astype(np.float32), HERE, params)
    queries = ahead[rng.integers(0, len(ahead), 200)]
    before = local_map.planes(queries, HERE, LOOSE)[0]
    local_map.insert(np.empty((0, 3), np.float32), np.array([21.0, 0, 0]), params)
    after = local_map.planes(queries, HERE, LOOSE)[0]
    assert equal(after, before)
    assert np.any(after.variances >= 0)
    reach = np.linalg.norm(stored(local_map) - [21.0, 0, 0], axis=1)
    assert reach.max() < 10.0 + np.sqrt(3) / 2 * params.voxel_size
    assert np.all(local_map.planes(surface(2, 100), HERE, LOOSE)[0].variances < 0)


def test_a_walk_of_a_kilometre_needs_no_more_memory_than_its_first_metres() -> None:
    params = MapParams(radius=20.0, max_voxels=3000)
    local_map, sizes, voxels = LocalMap(params), [], []
    rng = np.random.default_rng(0)
    for x in np.arange(0.0, 1000.0, 1.0):
        tunnel = np.column_stack([rng.uniform(x - 15, x + 15, 300), rng.choice([-2, 2], 300), rng.uniform(-2, 2, 300)])
        local_map.insert(tunnel.astype(np.float32), np.array([x, 0, 0]), params)
        sizes.append(size_of(local_map))
        voxels.append(local_map.voxels)
    assert len(set(sizes)) == 1
    assert max(voxels[100:]) <= 1.1 * max(voxels[40:100])
    assert max(voxels) < 3000


def test_a_full_map_keeps_what_is_near() -> None:
    """A wide plain with more voxels than there is room for."""
    params = MapParams(voxel_size=0.5, radius=200.0, max_voxels=2000)
    local_map, rng = LocalMap(params), np.random.default_rng(0)
    for x in np.arange(0.0, 60.0, 2.0):
        plain = np.column_stack([x + rng.uniform(-40, 40, 16000), rng.uniform(-40, 40, 16000), np.full(16000, -1.3)])
        local_map.insert(plain.astype(np.float32), np.array([x, 0, 0]), params)
        assert local_map.voxels <= params.max_voxels
        at = np.column_stack([x + rng.uniform(-5, 5, 100), rng.uniform(-5, 5, 100), np.full(100, -1.3)])
        distance, _ = cKDTree(stored(local_map)).query(at)
        assert np.quantile(distance, 0.9) < 0.7, x


def test_a_scan_that_fills_the_map_hits_each_point_once() -> None:
    params = MapParams(max_voxels=1000, radius=100.0)
    points = np.random.default_rng(0).uniform(-12, 12, (6000, 3))
    full, roomy = (filled(points, params.model_copy(update={"max_voxels": most})) for most in (1000, 100_000))
    assert 900 < full.voxels <= 1000 < roomy.voxels
    hits = [local_map.checkpoint().points[:, 3] for local_map in (full, roomy)]
    assert hits[0].max() <= hits[1].max() and hits[0].mean() < 1.1


def test_lookups_end_even_if_the_map_is_full_to_the_last_voxel() -> None:
    params = MapParams(voxel_size=0.1, max_voxels=1000, radius=500.0)
    cells = np.stack(np.meshgrid(*[np.arange(10)] * 3), axis=-1).reshape(-1, 3) * 0.1 + 0.05
    local_map = filled(cells, params)
    assert local_map.voxels == 1000
    planes = local_map.planes(cells + 1.0, HERE, LOOSE)[0]
    assert len(planes.variances) == 1000


# --- checkpoints ---------------------------------------------------------------------------------
def same(a: MapState, b: MapState) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(MapState))


def walked(local_map: LocalMap, begin: int, end: int, params: MapParams) -> LocalMap:
    for k in range(begin, end):
        local_map.insert(surface(k, 500, at=2.0 * k).astype(np.float32), np.array([2.0 * k, 0, 0]), params)
    return local_map


@pytest.mark.parametrize("fresh", [False, True], ids=["the same map", "another map"])
def test_a_restored_map_goes_on_to_the_same_bytes(fresh: bool) -> None:
    params = MapParams(radius=12.0, max_voxels=2000)
    local_map = walked(LocalMap(params), 0, 10, params)
    checkpoint = local_map.checkpoint()
    copy = MapState(**{f.name: getattr(checkpoint, f.name).copy() for f in fields(MapState)})
    expected = walked(local_map, 10, 25, params).checkpoint()
    assert same(checkpoint, copy), "a checkpoint must not change with the map it was taken from"

    other = LocalMap(params) if fresh else local_map
    other.restore(checkpoint)
    queries = surface(9, 300, at=18.0)
    restored = other.planes(queries, HERE, LOOSE)[0]
    assert same(walked(other, 10, 25, params).checkpoint(), expected)
    assert same(checkpoint, copy)
    local_map.restore(checkpoint)
    assert equal(local_map.planes(queries, HERE, LOOSE)[0], restored)


def test_a_checkpoint_of_an_empty_map_empties_the_map() -> None:
    empty = LocalMap(SMALL).checkpoint()
    local_map = filled(surface(0))
    local_map.restore(empty)
    assert local_map.voxels == 0
    assert np.all(local_map.planes(surface(0, 50), HERE, LOOSE)[0].variances < 0)
    local_map.insert(surface(0).astype(np.float32), HERE, SMALL)
    assert same(local_map.checkpoint(), filled(surface(0)).checkpoint())
