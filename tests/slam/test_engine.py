"""The engine as a whole, on walks with exactly known poses."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.export.points import EVERYTHING, blocks
from app.slam.engine import Engine
from app.slam.map_frame import MapFrame
from app.slam.types import STAGES, FrameStatus
from tests.slam.engine_runs import ALONG, FRAMES, REAL, assert_all_same, assert_same, room_walk, run, worst
from tests.slam.scenes import (
    FORWARD,
    GRAVITY,
    UPRIGHT,
    YARD,
    Rig,
    Scene,
    Walk,
    corridor,
    furnished_room,
    measurements,
    mounted,
    params_for,
    pose_error,
    seconds_of,
)

STEADY = ((0.0, 1.0, 0.0),) * 3


# --- walks ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("rig", "device"),
    [
        pytest.param(REAL, FORWARD, id="forward, as the paper's"),
        pytest.param(REAL, UPRIGHT, id="upright"),
        pytest.param(replace(REAL, T_imu_lidar=mounted((90, 0, 45), (0.2, -0.1, 0.3))), FORWARD, id="LiDAR sideways"),
        pytest.param(replace(REAL, T_imu_lidar=mounted((180, 0, 0), (0, 0, 0.1))), FORWARD, id="LiDAR upside down"),
        pytest.param(REAL, FORWARD @ Rotation.from_euler("z", 180, degrees=True).as_matrix(), id="device upside down"),
    ],
)
def test_a_walk_in_a_room_is_followed_within_two_centimetres(rig: Rig, device: np.ndarray) -> None:
    """The attitude is that of the IMU. It is as uncertain as the mounting, which starts at 0.4 degrees an axis."""
    walk = Walk(device)
    results = run(Engine(params_for(rig)), measurements(furnished_room(), walk, rig, FRAMES))
    metres, degrees = worst(results, walk)
    assert metres < 0.02
    assert degrees < 0.5
    assert results[-1].status is FrameStatus.TRACKING


def test_with_perfect_sensors_within_millimetres() -> None:
    results = run(Engine(params_for(Rig())), measurements(furnished_room(), Walk(), Rig(), FRAMES))
    metres, degrees = worst(results, Walk())
    assert metres < 0.005
    assert degrees < 0.1


def test_along_a_corridor_within_two_centimetres() -> None:
    results = run(Engine(params_for(REAL)), measurements(corridor(16.0, pillars=True), ALONG, REAL, 100))
    walked = ALONG.positions(np.array([seconds_of(results[-1].stamp_ns)]))[0, 0]
    assert walked > 8
    metres, _ = worst(results, ALONG)
    assert metres < 0.02
    assert all(r.status is not FrameStatus.LOST for r in results)


def test_biases_and_velocity_become_known() -> None:
    results = run(Engine(params_for(REAL)), measurements(furnished_room(), Walk(), REAL, 120))
    state, t = results[-1].state, np.array([seconds_of(results[-1].stamp_ns)])
    np.testing.assert_allclose(state.b_gyro, REAL.b_gyro, atol=2e-3)
    R_odom_world = Walk().relative(0.0)[:3, :3] @ Walk().pose(0.0)[:3, :3].T
    np.testing.assert_allclose(state.v_odom_imu, R_odom_world @ Walk().velocities(t)[0], atol=0.05)
    assert np.linalg.norm(state.g_odom) == pytest.approx(9.81)


def test_odom_begins_at_the_first_pose_with_z_up() -> None:
    r = run(Engine(params_for(REAL)), room_walk(12))[-1]
    np.testing.assert_allclose(r.state.p_odom_imu, 0, atol=0.005)
    up = r.state.R_odom_imu @ FORWARD.T @ [0.0, 0, 1]
    assert np.degrees(np.arccos(up[2])) < 0.5  # the accelerometer's bias alone is 0.3
    np.testing.assert_allclose(r.state.g_odom, [0, 0, -9.81], atol=0.1)
    perfect = run(Engine(params_for(Rig())), measurements(furnished_room(), Walk(), Rig(), 12))[-1]
    metres, degrees = pose_error(perfect.state.T_odom_imu, Walk().relative(0.0))
    assert metres < 0.002
    assert degrees < 0.02


def test_the_start_waits_at_rest_and_then_tracks() -> None:
    results = run(Engine(params_for(REAL)), room_walk())
    begun = [r.status for r in results].index(FrameStatus.TRACKING)
    assert begun == 9  # a second of rest
    assert all(r.status is FrameStatus.INITIALISING for r in results[:begun])
    assert all(r.status is FrameStatus.TRACKING for r in results[begun:])
    assert not any(r.notices for r in results)
    assert results[3].ground.found  # the frame can be looked at while it waits


def test_a_start_in_motion_is_reported_and_survived() -> None:
    """Turned on while walking: what is known is relative to the first scan, and the tilt is found out."""
    walk = Walk(still=-4.0)
    results = run(Engine(params_for(REAL)), measurements(furnished_room(), walk, REAL, FRAMES))
    assert "moving" in " ".join(n for r in results[:3] for n in r.notices)
    settled = results[20:]
    metres, degrees = worst(settled, walk)
    assert metres < 0.05
    assert degrees < 1.0


def test_a_start_in_motion_knows_its_speed_by_the_second_scan_and_soon_what_is_down() -> None:
    """The first scan is bent by 12 cm, at a speed that nothing tells; it stays out of the map and of the keyframes."""
    walk = replace(ALONG, still=-4.0)
    results = run(Engine(params_for(REAL)), measurements(corridor(16.0, pillars=True), walk, REAL, 30))
    assert [n for r in results for n in r.notices] == list(results[0].notices)
    assert "moving" in results[0].notices[0]
    assert next(r.index for r in results if r.keyframe) == 1
    for k, result in enumerate(results[1:], 1):
        state, t = result.state, np.array([seconds_of(result.stamp_ns)])
        to_imu = walk.pose(float(t[0]))[:3, :3].T
        assert np.linalg.norm(state.R_odom_imu.T @ state.v_odom_imu - to_imu @ walk.velocities(t)[0]) < 0.1
        down = state.R_odom_imu.T @ state.g_odom / GRAVITY @ (to_imu @ [0.0, 0.0, -1.0])
        assert k < 10 or np.degrees(np.arccos(min(down, 1.0))) < 1.0
    assert worst(results, walk)[0] < 0.02


def test_a_start_in_motion_says_where_the_speed_is_a_guess() -> None:
    """Nothing tells how fast the walk goes along a bare corridor."""
    bare = measurements(corridor(150.0, pillars=False), replace(ALONG, still=-4.0), REAL, 6)
    results = run(Engine(params_for(REAL)), bare)
    assert ["do not show the speed" in " ".join(r.notices) for r in results] == [False, True] + 4 * [False]
    assert next(r.index for r in results if r.keyframe) == 1


@pytest.mark.parametrize("yaw_rate", [0.0, 0.1])
def test_a_device_that_rides_evenly_is_not_taken_for_one_at_rest(yaw_rate: float) -> None:
    """On a trolley the IMU feels nothing, a turn passes for a bias, and only the scans tell."""
    for scene, speed in ((furnished_room(), 0.5), (YARD, 1.2)):
        ride = Walk(still=-4.0, speed=(speed, 0.0, 0.0), sway=STEADY, turn=STEADY, yaw_rate=yaw_rate)
        results = run(Engine(params_for(REAL)), measurements(scene, ride, REAL, 40))
        assert "moving evenly" in " ".join(n for r in results for n in r.notices)
        metres, degrees = worst(results, ride)
        assert metres < 0.05
        assert degrees < 1.0


def test_a_rest_is_one_also_where_scans_leave_the_way_along_a_corridor_open() -> None:
    results = run(Engine(params_for(REAL)), measurements(corridor(300.0, pillars=False), Walk(still=100.0), REAL, 20))
    assert not any(r.notices for r in results)
    assert worst(results, Walk(still=100.0))[0] < 0.01


def test_extrinsics_are_found_when_they_are_estimated() -> None:
    """Two centimetres and a degree off; a motion that turns about all axes tells them apart."""
    rig = Rig(T_imu_lidar=mounted((0, 0, 0), (0.05, -0.03, -0.10)))
    assumed = replace(rig, T_imu_lidar=mounted((0.7, -0.5, 0.5), (0.065, -0.02, -0.09)))
    walk = Walk(turn=((0.6, 1.4, 0.0), (0.5, 1.9, 0.3), (0.4, 1.7, 1.0)))
    scans = tuple(measurements(furnished_room(), walk, rig, 200))
    before = pose_error(assumed.T_imu_lidar, rig.T_imu_lidar)
    found = run(Engine(params_for(assumed)), scans)[-1].state.T_imu_lidar
    fixed = params_for(assumed, {"filter.estimate_extrinsics": False})
    kept = run(Engine(fixed), scans[:20])[-1].state.T_imu_lidar
    after = pose_error(found, rig.T_imu_lidar)
    np.testing.assert_allclose(kept, assumed.T_imu_lidar, atol=1e-12)
    assert after[0] < 0.25 * before[0]
    assert after[1] < 0.1 * before[1]


# --- what a result says --------------------------------------------------------------------------
def test_the_cloud_is_the_world_as_seen_at_the_scans_end() -> None:
    """Deskewed by the engine's own estimate, every point lies on a surface of the room."""
    scene, rig, walk = Scene(furnished_room().room), replace(REAL, range_noise=0.0), Walk()
    results = run(Engine(params_for(rig)), measurements(scene, walk, rig, FRAMES))
    r = results[-1]
    T = walk.pose(seconds_of(r.stamp_ns)) @ rig.T_imu_lidar
    world = r.cloud.points.astype(float) @ T[:3, :3].T + T[:3, 3]
    assert scene.room is not None
    off = np.abs(np.concatenate([world - scene.room[0], world - scene.room[1]], axis=1)).min(axis=1)
    assert np.quantile(off, 0.99) < 0.01
    assert len(r.cloud) == len(r.cloud.labels) == len(r.cloud.ring) == r.points_in


def test_a_result_shows_its_numbers() -> None:
    for m, r in zip(room_walk(), run(Engine(params_for(REAL)), room_walk()), strict=True):
        assert r.stamp_ns == m.scan.end_ns == r.state.stamp_ns
        assert r.points_filter <= r.points_reduced <= r.points_in == len(m.scan)
        assert set(r.timings_ms) == {*STAGES, "total"}
        assert r.timings_ms["total"] == pytest.approx(sum(r.timings_ms[s] for s in STAGES), abs=1e-6)
        np.testing.assert_array_equal(r.T_map_odom, np.eye(4))
        np.testing.assert_array_equal(r.truth_ground, m.scan.truth_ground)
        np.testing.assert_array_equal(r.cloud.labels, r.ground.labels)
        if r.status is FrameStatus.TRACKING and r.index > 12:
            assert r.registration.converged
            assert r.registration.inliers > 100
            assert r.registration.residual_rms < 0.02
    assert [r.index for r in run(Engine(params_for(REAL)), room_walk(5))] == [0, 1, 2, 3, 4]


def test_a_result_stays_what_it_was() -> None:
    engine = Engine(params_for(REAL))
    results, copies = [], []
    for m in room_walk():
        results.append(engine.step(m.scan, m.imu))
        copies.append(pickle.loads(pickle.dumps(results[-1])))
    assert_all_same(results, copies)


def test_input_is_left_as_it_was() -> None:
    walk = room_walk(15)
    copy = pickle.loads(pickle.dumps(walk))
    run(Engine(params_for(REAL)), walk)
    for m, c in zip(walk, copy, strict=True):
        assert_same(m, c)


# --- keyframes -----------------------------------------------------------------------------------
def test_points_of_a_keyframe_keep_their_times_when_the_scan_ends_out_of_range() -> None:
    """Its last third is of the operator, nearer than the least range."""
    engine = Engine(params_for(REAL))
    for m in room_walk():
        kept = m.scan.offsets_ns < 2 / 3 * m.scan.offsets_ns.max()
        points = np.where(kept[:, None], m.scan.points, np.float32(0.01) * m.scan.points)
        if engine.step(replace(m.scan, points=points), m.imu).keyframe is not None:
            break
    (block,) = blocks(engine.keyframes, MapFrame(), EVERYTHING)
    assert np.array_equal(block.stamps_ns, m.scan.stamp_ns + m.scan.offsets_ns[kept].astype(np.int64))


def test_keyframes_are_stored_as_they_were_reported() -> None:
    engine = Engine(params_for(REAL, {"keyframe.distance": 0.2}))
    reported = [r for r in run(engine, room_walk()) if r.keyframe is not None]
    assert len(reported) == len(engine.keyframes) > 3
    for i, (r, stored) in enumerate(zip(reported, engine.keyframes, strict=True)):
        assert r.keyframe is not None
        assert_same(stored, r.keyframe)
        assert stored.index == i
        assert stored.frame == r.index
        assert stored.stamp_ns == r.stamp_ns
        np.testing.assert_array_equal(stored.T_odom_imu, r.state.T_odom_imu)
        assert_same(stored.cloud, r.cloud, ("offsets_ns",))
        assert np.linalg.eigvalsh(stored.covariance)[0] > 0
    steps = np.diff([k.T_odom_imu[:3, 3] for k in engine.keyframes], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.2 + 0.15
    engine.close()


# --- relabelling and parameters ------------------------------------------------------------------
def test_relabelling_changes_labels_and_ground_and_nothing_else() -> None:
    engine = Engine(params_for(REAL))
    results = run(engine, room_walk()[:30])
    before = engine.checkpoint()
    engine.params = engine.params.with_values({"ground.sigma": 0.1})
    again = engine.relabel(results[-1])
    assert again.ground.share > results[-1].ground.share
    np.testing.assert_array_equal(again.cloud.labels, again.ground.labels)
    assert again.points_reduced < results[-1].points_reduced
    assert_same(
        replace(again, cloud=results[-1].cloud, ground=results[-1].ground, points_reduced=results[-1].points_reduced),
        results[-1],
        ignore=(),
    )
    assert_same(replace(again.cloud, labels=results[-1].cloud.labels), results[-1].cloud)

    assert_same(replace(engine.checkpoint(), params=before.params), before)


def test_relabelling_with_the_same_parameters_gives_the_same_labels() -> None:
    engine = Engine(params_for(REAL))
    for r in run(engine, room_walk()[:25]):
        assert_same(engine.relabel(r), r, ignore=())


def test_relabelling_equals_what_the_engine_would_have_labelled() -> None:
    wide = params_for(REAL, {"ground.sigma": 0.08, "ground.alpha": 35.0})
    engine, other = Engine(params_for(REAL)), Engine(params_for(REAL))
    r = run(engine, room_walk()[:25])[-1]
    engine.params = wide
    run(other, room_walk()[:24])
    other.params = wide
    expected = other.step(room_walk()[24].scan, room_walk()[24].imu)
    np.testing.assert_array_equal(engine.relabel(r).cloud.labels, expected.cloud.labels)


def test_parameters_act_from_the_next_frame_on() -> None:
    engine = Engine(params_for(REAL))
    run(engine, room_walk()[:20])
    for values, observe in (
        ({"ground.enabled": False}, lambda r: not r.ground.found),
        ({"ground.enabled": True}, lambda r: r.ground.found),
        ({"scan.voxel_size": 2.0}, lambda r: r.points_filter < 300),
        (
            {"scan.voxel_size": 0.4, "sensor.max_range": 2.0},
            lambda r: np.linalg.norm(r.cloud.points, axis=1).max() < 2.2,
        ),
        ({"sensor.max_range": 100.0, "filter.max_iterations": 1}, lambda r: r.registration.iterations == 1),
    ):
        m = room_walk()[engine.checkpoint().progress.frame]
        engine.params = engine.params.with_values(values)
        assert observe(engine.step(m.scan, m.imu)), values
