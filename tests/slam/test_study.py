"""Numbers of a frame point by point, compared with SciPy and the engine's own summaries; files for other programs."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from app.slam import study
from app.slam.engine import Engine
from app.slam.study import MATCH_M, VERTEX, neighbourhood, pcd, ply, point_numbers
from app.slam.types import StepResult

from .scenes import Rig, Walk, furnished_room, measurements, params_for

RIG = Rig(range_noise=0.005)
FRAMES = 14


@cache
def walked() -> tuple[StepResult, ...]:
    engine = Engine(params_for(RIG))
    return tuple(engine.step(m.scan, m.imu) for m in measurements(furnished_room(), Walk(), RIG, FRAMES))


# --- numbers -------------------------------------------------------------------------------------
def test_distance_and_range_are_what_the_labels_were_made_of() -> None:
    result, sigma = walked()[-1], params_for(RIG).ground.sigma
    assert result.ground.found
    numbers = point_numbers(result.cloud.points, result)
    assert np.array_equal(np.abs(numbers.distance) < sigma * numbers.range, result.cloud.labels > 0)


def test_the_angle_is_between_the_point_and_gravity_and_a_point_above_the_floor_is_above_it() -> None:
    result = walked()[-1]
    R_odom_lidar = result.state.R_odom_imu @ result.state.R_imu_lidar
    towards = result.cloud.points @ R_odom_lidar.T  # z is up there
    numbers = point_numbers(result.cloud.points, result)
    elevation = np.degrees(np.arcsin(towards[:, 2] / np.linalg.norm(towards, axis=1)))
    np.testing.assert_allclose(np.degrees(numbers.angle), 90 + elevation, atol=0.5)
    floor = np.median(towards[result.cloud.labels > 0, 2])
    assert (numbers.distance[towards[:, 2] > floor + 0.5] > 0).all()


def test_without_a_plane_there_is_no_distance() -> None:
    result = walked()[-1]
    blind = replace(result, ground=replace(result.ground, found=False, centroid=np.full(3, np.nan)))
    assert np.isnan(point_numbers(result.cloud.points, blind).distance).all()


@pytest.mark.parametrize("count", [1, 4, 25])
def test_neighbours_are_the_nearest_and_the_point_is_the_first(count: int) -> None:
    points = np.random.default_rng(3).normal(size=(500, 3)).astype(np.float32)
    for index in (0, 77, 499):
        patch = neighbourhood(points, index, count)
        far, expected = cKDTree(points.astype(float)).query(points[index].astype(float), k=count)
        assert patch.indices[0] == index
        assert set(patch.indices.tolist()) == set(np.atleast_1d(expected).tolist())
        assert patch.radius == pytest.approx(np.max(far), abs=1e-6)


def test_more_neighbours_than_points_are_all_of_them() -> None:
    assert len(neighbourhood(np.eye(3, dtype=np.float32), 1, 20).indices) == 3


def test_a_tilted_plane_s_normal_faces_the_sensor_and_its_thickness_is_the_noise() -> None:
    rng = np.random.default_rng(5)
    R = Rotation.from_euler("xyz", [0.4, -0.3, 0.2]).as_matrix()
    flat = np.column_stack((rng.uniform(-1, 1, (4000, 2)), rng.normal(0, 0.01, 4000)))
    points = (flat @ R.T + [3.0, 1.0, -2.0]).astype(np.float32)
    patch = neighbourhood(points, 0, 3000)
    towards_sensor = R[:, 2] * -np.sign(R[:, 2] @ [3.0, 1.0, -2.0])
    np.testing.assert_allclose(patch.normal, towards_sensor, atol=2e-3)
    assert np.sqrt(patch.variances[2]) == pytest.approx(0.01, rel=0.1)


# --- how each point fitted the map ---------------------------------------------------------------
def test_matches_add_up_to_what_the_update_reported() -> None:
    matched = [result for result in walked() if result.registration.matches is not None]
    assert len(matched) >= 3
    for result in matched:
        update = result.registration
        assert update.matches is not None and update.used == len(update.matches.points)
        used = np.isfinite(update.matches.residuals)
        assert np.count_nonzero(used) == update.inliers
        rms = float(np.sqrt(np.mean(update.matches.residuals[used].astype(float) ** 2)))
        assert rms == pytest.approx(update.residual_rms, rel=1e-4)


def test_a_residual_is_the_distance_of_its_point_to_its_plane() -> None:
    result = walked()[-1]
    matches, T = result.registration.matches, result.state.T_odom_imu @ result.state.T_imu_lidar
    assert matches is not None
    used = np.isfinite(matches.residuals)
    world = matches.points.astype(float) @ T[:3, :3].T + T[:3, 3]
    distance = np.einsum("ij,ij->i", world - matches.centers, matches.normals)
    assert result.registration.converged
    np.testing.assert_allclose(distance[used], matches.residuals[used], atol=5e-4)  # the last step comes after
    np.testing.assert_allclose(np.linalg.norm(matches.normals[used], axis=1), 1.0, atol=1e-5)


def test_the_first_frame_that_begins_the_map_has_no_matches_and_every_frame_its_imu_gap() -> None:
    first, *rest = walked()
    assert first.registration.matches is None
    assert all(result.imu_gap_s == pytest.approx(0.005, abs=1e-4) for result in rest)


# --- files ---------------------------------------------------------------------------------------
def body(data: bytes, end: bytes) -> tuple[str, np.ndarray]:
    header, _, rest = data.partition(end)
    return header.decode("ascii"), np.frombuffer(rest, dtype=VERTEX)


def test_a_ply_holds_every_point_with_all_it_carries() -> None:
    result = walked()[-1]
    header, table = body(ply(result), b"end_header\n")
    sizes = {"float": 4, "ushort": 2, "int": 4, "uchar": 1}
    properties = re.findall(r"property (\w+) (\w+)", header)
    assert [name for _, name in properties] == list(VERTEX.names or ())
    assert sum(sizes[kind] for kind, _ in properties) == VERTEX.itemsize
    assert f"element vertex {len(result.cloud):012d}" in header and len(table) == len(result.cloud)
    cloud = result.cloud
    assert np.array_equal(np.column_stack((table["x"], table["y"], table["z"])), cloud.points)
    for name, column in (("intensity", cloud.intensity), ("ring", cloud.ring), ("label", cloud.labels)):
        assert np.array_equal(table[name], column)
    assert np.array_equal(table["offset"], cloud.offsets_ns)
    numbers = point_numbers(cloud.points, result)
    np.testing.assert_allclose(table["distance"], numbers.distance, atol=1e-5)
    np.testing.assert_allclose(table["angle"], np.degrees(numbers.angle), atol=1e-3)


def test_a_file_s_residual_is_that_of_the_nearest_point_looked_up() -> None:
    result = walked()[-1]
    matches, points = result.registration.matches, result.cloud.points.astype(float)
    assert matches is not None
    apart = np.linalg.norm(points[:, None] - matches.points.astype(float), axis=2)
    nearest, away = apart.argmin(axis=1), apart.min(axis=1)
    near = away <= MATCH_M
    assert np.count_nonzero(near) > 0, "else there is nothing to compare"
    table = study.vertices(result)
    np.testing.assert_allclose(table["residual_away"][near], away[near], rtol=1e-6)
    np.testing.assert_array_equal(table["residual"][near], matches.residuals[nearest[near]])
    assert np.isnan(table["residual"][~near]).all() and np.isnan(table["residual_away"][~near]).all()
    used = np.isfinite(table["residual"])
    assert used.mean() > 0.5 and np.sqrt(np.mean(table["residual"][used] ** 2)) < 0.02, "a room with a noise of 5 mm"


def test_where_nothing_was_looked_up_a_file_has_no_residuals() -> None:
    table = study.vertices(walked()[0])
    assert len(table) and np.isnan(table["residual"]).all() and np.isnan(table["residual_away"]).all()


def test_a_pcd_says_the_same_and_from_where_it_was_seen() -> None:
    result = walked()[-1]
    header, table = body(pcd(result), b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in header.splitlines() if not line.startswith("#"))
    assert fields["FIELDS"].split() == list(VERTEX.names or ())
    assert sum(map(int, fields["SIZE"].split())) == VERTEX.itemsize
    assert fields["TYPE"].split() == ["F", "F", "F", "F", "U", "I", "U", "F", "F", "F", "F"]
    assert int(fields["POINTS"]) == int(fields["WIDTH"]) == len(table)
    assert table.tobytes() == study.vertices(result).tobytes()
    x, y, z, qw, qx, qy, qz = map(float, fields["VIEWPOINT"].split())
    T = result.T_map_imu @ result.state.T_imu_lidar
    np.testing.assert_allclose([x, y, z], T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), T[:3, :3], atol=1e-6)
