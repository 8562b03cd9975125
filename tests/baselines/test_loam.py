"""LOAM, its features and its matching, in rooms where every pose is known.

Tests app/baselines/loam.py, app/baselines/features.py, app/baselines/matching.py, app/baselines/poses.py.
"""

from functools import cache

import numpy as np
import pytest

from app.baselines.features import FeaturePoints, curvatures, extract, undistorted
from app.baselines.loam import Loam
from app.baselines.matching import FeatureMap, Pairs, solve
from app.baselines.poses import levelled, mounting
from app.slam import lie
from app.slam.types import F64, ImuSamples, Measurement, Scan
from tests.slam.scenes import Rig, Walk, furnished_room, measurements, mounted, params_for, pose_error, seconds_of

RIG = Rig(columns=120, T_imu_lidar=mounted((0, 0, 0), (0.0175, 0.0276, -0.1083)), range_noise=0.005)
FRAMES = 50


@cache
def walked() -> tuple[Measurement, ...]:
    return tuple(measurements(furnished_room(), Walk(), RIG, FRAMES))


def errors(poses: list[tuple[int, F64]]) -> F64:
    """(n, 2) m and degrees, of the motion since the first scan."""
    walk = Walk()
    first_ns, first = poses[0]
    start = np.linalg.inv(walk.pose(seconds_of(first_ns)))
    return np.array(
        [pose_error(lie.inverse(first) @ T, start @ walk.pose(seconds_of(stamp_ns))) for stamp_ns, T in poses]
    )


def test_it_walks_through_a_room_and_knows_where_it_is() -> None:
    loam = Loam(params_for(RIG))
    found = errors([loam.step(measurement) for measurement in walked()])
    assert found[:, 0].max() < 0.15 and found[:, 1].max() < 3.0


def test_a_sparse_noisy_scanner_at_rest_hardly_moves_from_scan_to_scan() -> None:
    """With the speed of the last step alone, its noise comes back as distortion of the next scan: 34 mm a scan."""
    rig = Rig(columns=60, range_noise=0.017)
    loam, still = Loam(params_for(rig)), measurements(furnished_room(), Walk(still=30.0), rig, 20)
    positions = np.array([loam.step(measurement)[1][:3, 3] for measurement in still])
    assert np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1)) < 0.025


def test_the_same_scans_give_the_same_bytes() -> None:
    first, again = (Loam(params_for(RIG)) for _ in range(2))
    for measurement in walked()[:12]:
        assert first.step(measurement)[1].tobytes() == again.step(measurement)[1].tobytes()


def test_without_returns_it_goes_on_as_fast_as_it_did() -> None:
    loam = Loam(params_for(RIG))
    poses = [loam.step(measurement)[1] for measurement in walked()[:45]]
    scan = walked()[45].scan
    nothing = np.zeros(0, np.int64)
    empty = Scan(
        scan.stamp_ns, scan.points[nothing], scan.offsets_ns[nothing], scan.intensity[nothing], scan.ring[nothing]
    )
    _, T = loam.step(Measurement(empty, walked()[45].imu))
    before, after = lie.inverse(poses[-2]) @ poses[-1], lie.inverse(poses[-1]) @ T
    assert np.isfinite(T).all()
    assert np.linalg.norm(after[:3, 3]) < 2 * np.linalg.norm(before[:3, 3]) + 0.05


def line(points: F64) -> FeaturePoints:
    n = len(points)
    return FeaturePoints(points, np.zeros(n, np.int64), np.zeros(n))


def test_a_corner_is_sharp_and_a_wall_seen_at_an_angle_is_flat() -> None:
    azimuth = np.radians(np.arange(-40.0, 40.0, 1.2))
    wall = np.column_stack([np.full_like(azimuth, 3.0), 3.0 * np.tan(azimuth), np.zeros_like(azimuth)])
    curvature, _, measured = curvatures(line(wall))
    assert measured.sum() == len(wall) - 10 and curvature[measured].max() < 0.1
    ranges = np.minimum(3 / np.cos(azimuth - np.pi / 4), 3 / np.cos(azimuth + np.pi / 4))
    corner = np.column_stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth), np.zeros_like(azimuth)])
    curvature, _, measured = curvatures(line(corner))
    assert abs(int(np.argmax(np.where(measured, curvature, 0.0))) - len(azimuth) / 2) <= 1
    assert curvature[measured].max() > 0.6


def test_edges_lie_where_walls_meet() -> None:
    """Of a bare room seen by 16 lines, every edge is within 15 cm of a corner."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.0, 360.0, 1.0)), np.radians(np.arange(-15.0, 16.0, 2.0)))
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    half = np.array([4.0, 3.0, 50.0])
    points = direction * (half / np.maximum(np.abs(direction), 1e-9)).min(axis=1)[:, None]
    ring = np.repeat(np.arange(16), azimuth.shape[1]).astype(np.uint16)
    n = len(points)
    found = extract(
        Scan(0, points.astype(np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32), ring), 0.2, 100.0
    )
    assert len(found.edges) >= 4 * 16 and len(found.planes) > 200
    to_corner = np.linalg.norm(np.abs(found.edges.points[:, :2]) - half[:2], axis=1)
    assert to_corner.max() < 0.15


def test_points_of_a_turning_scanner_are_put_where_they_are() -> None:
    """A wall swept while the scanner turns by 20 degrees and moves by 0.3 m is straight again."""
    motion = lie.transform(lie.exp(np.array([0.0, 0.0, np.radians(20)])), np.array([0.3, 0.0, 0.0]))
    shares = np.linspace(0, 1, 50)
    true = np.column_stack([np.full(50, 5.0), np.linspace(-2, 2, 50), np.zeros(50)])  # as seen from the end
    back = lie.log(motion[:3, :3])
    velocity = motion[:3, :3].T @ motion[:3, 3]
    measured = np.stack(
        [lie.exp((1 - s) * back) @ (point + (1 - s) * velocity) for s, point in zip(shares, true, strict=True)]
    )
    np.testing.assert_allclose(undistorted(measured, shares, motion), true, atol=1e-9)
    # the pose at share s of the motion: the first point was seen from the scan's begin
    np.testing.assert_allclose(lie.inverse(motion)[:3] @ [*measured[0], 1.0], true[0], atol=1e-9)


def test_three_walls_give_the_pose_and_a_corridor_keeps_what_it_leaves_open() -> None:
    rng = np.random.default_rng(3)
    T = lie.transform(lie.exp(np.array([0.02, -0.01, 0.03])), np.array([0.1, -0.05, 0.08]))

    def walls(axes: tuple[int, ...]) -> Pairs:
        anchors = np.concatenate([np.insert(rng.uniform(-4, 4, (200, 2)), axis, 5.0, axis=1) for axis in axes])
        normals = np.repeat(np.eye(3)[list(axes)], 200, axis=0)
        return Pairs((anchors - T[:3, 3]) @ T[:3, :3], normals, anchors)

    np.testing.assert_allclose(solve(np.eye(4), walls((0, 1, 2)), steps=20).T, T, atol=1e-6)
    open_ended = solve(np.eye(4), walls((1, 2)), steps=20)
    assert np.linalg.matrix_rank(open_ended.information) < 6 and abs(open_ended.T[0, 3]) < 0.02
    assert open_ended.information[3, 3] < 1e-6 * open_ended.information[4, 4], "along it the walls tell nothing"
    np.testing.assert_allclose(open_ended.T[1:3, 3], T[1:3, 3], atol=0.02)


def test_the_map_forgets_what_is_far_and_does_not_grow_where_it_stands() -> None:
    feature_map = FeatureMap(0.2, 0.4, reach=20.0)
    points = np.random.default_rng(0).uniform(-5, 5, (3000, 3))
    feature_map.insert(points, points, np.zeros(3))
    once = len(feature_map)
    feature_map.insert(points, points, np.zeros(3))
    assert len(feature_map) < 1.2 * once
    centre = np.array([100.0, 0.0, 0.0])
    feature_map.insert(points + centre, points + centre, centre)
    assert len(feature_map) < 1.2 * once


@pytest.mark.parametrize("up", [(0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (3.0, -5.0, 7.0)])
def test_the_world_begins_upright(up: tuple[float, float, float]) -> None:
    samples = ImuSamples(np.arange(5), np.zeros((5, 3)), np.tile(up, (5, 1)))
    T = levelled(samples)
    np.testing.assert_allclose(T[:3, :3] @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(mounting(params_for(RIG)), RIG.T_imu_lidar, atol=1e-12)
