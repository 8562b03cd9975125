"""Each imperfection of the simulator does what it says, and nothing else.

Tests app/sensors/simulator/imperfections.py.
"""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from app.sensors.simulator import simulate
from app.sensors.simulator.imperfections import IMPERFECT, NONE, Imperfections, Unit, companions, livelier
from app.sensors.simulator.lidar import Lidar, firing_pattern
from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import Raycaster
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.trajectory import SmoothTrajectory, Walker
from app.slam.errors import HemislamError
from app.slam.types import F64, ImuSamples, Scan

EPOCH_NS = 1_700_000_000_000_000_000
PATTERN = firing_pattern(every_block=12)
EXACT = Lidar(range_noise=0.0, range_step=0.0, lossless=True)


def walking() -> SmoothTrajectory:
    """From (0, 0, 1.25) along +x at 1 m/s."""
    t = np.linspace(-1.0, 5.0, 61)
    zero = np.zeros_like(t)
    return SmoothTrajectory(t, np.column_stack([t, zero, 1.25 + zero, zero, zero, zero]))


def room(pane: bool = False) -> MeshBuilder:
    """A wall 8 m ahead, and perhaps a pane before it."""
    mesh = MeshBuilder()
    mesh.quad([(8, -200, -200), (8, 200, -200), (8, 200, 200), (8, -200, 200)], 0.9)
    if pane:
        mesh.quad([(4, -200, -200), (4, 200, -200), (4, 200, 200), (4, -200, 200)], 0.02)
    return mesh


def fire(errors: Imperfections, mesh: MeshBuilder) -> Scan:
    unit = Unit(errors, np.random.default_rng(1))
    caster = Raycaster(mesh.build())
    return replace(EXACT, unit=unit).turn(PATTERN, caster, walking(), 0.05, EPOCH_NS, np.random.default_rng(2))


def away(scan: Scan) -> F64:
    """(n,) m, each range less that of a perfect scanner before the same wall, firing by firing."""
    perfect = fire(NONE, room())
    both = np.intersect1d(scan.offsets_ns, perfect.offsets_ns, return_indices=True)
    assert len(both[0]) > 0.9 * len(perfect)
    mine, theirs = (np.linalg.norm(s.points[k], axis=1) for s, k in ((scan, both[1]), (perfect, both[2])))
    return np.asarray(mine - theirs, np.float64)


def test_without_imperfections_a_unit_changes_nothing() -> None:
    assert np.abs(away(fire(NONE, room()))).max() < 1e-5


def test_a_biased_channel_is_off_by_the_same_distance_in_every_firing() -> None:
    scan = fire(Imperfections(range_bias=0.01), room())
    off = away(scan)
    by_ring = [off[scan.ring == ring] for ring in np.unique(scan.ring)]
    assert max(np.ptp(values) for values in by_ring) < 1e-3
    assert 0.006 < np.std([values.mean() for values in by_ring]) < 0.015


def test_a_channels_elevation_error_bends_its_cone() -> None:
    unit = Unit(Imperfections(elevation=0.12), np.random.default_rng(1))
    pattern = PATTERN
    bent, _ = unit.fired(pattern.directions, pattern.levers)
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1.0)
    change = np.degrees(np.arcsin(bent[:, 2]) - np.arcsin(pattern.directions[:, 2])).reshape(-1, 32)
    np.testing.assert_allclose(change, change[:1].repeat(len(change), axis=0), atol=1e-6)
    assert 0.07 < change[0].std() < 0.18


def test_grazing_returns_come_from_too_far() -> None:
    off = away(fire(Imperfections(incidence_bias=0.012), room()))
    assert off.min() > -1e-5 and 0.004 < off.max() < 0.012


def test_range_noise_has_its_spread() -> None:
    assert abs(away(fire(Imperfections(range_noise=0.017), room())).std() - 0.017) < 0.001


def test_beside_an_edge_some_returns_land_in_between() -> None:
    mesh = room()
    mesh.box((4.0, 0.0, 1.25), (0.1, 3.0, 3.0), 0.9)
    depth = fire(Imperfections(mixed=1.0), mesh).points[:, 2]  # z looks along the wall's normal
    clean = fire(NONE, mesh).points[:, 2]
    mixed, none = (np.count_nonzero((z > 4.2) & (z < 7.7)) for z in (depth, clean))
    assert mixed > 10 and none == 0


def test_beams_pass_a_pane_and_return_from_behind_it() -> None:
    depth = fire(Imperfections(glass=0.5), room(pane=True)).points[:, 2]
    assert 0.45 < np.mean(depth > 6.0) < 0.55
    assert np.median(np.abs(depth[depth > 6.0] - 8.0)) < 0.2


def test_the_mounting_differs_by_its_angle_and_distance() -> None:
    pattern = PATTERN
    unit = Unit(Imperfections(mount_rotation=0.7, mount_translation=0.01), np.random.default_rng(3))
    directions, levers = unit.fired(pattern.directions, pattern.levers)
    R, *_ = np.linalg.lstsq(pattern.directions, directions, rcond=None)
    assert abs(np.degrees(np.arccos((np.trace(R) - 1) / 2)) - 0.7) < 1e-6
    shift = levers - pattern.levers @ R
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), 0.01, atol=1e-9)


def imu(errors: Imperfections, gyro: float = 1.0, n: int = 20_000) -> tuple[ImuSamples, ImuSamples]:
    """Samples at 200 Hz of an IMU that turns and is pushed about all axes, without and with the errors."""
    stamps = EPOCH_NS + np.arange(n, dtype=np.int64) * 5_000_000
    rng = np.random.default_rng(4)
    good = ImuSamples(stamps, gyro * rng.normal(size=(n, 3)), 5.0 * gyro * rng.normal(size=(n, 3)))
    return good, Unit(errors, np.random.default_rng(5)).felt(good, EPOCH_NS, np.random.default_rng(6))


def test_an_imu_scales_and_mixes_its_axes() -> None:
    good, felt = imu(Imperfections(gyro_scale=0.004, accel_scale=0.008, misalignment=0.2))
    for true, measured, scale in ((good.gyro, felt.gyro, 0.004), (good.accel, felt.accel, 0.008)):
        M = np.linalg.lstsq(true, measured, rcond=None)[0] - np.eye(3)
        off = M[~np.eye(3, dtype=bool)]
        assert 0 < np.abs(np.diag(M)).max() < 3 * scale
        assert 0 < np.abs(off).max() < 3 * np.radians(0.2)


def test_the_motor_shakes_the_imu_at_its_frequencies() -> None:
    _, felt = imu(Imperfections(gyro_vibration=0.02, accel_vibration=0.4), gyro=0.0)
    for values, size in ((felt.gyro, 0.02), (felt.accel, 0.4)):
        assert abs(np.abs(values).max() - size) < 0.05 * size
        peaks = np.fft.rfftfreq(len(values), 0.005)[np.abs(np.fft.rfft(values, axis=0)).argmax(axis=0)]
        assert ((peaks > 25) & (peaks < 70)).all()


def test_samples_are_lost_and_stamps_are_late_and_shaky() -> None:
    good, felt = imu(Imperfections(lost=0.004, jitter=2e-4, late=6e-3))
    assert 0.002 < 1 - len(felt) / len(good) < 0.007
    late = felt.stamps_ns - good.stamps_ns[np.rint((felt.stamps_ns - EPOCH_NS - 6e6) / 5e6).astype(int)]
    assert abs(late.mean() * 1e-9 - 6e-3) < 1e-5 and abs(late.std() * 1e-9 - 2e-4) < 1e-5
    assert (np.diff(felt.stamps_ns) > 0).all()


def test_companions_stay_one_to_three_metres_away_and_stand_on_the_ground() -> None:
    trajectory = walking()
    slope = replace(build_scene("room", 0), height=lambda xy: 0.1 * xy[:, 0])
    people = companions(3, trajectory, slope, np.random.default_rng(0))
    t = np.arange(0.0, 4.0, 0.05)
    where = np.array([person.pose(t)[0] for person in people])
    apart = where[:, :, :2] - trajectory.poses(t)[0][:, :2]
    distance = np.linalg.norm(apart, axis=2)
    assert len(people) == 3 and distance.min() > 1.0 and distance.max() < 3.2
    np.testing.assert_allclose(where[:, :, 2], 0.1 * where[:, :, 0])
    assert (apart[0, :, 0] > 0).all() and (apart[1, :, 0] < 0).all()
    crossing = np.concatenate(
        [companions(3, trajectory, slope, np.random.default_rng(k))[2].pose(t)[0] for k in (1, 2)]
    )
    assert crossing[:, 1].min() < 0 < crossing[:, 1].max()


def test_a_lively_hand_moves_so_many_times_as_much() -> None:
    assert livelier(Walker(), 3.0).pitch == 3 * Walker().pitch
    assert livelier(Walker(), 0.0) == Walker()


def test_sizes_are_set_by_name() -> None:
    assert NONE.with_sizes(["late=0.006"]) == Imperfections(late=0.006)
    assert IMPERFECT.with_sizes(["companions=0"]).companions == 0
    assert all(getattr(IMPERFECT, field.name) > 0 for field in fields(IMPERFECT))
    for wrong in ("delay=1", "late=soon", "late", "late=-1"):
        with pytest.raises(HemislamError, match=f"`{wrong}` is not NAME=VALUE with a NAME of accel_scale"):
            NONE.with_sizes([wrong])
    for wrong in ("late=1e30", "jitter=3601"):
        with pytest.raises(HemislamError, match="by more than an hour"):
            NONE.with_sizes([wrong])


def test_an_imu_may_lose_every_sample(tmp_path: Path) -> None:
    made = simulate("room", tmp_path / "walk.mcap", duration_s=0.5, every_block=90, imperfections=Imperfections(lost=1))
    assert made.scans == 4


def test_an_imperfect_recording_keeps_the_exact_truth_of_the_same_walk(tmp_path: Path) -> None:
    sizes = replace(IMPERFECT, hand=0.0)
    for name, imperfections in (("clean", NONE), ("real", sizes), ("again", sizes)):
        simulate("room", tmp_path / f"{name}.mcap", duration_s=1.0, seed=2, every_block=30, imperfections=imperfections)
    poses = [np.loadtxt(tmp_path / f"{name}_truth.tum") for name in ("clean", "real")]
    np.testing.assert_allclose(poses[1][:, 1:], poses[0][:, 1:], atol=1e-3)
    real, again = ((tmp_path / f"{name}.mcap").read_bytes() for name in ("real", "again"))
    assert real == again
