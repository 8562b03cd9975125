"""The engine with bad scans, gaps, and people who block the view.

Tests app/slam/prediction.py and app/slam/fusion.py.
"""

from collections.abc import Callable, Iterable
from dataclasses import fields, replace

import numpy as np
import pytest

from app.slam import iekf, lie
from app.slam.certainty import WRONG_SPEED, Doubt
from app.slam.engine import Engine
from app.slam.types import FrameStatus, ImuSamples, Measurement, NavState, Scan
from tests.slam.engine_runs import FRAMES, REAL, assert_all_same, errors, room_walk, run, worst
from tests.slam.scenes import (
    PERIOD_S,
    START_NS,
    Scene,
    Walk,
    box,
    furnished_room,
    measurements,
    params_for,
    pattern,
)


def only(scan: Scan, keep: np.ndarray) -> Scan:
    truth = None if scan.truth_ground is None else scan.truth_ground[keep]
    return Scan(scan.stamp_ns, scan.points[keep], scan.offsets_ns[keep], scan.intensity[keep], scan.ring[keep], truth)


def first_points(scan: Scan, count: int) -> Scan:
    return only(scan, np.arange(len(scan)) < count)


@pytest.mark.parametrize("name", ["points", "offsets_ns", "intensity", "ring", "truth_ground", "gyro", "stamps_ns"])
def test_arrays_of_different_lengths_are_refused(name: str) -> None:
    """As if returns without a range were left out of the points alone; the kernels would read beyond the others."""
    rows = {"points": (7, 3), "offsets_ns": 7, "intensity": 7, "ring": 7, "truth_ground": 7}
    samples = {"stamps_ns": 7, "gyro": (7, 3), "accel": (7, 3)}
    whole, make = (rows, lambda **of: Scan(0, **of)) if name in rows else (samples, ImuSamples)
    arrays = {column: np.ones(shape, np.float32) for column, shape in whole.items()}
    assert len(make(**arrays)) == 7
    with pytest.raises(ValueError, match=r"\(6,"):
        make(**arrays | {name: arrays[name][:-1]})


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
    assert degrees < 0.8
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


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
@pytest.mark.parametrize("since", [0, 30])
def test_samples_without_a_measurement_are_left_out_and_said_to_be(value: float, since: int) -> None:
    """As an IMU sends them while it starts, or loses its sensor for some scans."""
    walk = list(room_walk(60))
    for k in range(since, since + 5):
        bad = np.full_like(walk[k].imu.gyro, value)
        walk[k] = replace(walk[k], imu=replace(walk[k].imu, gyro=bad, accel=bad))
    results = run(Engine(params_for(REAL)), walk)
    assert all("IMU samples hold no measurement" in r.notices[0] for r in results[since : since + 5])
    assert not any("no measurement" in n for r in [*results[:since], *results[since + 5 :]] for n in r.notices)
    assert all(r.status is FrameStatus.TRACKING for r in results[since + 10 :])
    assert worst(results, Walk(), since=since + 10)[0] < 0.1


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


@pytest.mark.parametrize("seconds", [0.15, 0.5, 2.0])
def test_a_gap_in_the_imu_is_bridged_by_the_scans(seconds: float) -> None:
    results = run(Engine(params_for(REAL)), without_imu(room_walk(80), 4.02, 4.02 + seconds))
    metres, degrees = worst(results, Walk(), since=41)
    assert metres < 0.03
    assert degrees < 0.7
    assert results[-1].status is FrameStatus.TRACKING


def test_biases_that_leap_are_found_again() -> None:
    """The IMU is knocked amid the walk: from then on it is off by 1.1 deg/s and 0.5 m/s² on each axis."""
    walk = [
        replace(m, imu=replace(m.imu, gyro=m.imu.gyro + 0.02, accel=m.imu.accel + 0.5)) if k > 40 else m
        for k, m in enumerate(room_walk(80))
    ]
    results = run(Engine(params_for(REAL)), walk)
    metres, degrees = worst(results, Walk(), since=60)
    assert metres < 0.03
    assert degrees < 0.5
    np.testing.assert_allclose(results[-1].state.b_gyro, np.array(REAL.b_gyro) + 0.02, atol=0.005)
    assert max(r.registration.surprise for r in results[41:50]) > iekf.SURPRISING


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        lambda here: replace(here, v_odom_imu=here.v_odom_imu + np.array([1.0, 0.0, 0.0])),
        lambda here: replace(here, v_odom_imu=here.v_odom_imu + np.array([1.0, 1.0, 0.0])),
        lambda here: replace(here, R_odom_imu=lie.exp(np.array([0.0, 0.14, 0.0])) @ here.R_odom_imu),
    ],
    ids=["speed", "more speed", "tilt"],
)
def test_a_speed_or_tilt_that_went_wrong_is_found_again(change: Callable[[NavState], NavState], known: bool) -> None:
    """The filter is sure of it, as after four seconds in which scans show little. In a place that is not known yet,
    every scan is mapped where the wrong speed puts it."""
    engine, walk = Engine(params_for(REAL)), room_walk(80)
    nothing = engine.checkpoint().map
    before = run(engine, walk[:40])
    state = engine.checkpoint()
    assert state.progress.belief is not None
    belief = replace(state.progress.belief, state=change(state.progress.belief.state))
    place = state.map if known else nothing
    engine.restore(replace(state, map=place, progress=replace(state.progress, belief=belief, doubt=Doubt(4.0))))
    after = run(engine, walk[40:])
    assert {r.keyframe.astray for r in before if r.keyframe} == {0.0}
    doubts = [r.keyframe.astray for r in after if r.keyframe]
    assert max(doubts) == pytest.approx(WRONG_SPEED * 4.0, abs=0.3)
    assert np.count_nonzero(doubts) < 3
    metres, _ = worst([*before, *after], Walk(), since=50)
    assert metres < 0.3


def test_a_scan_that_a_wrong_imu_has_bent_is_set_straight_by_itself() -> None:
    """The device hits a door frame, and for 30 ms its IMU measures far more than there was."""

    def knocked(m: Measurement) -> Measurement:
        during = np.abs((m.imu.stamps_ns - START_NS) * 1e-9 - 4.015) < 0.015
        gyro = m.imu.gyro + np.outer(during, [2.0, 1.0, -2.0])
        return replace(m, imu=replace(m.imu, gyro=gyro, accel=m.imu.accel + np.outer(during, [40.0, 20.0, -30.0])))

    results = run(Engine(params_for(REAL)), map(knocked, room_walk(70)))
    assert max(r.registration.surprise for r in results[38:42]) > iekf.SURPRISING  # told as a contradiction
    metres, degrees = worst(results, Walk())
    assert metres < 0.015
    assert degrees < 0.5


@pytest.mark.parametrize("begin_s", [0.35, 2.02, 4.02])
def test_an_imu_that_stops_for_good_leaves_the_walk_to_the_scans(begin_s: float) -> None:
    """It stops while the device still rests for the start, at the first steps, or amid the walk."""
    results = run(Engine(params_for(REAL)), without_imu(room_walk(80), begin_s, 1e3))
    metres, degrees = worst(results, Walk())
    assert metres < 0.05
    assert degrees < 0.7
    assert results[-1].status is FrameStatus.TRACKING
    assert results[-1].imu_gap_s == pytest.approx(8.0 - begin_s, abs=0.1)


def test_going_back_into_a_gap_of_the_imu_repeats_it_to_the_last_bit() -> None:
    walk, engine = without_imu(room_walk(80), 4.02, 6.02), Engine(params_for(REAL))
    run(engine, walk[:50])
    kept = engine.checkpoint()
    first = run(engine, walk[50:])
    engine.restore(kept)
    assert_all_same(first, run(engine, walk[50:]))


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
    before = run(engine, room_walk(60)[:30])
    engine.step(room_walk()[25].scan, room_walk()[25].imu)
    engine.step(room_walk()[29].scan, room_walk()[29].imu)
    metres, degrees = worst([*before, *run(engine, room_walk(60)[30:])], Walk(), since=40)
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
    """A box that moves at 0.2 m/s within arm's reach, a sixth of the view."""
    engine, walk = Engine(params_for(REAL)), Walk()
    results = []
    for k, m in enumerate(measurements(furnished_room(), walk, REAL, FRAMES)):
        x = 1.2 + 0.02 * k
        scene = Scene(furnished_room().room, (*furnished_room().boxes, box(x, -0.4, -1.3, x + 0.4, 0.4, 0.5)))
        seen = next(iter(measurements(scene, walk, REAL, 1, begin_s=0.05 + k * PERIOD_S)))
        results.append(engine.step(seen.scan, m.imu))
    metres, _ = worst(results, walk)
    assert metres < 0.06


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")  # that is the point of these numbers
@pytest.mark.parametrize("value", [1e300, np.inf, np.nan])
@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_samples_that_break_the_numbers_cost_no_more_than_their_frames(sensor: str, value: float) -> None:
    """Whoever drives the engine without the sequencer may hand it anything."""
    engine, results = Engine(params_for(REAL)), []
    for k, m in enumerate(room_walk(60)):
        imu = m.imu
        if k == 40:
            values = getattr(imu, sensor).copy()
            values[len(values) // 2] = value
            imu = replace(imu, **{sensor: values})
        results.append(engine.step(m.scan, imu))
    for result in results:
        assert np.isfinite(result.state.T_odom_imu).all() and np.isfinite(result.state.v_odom_imu).all()
    metres, _ = worst(results, Walk(), since=45)
    assert metres < 0.1 or results[-1].status is FrameStatus.LOST


@pytest.mark.parametrize(("end_m", "known"), [(5.0, True), (200.0, False)])
def test_the_position_is_known_only_where_scans_show_the_motion(end_m: float, known: bool) -> None:
    """A bare corridor, whose ends are seen or far beyond the scanner's reach."""
    corridor = Scene(box(-end_m, -1.0, -1.3, end_m, 1.0, 1.4))
    results = run(Engine(params_for(REAL)), measurements(corridor, Walk(), REAL, FRAMES))
    sigma = np.array([r.position_sigma for r in results if r.status is FrameStatus.TRACKING])
    assert (sigma[-10:] < 0.03).all() if known else (sigma[-10:] > 0.1).all()
