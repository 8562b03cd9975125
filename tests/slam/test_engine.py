"""The engine as a whole, on walks whose every pose is known exactly."""

import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.slam import kernels
from app.slam.engine import Checkpoint, Engine
from app.slam.params import Params
from app.slam.types import STAGES, FrameStatus, ImuSamples, Measurement, Scan, StepResult

from .scenes import (
    FORWARD,
    PERIOD_S,
    START_NS,
    UPRIGHT,
    Rig,
    Scene,
    Walk,
    box,
    corridor,
    furnished_room,
    measurements,
    mounted,
    params_for,
    pattern,
    pose_error,
    seconds_of,
)

ROOT = Path(__file__).resolve().parents[2]
REAL = Rig(
    T_imu_lidar=mounted((0, 0, 0), (0.0175, 0.0276, -0.1083)),
    range_noise=0.005,
    gyro_noise=1.2e-3 * np.sqrt(200),
    accel_noise=1.3e-2 * np.sqrt(200),
    b_gyro=(0.01, -0.008, 0.005),
    b_accel=(0.03, -0.02, 0.04),
)
ALONG = Walk(speed=(1.2, 0.0, 0.0), sway=((0.0, 1.0, 0.0), (0.05, 3.0, 0.4), (0.03, 6.0, 0.9)))
FRAMES = 60


@cache
def room_walk(frames: int = FRAMES) -> tuple[Measurement, ...]:
    return tuple(measurements(furnished_room(), Walk(), REAL, frames))


def run(engine: Engine, walk: Iterable[Measurement]) -> list[StepResult]:
    return [engine.step(m.scan, m.imu) for m in walk]


def errors(results: list[StepResult], walk: Walk) -> np.ndarray:
    """(n, 2) m and degrees, of the motion since the first frame that was tracked."""
    first = next(r for r in results if r.status is FrameStatus.TRACKING)
    T_first_odom = np.linalg.inv(first.state.T_odom_imu)
    T_first_world = np.linalg.inv(walk.pose(seconds_of(first.stamp_ns)))
    return np.array(
        [
            pose_error(T_first_odom @ r.state.T_odom_imu, T_first_world @ walk.pose(seconds_of(r.stamp_ns)))
            if r.status is not FrameStatus.INITIALISING
            else (0.0, 0.0)
            for r in results
        ]
    )


def worst(results: list[StepResult], walk: Walk, since: int = 0) -> tuple[float, float]:
    """Largest errors from frame `since` on, m and degrees."""
    metres, degrees = errors(results, walk)[since:].max(axis=0)
    return float(metres), float(degrees)


def assert_same(a: object, b: object, ignore: tuple[str, ...] = ("timings_ms",)) -> None:
    """Equal in every field and to the last bit."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype  # type: ignore[attr-defined]
        np.testing.assert_array_equal(a, b)  # type: ignore[arg-type]
    elif is_dataclass(a):
        for field in fields(a):
            if field.name not in ignore:
                assert_same(getattr(a, field.name), getattr(b, field.name), ignore)
    elif isinstance(a, float):
        assert a == b or (np.isnan(a) and np.isnan(b))  # type: ignore[call-overload]
    else:
        assert a == b


def assert_all_same(a: list[StepResult], b: list[StepResult], ignore: tuple[str, ...] = ("timings_ms",)) -> None:
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        assert_same(one, other, ignore)


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
    walk = Walk(device)
    results = run(Engine(params_for(rig)), measurements(furnished_room(), walk, rig, FRAMES))
    metres, degrees = worst(results, walk)
    assert metres < 0.02
    assert degrees < 0.3
    assert results[-1].status is FrameStatus.TRACKING


def test_with_perfect_sensors_within_millimetres() -> None:
    results = run(Engine(params_for(Rig())), measurements(furnished_room(), Walk(), Rig(), FRAMES))
    metres, degrees = worst(results, Walk())
    assert metres < 0.005
    assert degrees < 0.05


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


def test_a_start_in_motion_is_told_and_survived() -> None:
    """Turned on while walking: what is known is relative to the first scan, and the tilt is found out."""
    walk = Walk(still=-4.0)
    results = run(Engine(params_for(REAL)), measurements(furnished_room(), walk, REAL, FRAMES))
    assert "moving" in " ".join(n for r in results[:3] for n in r.notices)
    settled = results[20:]
    metres, degrees = worst(settled, walk)
    assert metres < 0.05
    assert degrees < 1.0


def test_extrinsics_are_found_when_they_are_estimated() -> None:
    """Two centimetres and a degree off; a motion that turns about all axes tells them apart."""
    rig = Rig(T_imu_lidar=mounted((0, 0, 0), (0.05, -0.03, -0.10)))
    assumed = replace(rig, T_imu_lidar=mounted((0.7, -0.5, 0.5), (0.065, -0.02, -0.09)))
    walk = Walk(turn=((0.6, 1.4, 0.0), (0.5, 1.9, 0.3), (0.4, 1.7, 1.0)))
    scans = tuple(measurements(furnished_room(), walk, rig, 200))
    before = pose_error(assumed.T_imu_lidar, rig.T_imu_lidar)
    found = run(Engine(params_for(assumed, {"filter.estimate_extrinsics": True})), scans)[-1].state.T_imu_lidar
    kept = run(Engine(params_for(assumed)), scans[:20])[-1].state.T_imu_lidar
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


def test_a_result_tells_its_numbers() -> None:
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


# --- determinism ---------------------------------------------------------------------------------
def test_the_same_run_twice_is_the_same_to_the_bit() -> None:
    assert_all_same(run(Engine(params_for(REAL)), room_walk()), run(Engine(params_for(REAL)), room_walk()))


def fingerprint(results: list[StepResult]) -> str:
    digest = hashlib.sha256()
    for r in results:
        for a in (r.state.T_odom_imu, r.state.b_gyro, r.state.v_odom_imu, r.cloud.points, r.cloud.labels):
            digest.update(np.ascontiguousarray(a).tobytes())
    return digest.hexdigest()


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    code = (
        "from tests.slam.test_engine import *;"
        "print(fingerprint(run(Engine(params_for(REAL)), room_walk(25))), kernels.__name__)"
    )
    prints = set()
    for threads in ("1", "2", "7"):
        environment = os.environ | {"NUMBA_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        environment |= {"OMP_NUM_THREADS": threads, "PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, done.stderr
        prints.add(done.stdout)
    assert len(prints) == 1
    assert fingerprint(run(Engine(params_for(REAL)), room_walk(25))) in prints.pop()


def test_after_the_warm_up_nothing_is_compiled_any_more() -> None:
    """The first frame of a recording, and the first touch of a slider, wait for no compiler."""
    code = """
from app.slam import warmup
from tests.slam.test_engine import *
warmup.compile_kernels()
before = compiled()
engine = Engine(params_for(REAL))
for m in room_walk(16):
    for array in (m.scan.points, m.scan.offsets_ns, m.scan.ring, m.imu.gyro, m.imu.accel, m.imu.stamps_ns):
        array.setflags(write=False)  # as the reader gives them
results = run(engine, room_walk(16)[:14])
engine.relabel(results[-1])
engine.params = engine.params.with_values({"filter.estimate_extrinsics": True})
run(engine, room_walk(16)[14:])
after = compiled()
assert before, "no kernel was found"
print({k: after[k] - n for k, n in before.items() if after[k] != n})
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "{}"


def compiled() -> dict[str, int]:
    """How many signatures each kernel is compiled for."""
    modules = [m for name, m in sys.modules.items() if name.startswith(kernels.__name__ + ".")]
    return {
        f"{m.__name__}.{name}": len(kernel.signatures)
        for m in modules
        for name, kernel in vars(m).items()
        if hasattr(kernel, "signatures") and kernel.__module__ == m.__name__
    }


# --- checkpoints ---------------------------------------------------------------------------------
CHANGES = {25: {"ground.sigma": 0.05}, 35: {"scan.voxel_size": 0.3, "filter.estimate_extrinsics": True}}


def run_with_changes(engine: Engine, begin: int = 0, end: int = FRAMES) -> list[StepResult]:
    results = []
    for k in range(begin, end):
        if k in CHANGES:
            engine.params = engine.params.with_values(CHANGES[k])
        results.append(engine.step(room_walk()[k].scan, room_walk()[k].imu))
    return results


NUMBERING = ("timings_ms", "keyframe")


@pytest.mark.parametrize("at", [0, 4, 9, 10, 24, 30, 50])
def test_a_restored_engine_goes_on_as_if_it_had_never_stopped(at: int) -> None:
    """Before, during and after the start; with parameters changed before and after; back, and in another engine."""
    whole = run_with_changes(Engine(params_for(REAL)))
    engine = Engine(params_for(REAL))
    run_with_changes(engine, 0, at)
    checkpoint: Checkpoint = engine.checkpoint()
    run_with_changes(engine, at, FRAMES)
    engine.restore(checkpoint)
    assert_all_same(run_with_changes(engine, at, FRAMES), whole[at:])

    other = Engine(params_for(REAL))
    other.restore(checkpoint)
    continued = run_with_changes(other, at, FRAMES)
    assert_all_same(continued, whole[at:], NUMBERING)
    assert [r.keyframe is None for r in continued] == [r.keyframe is None for r in whole[at:]]


def test_a_checkpoint_survives_being_written_to_disk() -> None:
    engine = Engine(params_for(REAL))
    run(engine, room_walk()[:20])
    stored = pickle.dumps(engine.checkpoint())
    expected = run(engine, room_walk()[20:])
    other = Engine(params_for(REAL))
    other.restore(pickle.loads(stored))
    assert_all_same(run(other, room_walk()[20:]), expected, NUMBERING)


def test_keyframes_are_those_of_the_time_gone_back_to() -> None:
    engine = Engine(params_for(REAL, {"keyframe.distance": 0.1}))
    run(engine, room_walk()[:30])
    checkpoint, count = engine.checkpoint(), len(engine.keyframes)
    first = run(engine, room_walk()[30:])
    frames = [k.frame for k in engine.keyframes]
    assert len(frames) > count > 1
    engine.restore(checkpoint)
    assert [k.frame for k in engine.keyframes] == frames[:count]
    assert_all_same(run(engine, room_walk()[30:]), first)
    assert [k.frame for k in engine.keyframes] == frames


# --- keyframes -----------------------------------------------------------------------------------
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
        assert_same(stored.cloud, r.cloud)
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
        m = room_walk()[engine.checkpoint().frame]
        engine.params = engine.params.with_values(values)
        assert observe(engine.step(m.scan, m.imu)), values


# --- trouble -------------------------------------------------------------------------------------
def only(scan: Scan, keep: np.ndarray) -> Scan:
    truth = None if scan.truth_ground is None else scan.truth_ground[keep]
    return Scan(scan.stamp_ns, scan.points[keep], scan.offsets_ns[keep], scan.intensity[keep], scan.ring[keep], truth)


def first_points(scan: Scan, count: int) -> Scan:
    return only(scan, np.arange(len(scan)) < count)


@pytest.mark.parametrize("count", [0, 5])
def test_lost_without_points_and_found_again(count: int) -> None:
    """A second with a hand over the sensor."""
    engine, walk = Engine(params_for(REAL)), room_walk(80)
    results = []
    for k, m in enumerate(walk):
        scan = first_points(m.scan, count) if 40 <= k < 50 else m.scan
        results.append(engine.step(scan, m.imu))
    assert [r.index for r in results if r.status is FrameStatus.LOST] == list(range(40, 50))
    assert any("Lost" in n for n in results[40].notices)
    assert any("again" in n for n in results[50].notices)
    assert not any("Lost" in n or "again" in n for r in [*results[:40], *results[51:]] for n in r.notices)
    metres, degrees = worst(results, Walk(), since=52)
    assert metres < 0.03
    assert degrees < 0.5
    during = errors(results, Walk())[40:50, 0].max()
    assert during < 0.3  # carried by the IMU alone


def test_scans_out_of_range_are_as_scans_without_points() -> None:
    engine = Engine(params_for(REAL))
    run(engine, room_walk()[:20])
    m = room_walk()[20]
    for factor in (1e-3, 1e4):
        far = replace(m.scan, points=m.scan.points * np.float32(factor))
        probe = Engine(params_for(REAL))
        probe.restore(engine.checkpoint())
        r = probe.step(far, m.imu)
        assert r.status is FrameStatus.LOST
        assert r.points_in == len(r.cloud) == 0
        assert r.stamp_ns == m.scan.end_ns
        assert not r.ground.found


def test_points_that_are_no_numbers_are_left_out() -> None:
    engine = Engine(params_for(REAL))
    run(engine, room_walk()[:20])
    m = room_walk()[20]
    bad = m.scan.points.copy()
    bad[::7] = np.nan
    bad[3::50, 1] = np.inf
    r = engine.step(replace(m.scan, points=bad), m.imu)
    assert np.isfinite(r.cloud.points).all()
    assert len(r.cloud) == np.isfinite(bad).all(axis=1).sum()
    assert np.isfinite(r.state.T_odom_imu).all()
    assert r.status is FrameStatus.TRACKING


def test_an_empty_first_scan_does_not_end_the_walk() -> None:
    engine = Engine(params_for(REAL))
    results = [engine.step(first_points(m.scan, 0) if k < 15 else m.scan, m.imu) for k, m in enumerate(room_walk())]
    assert results[-1].status is FrameStatus.TRACKING
    assert results[-1].registration.inliers > 100
    metres, _ = worst(results[20:], Walk())
    assert metres < 0.1


def without_imu(walk: Iterable[Measurement], begin_s: float, end_s: float) -> list[Measurement]:
    """The walk with no IMU sample in between, paired as the sequencer pairs: samples around each scan."""
    entries = list(walk)
    stamps, gyro, accel = (np.concatenate([getattr(m.imu, f.name) for m in entries]) for f in fields(ImuSamples))
    stamps, first = np.unique(stamps, return_index=True)
    at = (stamps - START_NS) * 1e-9
    keep = (at <= begin_s) | (at >= end_s)
    stamps, gyro, accel = stamps[keep], gyro[first][keep], accel[first][keep]
    paired, last_ns = [], stamps[0]
    for m in entries:
        a = max(np.searchsorted(stamps, last_ns, side="right") - 1, 0)
        b = np.searchsorted(stamps, m.scan.end_ns)
        paired.append(Measurement(m.scan, ImuSamples(stamps[a : b + 1], gyro[a : b + 1], accel[a : b + 1])))
        last_ns = m.scan.end_ns
    return paired


@pytest.mark.parametrize("seconds", [0.15, 0.5])
def test_a_gap_in_the_imu_is_bridged_by_the_scans(seconds: float) -> None:
    results = run(Engine(params_for(REAL)), without_imu(room_walk(80), 4.02, 4.02 + seconds))
    metres, degrees = worst(results, Walk(), since=55)
    assert metres < 0.05
    assert degrees < 0.7
    assert results[-1].status is FrameStatus.TRACKING


def test_scans_that_are_missing_are_bridged_by_the_imu() -> None:
    """A second without a scan; the next one brings the samples of all that time."""
    walk, rig = room_walk(80), REAL
    gap = [m for k, m in enumerate(walk) if not 40 <= k < 50]
    stamps = np.concatenate([m.imu.stamps_ns for m in walk[40:51]])
    stamps, first = np.unique(stamps, return_index=True)
    joined = ImuSamples(
        stamps,
        np.concatenate([m.imu.gyro for m in walk[40:51]])[first],
        np.concatenate([m.imu.accel for m in walk[40:51]])[first],
    )
    gap[40] = Measurement(gap[40].scan, joined)
    results = run(Engine(params_for(rig)), gap)
    metres, degrees = worst(results, Walk(), since=41)
    assert metres < 0.03
    assert degrees < 0.5


def test_a_scan_from_the_past_breaks_nothing() -> None:
    """The sequencer does not let one through; if a caller does, the engine goes on afterwards."""
    engine = Engine(params_for(REAL))
    results = run(engine, room_walk()[:30])
    engine.step(room_walk()[25].scan, room_walk()[25].imu)
    engine.step(room_walk()[29].scan, room_walk()[29].imu)
    results = run(engine, room_walk()[30:])
    metres, degrees = worst(results, Walk(), since=5)
    assert metres < 0.05
    assert degrees < 1.0


def test_a_full_revolution_of_57632_points_is_taken() -> None:
    rig = replace(REAL, columns=1801)
    engine = Engine(params_for(rig))
    results = run(engine, measurements(furnished_room(), Walk(), rig, 14))
    assert results[-1].points_in == 57_632
    metres, _ = worst(results, Walk())
    assert metres < 0.01
    assert results[-1].registration.used <= engine.params.filter.max_points
    assert len(pattern(1801)[0]) == 57_632


def test_a_person_walking_by_does_not_take_the_map_along() -> None:
    """A moving box within arm's reach, a sixth of the view."""
    engine, walk = Engine(params_for(REAL)), Walk()
    results = []
    for k, m in enumerate(measurements(furnished_room(), walk, REAL, FRAMES)):
        x = 1.2 + 0.02 * k
        scene = Scene(furnished_room().room, (*furnished_room().boxes, box(x, -0.4, -1.3, x + 0.4, 0.4, 0.5)))
        seen = next(iter(measurements(scene, walk, REAL, 1, begin_s=0.05 + k * PERIOD_S)))
        results.append(engine.step(seen.scan, m.imu))
    metres, _ = worst(results, walk)
    assert metres < 0.03


# --- memory --------------------------------------------------------------------------------------
def footprint(engine: Engine) -> int:
    """Bytes of all arrays that the engine holds on to, directly or in the objects it owns."""
    seen: set[int] = set()

    def size(value: object) -> int:
        if id(value) in seen or isinstance(value, Params):
            return 0
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            return value.nbytes
        if is_dataclass(value):
            return sum(size(getattr(value, f.name)) for f in fields(value))
        if isinstance(value, (list, tuple)):
            return sum(size(v) for v in value)
        if hasattr(value, "__dict__"):
            return sum(size(v) for v in vars(value).values())
        return 0

    return size(engine)


def test_memory_stays_flat_however_far_one_walks() -> None:
    """Seventy metres of corridor; what is held after a third of it is held at the end."""
    rig, length = replace(REAL, columns=16), 80.0
    values = {"map.radius": 15.0, "map.max_voxels": 3000, "sensor.max_range": 12.0}
    engine = Engine(params_for(rig, values))
    walk, frames = replace(ALONG, speed=(2.0, 0.0, 0.0)), 400
    held, voxels = [], []
    for m in measurements(corridor(length, pillars=True), walk, rig, frames):
        r = engine.step(m.scan, m.imu)
        held.append(footprint(engine))
        voxels.append(len(engine.checkpoint().map.cells) if r.index % 20 == 0 else 0)
    assert r.state.p_odom_imu @ r.state.p_odom_imu > 60**2
    third = frames // 3
    assert max(held[third:]) <= 1.02 * max(held[:third])
    assert 0 < max(voxels[third:]) <= 1.2 * max(voxels[:third]) < 3000
    assert len(engine.keyframes) > 100
    engine.close()
