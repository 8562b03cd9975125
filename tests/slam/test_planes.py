"""Planes of the local map compared with brute force.

Tests app/slam/kernels/map.py, app/slam/local_map.py.
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.slam.kernels.map import BINS, LEAST_SCATTER, MOST, OLD, PLANE_FREEDOM, SHARED, SURE_TILT
from app.slam.local_map import RELAXED, LocalMap
from app.slam.sections import FilterParams, MapParams

from .local_maps import HERE, LOOSE, SMALL, equal, filled, stored, surface


def expected_plane(
    query: np.ndarray, near: np.ndarray, hits: np.ndarray, p: FilterParams, reach: float
) -> tuple[np.ndarray, np.ndarray, float] | str | None:
    """Normal, centre and a point's variance by numpy, from neighbours (n, 3) and their hits (n,), sorted exactly; None:
    no plane.

    "ambiguous" where the map's ranking in bins of squared distance may take others than the nearest,
    or where a decision hangs on the last digits.
    """
    squares = np.sum((near - query) ** 2, axis=1)
    order = np.argsort(squares)
    near, hits, bins = near[order], hits[order], (squares[order] * (BINS / reach**2)).astype(int)
    n = min(len(near), MOST)
    k = p.neighbours
    while k <= n:
        if k < len(near) and bins[k] == bins[k - 1]:
            return "ambiguous"
        patch = near[:k]
        values, vectors = np.linalg.eigh(np.cov(patch.T, bias=True))
        scatter = np.sum(((patch - patch.mean(axis=0)) @ vectors[:, 0]) ** 2) / (k - PLANE_FREEDOM)
        least = np.mean((LEAST_SCATTER * p.point_noise) ** 2 / hits[:k])
        certain = max(scatter, least) / (np.radians(p.plane_tilt) ** 2 * k * values[1])
        if abs(certain - 1) < 1e-3:
            return "ambiguous"
        if certain < 1:
            off = np.abs((patch - patch.mean(axis=0)) @ vectors[:, 0]).max()
            if abs(off - p.plane_threshold) < 1e-4:
                return "ambiguous"
            tilt = certain * np.radians(p.plane_tilt) ** 2 / SURE_TILT**2
            variance = (p.point_noise**2 + SHARED * scatter) * max(1.0, tilt)
            return None if off > p.plane_threshold else (vectors[:, 0], patch.mean(axis=0), variance)
        if k == n:
            break
        k = min(2 * k, n)
    return None


@pytest.mark.parametrize("tilt", [1.5, 5.0, 20.0])
@pytest.mark.parametrize("reach", [0.6, 1.0])
def test_planes_are_those_through_the_nearest_neighbours(tilt: float, reach: float) -> None:
    params = FilterParams(plane_tilt=tilt, neighbour_distance=reach)
    local_map = filled(surface(3))
    points, hits = stored(local_map), local_map.checkpoint().points[:, 3].astype(float)
    tree = cKDTree(points)
    queries = surface(5, 1500, noise=0.05)
    planes = local_map.planes(queries, HERE, params)[0]
    compared = {"plane": 0, "none": 0}
    for j, query in enumerate(queries):
        near = sorted(tree.query_ball_point(query, reach))
        expected = expected_plane(query, points[near], hits[near], params, reach)
        if isinstance(expected, str):
            continue
        if expected is None:
            compared["none"] += 1
            assert planes.variances[j] < 0
            continue
        compared["plane"] += 1
        normal, center, variance = expected
        assert planes.variances[j] == pytest.approx(variance, rel=1e-4)
        assert abs(planes.normals[j] @ normal) == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(planes.centers[j], center, atol=1e-5)
    assert compared["plane"] > 5, compared
    assert compared["plane"] + compared["none"] > 300, compared


def test_poor_planes_are_the_good_ones_of_a_looser_tilt() -> None:
    """One pass finds both, each as if it had been looked for alone."""
    local_map, queries = filled(surface(3, 1000)), surface(5, 500, noise=0.05)
    good, poor = local_map.planes(queries, HERE, FilterParams(plane_tilt=2.0))
    assert equal(poor, local_map.planes(queries, HERE, FilterParams(plane_tilt=2.0 * RELAXED))[0])
    assert np.count_nonzero(poor.variances >= 0) > np.count_nonzero(good.variances >= 0) > 0


def test_a_plane_is_found_across_the_borders_of_voxels() -> None:
    """The floor exactly between two layers of voxels, so that noise throws its points into both."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (3000, 2)), rng.normal(scale=0.002, size=3000)])
    queries = np.column_stack([rng.uniform(-2, 2, (200, 2)), np.zeros(200)])
    planes = filled(floor).planes(queries, HERE, FilterParams())[0]
    assert np.all(planes.variances >= 0)
    assert np.abs(planes.normals[:, 2]).min() > np.cos(np.radians(2.0))
    assert np.abs(planes.centers[:, 2]).max() < 0.005


def line(offset: float, n: int = 200) -> np.ndarray:
    return np.column_stack([np.linspace(-3, 3, n), np.full(n, offset), np.zeros(n)])


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
def test_points_along_one_scan_line_make_no_plane(noise: float) -> None:
    """The trap of this sensor: five collinear neighbours fit any plane that holds their line."""
    rng = np.random.default_rng(1)
    params = MapParams(spacing=0.02, max_voxels=1000)
    local_map = filled(line(0.0) + rng.normal(scale=noise, size=(200, 3)), params)
    planes = local_map.planes(line(0.01, 50), HERE, FilterParams())[0]
    assert np.all(planes.variances < 0)


def test_a_second_scan_line_makes_them_a_plane() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([line(0.0), line(0.4)]) + rng.normal(scale=0.003, size=(400, 3))
    local_map = filled(points, MapParams(spacing=0.05, max_voxels=1000))
    planes = local_map.planes(line(0.2, 30)[5:-5], HERE, FilterParams())[0]
    assert np.all(planes.variances >= 0)
    assert np.abs(planes.normals[:, 2]).min() > np.cos(np.radians(3.0))


def test_a_corner_is_no_plane() -> None:
    """Neighbours on both sides of an edge lie off any common plane by more than the threshold."""
    rng = np.random.default_rng(2)
    a, b = rng.uniform(0, 1, (2, 1500))
    edge = np.concatenate([np.column_stack([a, b, 0 * a]), np.column_stack([0 * a, b, a])])
    queries = np.column_stack([np.zeros(20), np.linspace(0.3, 0.7, 20), np.zeros(20)]) + 0.3
    planes = filled(edge).planes(queries, HERE, FilterParams(plane_tilt=20, neighbours=20))[0]
    flat = planes.variances >= 0
    assert np.all(np.abs(planes.normals[flat]).max(axis=1) > 0.9)  # never the diagonal


def test_nothing_near_is_no_plane() -> None:
    planes = filled(surface(0)).planes(np.array([[50.0, 0, 0], [0, 0, 90.0]]), HERE, LOOSE)[0]
    assert np.all(planes.variances < 0)
    assert len(LocalMap(SMALL).planes(np.empty((0, 3)), HERE, LOOSE)[0].variances) == 0
    assert np.all(LocalMap(SMALL).planes(np.zeros((3, 3)), HERE, LOOSE)[0].variances < 0)


def test_neighbours_are_not_looked_for_beyond_a_voxels_edge() -> None:
    """Whatever the reach asked for, it is cut to where 27 voxels surely hold everything."""
    local_map = filled(surface(3))
    queries = surface(6, 200)
    far, near = (
        local_map.planes(queries, HERE, FilterParams(neighbour_distance=d))[0] for d in (5.0, SMALL.voxel_size)
    )
    assert equal(far, near)
    assert np.any(near.variances >= 0)


def test_normals_scatter_as_their_deviations_say() -> None:
    """Over many noisy maps of one patch, longer than wide."""
    params, filter_params = MapParams(spacing=0.01), FilterParams(plane_tilt=20.0, neighbours=12, point_noise=0.001)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 4), [-0.08, 0.0, 0.08])
    patch, rng = np.column_stack([x.ravel(), y.ravel(), np.full(12, -1.3)]), np.random.default_rng(0)
    tilts, stated = [], []
    for _ in range(400):
        noisy = patch + rng.normal(scale=(0.0, 0.0, 0.01), size=patch.shape)
        planes = filled(noisy, params).planes(np.array([[0.0, 0.0, -1.3]]), HERE, filter_params)[0]
        assert planes.variances[0] >= 0.0
        normal, deviations = planes.normals[0] * np.sign(planes.normals[0, 2]), planes.deviations[0]
        np.testing.assert_allclose(deviations @ normal, 0.0, atol=1e-12)
        tilts.append(normal[:2])
        stated.append((deviations.T @ deviations)[:2, :2])
    np.testing.assert_allclose(np.var(tilts, axis=0), np.diag(np.mean(stated, axis=0)), rtol=0.15)


# --- old ground ----------------------------------------------------------------------------------
def floor_at(height: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-3, 3, (6000, 2)), np.full(6000, height) + rng.normal(scale=0.002, size=6000)])


def gone_round(local_map: LocalMap, residual: float = 0.04) -> LocalMap:
    """60 m away and back to HERE, with nothing in sight."""
    for x in np.r_[np.arange(0, 30, 1.5), np.arange(30, 0, -1.5), 0.0]:
        local_map.insert(np.empty((0, 3), np.float32), np.array([x, 0, 0]), SMALL, residual)
    return local_map


QUERIES = np.column_stack([np.random.default_rng(9).uniform(-2, 2, (200, 2)), np.full(200, 0.33)])


def test_a_surface_seen_anew_is_not_mixed_with_the_old_one() -> None:
    """The same floor, 6 cm higher after a long way round: drift, not thickness."""
    local_map = gone_round(filled(floor_at(0.30, 1)))
    for seed in (2, 3, 4):
        local_map.insert(floor_at(0.36, seed).astype(np.float32), HERE, SMALL)
    planes = local_map.planes(QUERIES, HERE, FilterParams())[0]
    np.testing.assert_allclose(planes.centers[:, 2], 0.36, atol=0.005)


def test_old_surfaces_pull_less_where_nothing_new_is_seen() -> None:
    fresh, local_map = filled(floor_at(0.30, 1)), gone_round(filled(floor_at(0.30, 1)))
    before, old = (m.planes(QUERIES, HERE, FilterParams())[0] for m in (fresh, local_map))
    assert np.array_equal(before.centers, old.centers)
    np.testing.assert_allclose(old.variances, OLD * before.variances)


def test_where_scans_fit_the_map_exactly_nothing_grows_old() -> None:
    fresh, local_map = filled(floor_at(0.30, 1)), gone_round(filled(floor_at(0.30, 1)), residual=0.01)
    assert equal(local_map.planes(QUERIES, HERE, FilterParams())[0], fresh.planes(QUERIES, HERE, FilterParams())[0])


def test_what_stays_in_view_never_grows_old() -> None:
    local_map, seen = LocalMap(SMALL), floor_at(0.30, 1).astype(np.float32)
    for x in np.arange(0, 60, 1.5):
        local_map.insert(seen, np.array([x, 0, 0]), SMALL, 0.04)
    fresh = filled(floor_at(0.30, 1))
    assert len(stored(local_map)) < 1.3 * len(stored(fresh))
    now, then = (m.planes(QUERIES, HERE, FilterParams())[0].variances for m in (local_map, fresh))
    np.testing.assert_allclose(now, then, rtol=0.1)


# --- two sides -----------------------------------------------------------------------------------
def wall(x: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([np.full(900, x), rng.uniform(-1.5, 1.5, (900, 2))]) + rng.normal(scale=0.005, size=(900, 3))


def test_a_face_of_a_thin_wall_is_not_fitted_to_the_other_face() -> None:
    west, east = np.array([-3.0, 0.5, 0.2]), np.array([3.0, -0.5, 0.1])
    local_map = LocalMap(SMALL)
    local_map.insert(wall(0.0, 0).astype(np.float32), west, SMALL)
    queries = wall(0.1, 1)[::10]
    assert np.all(local_map.planes(queries, west, FilterParams())[0].variances >= 0), "10 cm off, but the same face"
    assert np.all(local_map.planes(queries, east, FilterParams())[1].variances < 0), "the face that was never seen"


def test_a_floor_is_the_same_from_wherever_it_is_seen() -> None:
    ahead, behind = np.array([4.0, 0.0, 1.0]), np.array([-4.0, 0.0, 1.0])
    floor = surface(0)
    floor = floor[np.abs(floor[:, 2] + 1.3) < 0.05]
    local_map = LocalMap(SMALL)
    local_map.insert(floor.astype(np.float32), ahead, SMALL)
    assert equal(*(local_map.planes(floor[::10], eye, FilterParams())[0] for eye in (ahead, behind)))
