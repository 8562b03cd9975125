"""A pause of both sensors: where the walk continues, and how accurately."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from app.slam import iekf, lie, pause
from app.slam.engine import Engine
from app.slam.imu import DIM, EXT, GRAV, POS, ROT, VEL, Belief
from app.slam.kernels import manifold
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.sections import MapParams
from app.slam.types import ImuSamples, Measurement, Scan, StepResult
from tests.slam.engine_runs import REAL, assert_all_same, errors, room_walk, run
from tests.slam.scenes import Walk, furnished_room, imu_samples, measurements, params_for, seconds_of
from tests.slam.updates import points_of, truth, uncertain

BEGIN, END = 40, 62
"""Frames of the pause, which lasts 2.2 s."""


@cache
def long_walk() -> tuple[Measurement, ...]:
    return tuple(measurements(furnished_room(), Walk(), REAL, 120))


def cut(walk: tuple[Measurement, ...], begin: int = BEGIN, end: int = END) -> list[Measurement]:
    """The walk as recorded by one who pauses the recorder: neither scans nor samples from `begin` to before `end`."""
    first, last = walk[end], walk[begin - 1].imu
    stamps, gyro, accel = (
        np.concatenate([getattr(last, name)[-1:], getattr(first.imu, name)[1:]])
        for name in ("stamps_ns", "gyro", "accel")
    )
    return [*walk[:begin], replace(first, imu=ImuSamples(stamps, gyro, accel)), *walk[end + 1 :]]


def tilts(results: list[StepResult]) -> np.ndarray:
    """Degrees between the true vertical and odom's, at each frame."""
    up = np.array([r.state.R_odom_imu.T @ [0, 0, 1] for r in results])
    true = np.array([Walk().pose(seconds_of(r.stamp_ns))[:3, :3].T @ [0, 0, 1] for r in results])
    return np.degrees(np.arccos(np.clip((up * true).sum(axis=1), -1, 1)))


def test_the_walk_goes_on_where_it_stopped_facing_the_same_way() -> None:
    results = run(Engine(params_for(REAL)), cut(long_walk())[: BEGIN + 1])
    before, after = results[-2].state, results[-1].state
    moved = lie.inverse(before.T_odom_imu) @ after.T_odom_imu
    assert np.linalg.norm(moved[:3, 3]) < 0.1
    turned = before.R_odom_imu @ moved[:3, :3] @ before.R_odom_imu.T
    assert abs(np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))) < 5.0
    (notice,) = results[-1].notices
    assert "neither scans nor IMU samples for 2.2 s" in notice
    assert results[-1].imu_gap_s == pytest.approx(2.2, abs=0.02)


@pytest.mark.parametrize(("begin", "end"), [(BEGIN, END), (55, 85)])
def test_after_the_pause_the_motion_is_known_as_well_as_before(begin: int, end: int) -> None:
    """Whatever way was taken meanwhile; and odom is level once keyframes go on."""
    results = run(Engine(params_for(REAL)), cut(long_walk(), begin, end))
    (first,) = [k for k, r in enumerate(results) if r.keyframe is not None and r.keyframe.resumed_ns]
    since = results[first:]
    metres, degrees = errors(since, Walk()).max(axis=0)
    assert metres < 0.03
    assert degrees < 0.7
    assert tilts(since).max() < 1.0
    assert results[first].keyframe.resumed_ns == long_walk()[end].scan.stamp_ns  # type: ignore[union-attr]
    assert not any(r.keyframe for r in results[begin:first])
    assert (results[first].stamp_ns - results[begin].stamp_ns) * 1e-9 == pytest.approx(pause.SETTLED_S, abs=0.2)


def test_at_rest_after_a_pause_scans_tell_nothing_of_the_mounting() -> None:
    points, prior = points_of(furnished_room()), Belief(truth(), uncertain())
    scan = Scan(truth().stamp_ns + 3 * 10**9, points, *(np.zeros(len(points), k) for k in (np.int32, "f4", "u2")))
    samples = imu_samples(Walk(still=100), REAL, np.arange(0, 21) / 200)
    samples = replace(samples, stamps_ns=scan.stamp_ns - 50_000_000 + np.arange(21) * 5_000_000)
    interruption = pause.before(scan, samples, truth().stamp_ns)
    assert interruption is not None
    belief, _ = pause.resumed(prior, interruption, scan, samples, Params())
    local_map, T = LocalMap(MapParams()), belief.state.T_odom_lidar
    local_map.insert(lie.moved(T, points).astype(np.float32), T[:3, 3], MapParams())
    known = np.diag(belief.covariance)[EXT]
    for _ in range(3):
        belief, registration = iekf.update(belief, points, local_map, Params().filter)
    assert registration.inliers > 300
    np.testing.assert_allclose(np.diag(belief.covariance)[EXT], known, rtol=0.02)


def test_without_an_imu_the_walk_goes_on_too() -> None:
    silent = ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
    results = run(Engine(params_for(REAL)), [replace(m, imu=silent) for m in cut(long_walk())])
    (first,) = [k for k, r in enumerate(results) if r.keyframe is not None and r.keyframe.resumed_ns]
    metres, degrees = errors(results[first:], Walk()).max(axis=0)
    assert metres < 0.06
    assert degrees < 1.5


def test_an_imu_that_does_not_come_back_leaves_the_rest_to_the_scans() -> None:
    walk = cut(long_walk())
    last = walk[BEGIN - 1].imu
    stale = ImuSamples(last.stamps_ns[-1:], last.gyro[-1:], last.accel[-1:])
    results = run(Engine(params_for(REAL)), [replace(m, imu=stale) if k >= BEGIN else m for k, m in enumerate(walk)])
    metres, degrees = errors(results[BEGIN + 20 :], Walk()).max(axis=0)
    assert metres < 0.06
    assert degrees < 1.5


def test_after_a_second_pause_before_any_keyframe_the_map_begins_anew_again() -> None:
    walk = cut(tuple(cut(long_walk())), BEGIN + 5, BEGIN + 25)
    results = run(Engine(params_for(REAL)), walk)
    (keyframe,) = [r.keyframe for r in results if r.keyframe is not None and r.keyframe.resumed_ns]
    assert keyframe.resumed_ns == walk[BEGIN + 5].scan.stamp_ns
    assert len([notice for r in results for notice in r.notices if "begins anew" in notice]) == 2


def test_a_shorter_gap_is_no_pause() -> None:
    results = run(Engine(params_for(REAL)), cut(room_walk(80), 40, 52))
    assert not any(r.keyframe.resumed_ns for r in results if r.keyframe is not None)
    assert not any("begins anew" in notice for r in results for notice in r.notices)


def test_going_back_into_it_repeats_it_to_the_last_bit() -> None:
    walk, engine = cut(long_walk()), Engine(params_for(REAL))
    run(engine, walk[: BEGIN + 5])
    state = engine.checkpoint()
    there = run(engine, walk[BEGIN + 5 :])
    engine.restore(state)
    assert_all_same(there, run(engine, walk[BEGIN + 5 :]))


@pytest.mark.parametrize("seed", range(5))
def test_levelling_turns_gravity_down_and_changes_nothing_as_seen_from_the_device(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = run(Engine(params_for(REAL)), room_walk()[:1])[0].state
    g = lie.exp(rng.normal(0, 0.1, 3)) @ [0.0, 0.0, -9.81]
    state = replace(state, R_odom_imu=lie.exp(rng.normal(size=3)), v_odom_imu=rng.normal(size=3), g_odom=g)
    root = rng.normal(size=(DIM, DIM))
    level = pause.levelled(Belief(state, root @ root.T))
    np.testing.assert_allclose(level.state.g_odom, [0, 0, -np.linalg.norm(g)], atol=1e-9)
    np.testing.assert_allclose(level.state.p_odom_imu, state.p_odom_imu)

    def seen(belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and gravity in the device's axes, and the covariance of all with them there."""
        here, turn = belief.state, np.eye(DIM + 1)[:, :DIM]
        R = here.R_odom_imu.T
        turn[POS, POS] = turn[VEL, VEL] = R
        turn = np.delete(turn, [GRAV.start, GRAV.start + 1, DIM], axis=0)
        tangent = np.zeros((3, DIM))
        tangent[:, GRAV] = R @ lie.hat(here.g_odom) @ manifold.tangent_basis(here.g_odom)
        whole = np.vstack([turn, tangent])
        return np.r_[R @ here.v_odom_imu, R @ here.g_odom], whole @ belief.covariance @ whole.T

    for before, after in zip(seen(Belief(state, root @ root.T)), seen(level), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-9)
    assert level.covariance[ROT, ROT] == pytest.approx((root @ root.T)[ROT, ROT])
