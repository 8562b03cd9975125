"""Align a walk with satellite fixes. Oracle: the curve from which both were made.

Tests app/georeference/align.py, app/georeference/ground.py, app/georeference/path.py.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.georeference.align import Alignment, align
from app.georeference.fixes import Fixes
from app.georeference.ledger import summary
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import F64
from tests.georeference.walks import LEVER, LINE, LOOP, TRUTH, Walked, off, walked


def verdicts(found: Alignment, made: Walked) -> tuple[set[int], int]:
    """The wild fixes that were taken, and how many sound ones were not."""
    rejected = {int(name) for name, used in zip(found.names, found.used, strict=True) if not used}
    wild = set(made.outliers.tolist()) & set(map(int, found.names))
    return wild - rejected, len(rejected - wild)


def test_a_walk_with_a_late_receiver_and_wild_fixes_is_placed_to_centimetres() -> None:
    made = walked()
    found = align(made.trajectory, made.fixes, grid="EPSG:32632", lever=LEVER)
    assert found.offset_s == pytest.approx(0.08, abs=0.002) and found.offset_sigma_s < 0.002
    assert np.sqrt((off(found.reference, made.trajectory) ** 2).mean()) < 0.02
    missed, wronged = verdicts(found, made)
    assert not missed and wronged <= 0.01 * len(found.names)  # 0.1 % of the sound ones are expected
    assert found.reference.scale == pytest.approx(TRUTH.scale, abs=1e-6)


@pytest.mark.parametrize("rate", [0.0, 5e-3])
def test_the_stated_uncertainty_of_the_offset_counts_the_drift_of_the_map(rate: float) -> None:
    """Over walks that drift by `rate` (m/√s), the errors are as large as stated."""
    ratios = []
    for seed in range(6):
        made, rng = walked(seed=seed, rate_hz=4.0), np.random.default_rng(seed)
        drift = rate * 0.1**0.5 * rng.normal(size=made.trajectory.positions.shape).cumsum(axis=0)
        rotations = made.trajectory.rotations.as_quat()
        drifted = Trajectory(made.trajectory.stamps_ns, made.trajectory.positions + drift, rotations)
        found = align(drifted, made.fixes, lever=LEVER)
        ratios.append((found.offset_s - 0.08) / found.offset_sigma_s)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 2.0


@pytest.mark.parametrize("path", [LOOP, LINE])
def test_a_tilt_that_the_accelerometer_left_is_taken_out_as_far_as_the_walk_shows_it(path: F64) -> None:
    """On a straight line nothing tells how the map is turned about it; then it stays as level as it was."""
    made = walked(path=path)
    tilt = lie.from_rpy_degrees((0.4, -0.3, 0.0))
    rotations = Rotation.from_matrix(tilt) * made.trajectory.rotations
    leaning = Trajectory(made.trajectory.stamps_ns, made.trajectory.positions @ tilt.T, rotations.as_quat())
    found = align(leaning, made.fixes, lever=LEVER).reference
    far = np.random.default_rng(1).uniform((-30, -30, -2), (50, 45, 10), (1000, 3))
    error = np.linalg.norm(found.to_crs(far @ tilt.T) - TRUTH.to_crs(far), axis=1)
    if path is LOOP:
        assert np.sqrt((error**2).mean()) < 0.02
    assert np.degrees(np.arccos(found.rotation[2][2])) < 0.6
    along = np.column_stack([np.linspace(0, 25, 50), np.zeros((50, 2))])
    assert np.abs(found.to_crs(along @ tilt.T) - TRUTH.to_crs(along))[:, 2].max() < 0.02


def test_the_lever_arm_is_found_with_its_uncertainty_where_the_hand_turns_enough() -> None:
    made = walked(outliers=0.0)
    found = align(made.trajectory, made.fixes)
    assert found.lever_sigma < 0.05
    assert np.abs(np.subtract(found.lever_arm, LEVER)).max() < 4 * found.lever_sigma


@pytest.mark.parametrize("walk", ["hall_bpearl", "outdoor_bpearl"])
def test_an_antenna_ahead_of_the_walker_is_not_taken_for_an_early_clock(walk: str, shared_data: Path) -> None:
    trajectory, lever = read_tum(shared_data / f"{walk}_truth.tum"), (0.0, 0.0, 0.5)
    positions, rotations, some = trajectory.positions, trajectory.rotations, slice(5, -5, 2)
    places = (positions + rotations.apply(lever))[some]
    places += np.random.default_rng(0).normal(0.0, 0.01, places.shape)
    fixes = Fixes.of(trajectory.stamps_ns[some], TRUTH.to_geographic(places), np.full(places.shape, 0.01))
    found = align(trajectory, fixes)
    assert abs(found.offset_s) < 0.01
    assert np.abs(np.subtract(found.lever_arm, lever)).max() < 4 * found.lever_sigma < 0.08


def test_a_lever_arm_left_out_shows_in_the_residuals() -> None:
    made = walked(outliers=0.0)
    with_it, without = (align(made.trajectory, made.fixes, lever=lever) for lever in (LEVER, (0.0, 0.0, 0.0)))
    assert with_it.rms.max() < 0.03 < 0.1 < without.rms.max()


def test_a_receiver_that_is_seconds_late_is_aligned_by_its_motion() -> None:
    made = walked(offset_s=-7.3, lever=(0.0, 0.0, 0.0))
    assert align(made.trajectory, made.fixes, lever=(0.0, 0.0, 0.0)).offset_s == pytest.approx(-7.3, abs=0.003)


def test_fixes_without_a_covariance_are_judged_by_their_scatter() -> None:
    made = walked()
    blind = replace(made.fixes, sigmas=np.full((len(made.fixes), 3), np.nan))
    found = align(made.trajectory, blind, lever=LEVER)
    assert "have no covariance" in found.notes[0]
    assert found.offset_s == pytest.approx(0.08, abs=0.002)
    assert not verdicts(found, made)[0]


def test_fixes_of_which_some_have_no_covariance_are_counted() -> None:
    made = walked()
    sigmas = made.fixes.sigmas.copy()
    sigmas[:100] = np.nan
    note = align(made.trajectory, replace(made.fixes, sigmas=sigmas), lever=LEVER).notes[0]
    assert note.startswith("100 of ") and "have no covariance" in note


def test_fixes_much_worse_than_they_report_are_said_to_be() -> None:
    made = walked(noise=0.2, outliers=0.0)
    proud = replace(made.fixes, sigmas=made.fixes.sigmas / 10)
    notes = align(made.trajectory, proud, lever=LEVER).notes
    assert "10 times as far from the map as they report" in notes[-1]
    assert not align(made.trajectory, made.fixes, lever=LEVER).notes


@pytest.mark.parametrize("degrees", [0.0, np.pi / 180])
def test_a_receiver_that_is_stuck_or_gives_radians_does_not_place_the_map(degrees: float) -> None:
    made = walked(rate_hz=2.0)
    places = made.fixes.places * [degrees, degrees, 1.0] + [0.0 if degrees else 48.0, 0.0 if degrees else 11.0, 0.0]
    with pytest.raises(HemislamError, match="do not follow the trajectory"):
        align(made.trajectory, Fixes.of(made.fixes.stamps_ns, places, made.fixes.sigmas), lever=LEVER)


def test_a_straight_walk_with_the_antenna_above_shows_no_lever_arm_and_says_so() -> None:
    made = walked(path=LINE, noise=0.5, outliers=0.0, lever=(0.0, 0.0, 0.0), rate_hz=1.0, duration_s=40.0)
    found = align(made.trajectory, made.fixes)
    assert found.lever_arm == (0.0, 0.0, 0.0) and "lever arm" in " ".join(found.notes)


def test_swapped_latitude_and_longitude_are_recognised_by_the_mirrored_path() -> None:
    fixes = walked().fixes
    swapped = Fixes(fixes.stamps_ns, fixes.places[:, [1, 0, 2]], fixes.sigmas)
    with pytest.raises(HemislamError, match="seem to be swapped"):
        align(walked().trajectory, swapped)


def test_a_grid_that_does_not_fit_the_place_is_refused() -> None:
    made = walked()
    with pytest.raises(HemislamError, match="is not made for latitude 48"):
        align(made.trajectory, made.fixes, grid="EPSG:32756")


def test_fixes_of_another_day_are_refused() -> None:
    made = walked()
    other = replace(made.fixes, stamps_ns=made.fixes.stamps_ns + 86_400_000_000_000)
    with pytest.raises(HemislamError, match="Only 0 fixes lie within the time"):
        align(made.trajectory, other)


def test_an_hour_of_fixes_from_the_drive_to_the_site_does_not_matter() -> None:
    made = walked(rate_hz=2.0)
    drive = np.arange(3600)
    stamps_ns = made.trajectory.stamps_ns[0] - (3700 - drive) * 1_000_000_000
    places = made.fixes.places[0] + np.outer(3600 - drive, [0.45 / 3600, -8.0 / 3600, 0.0])  # from the zone beside
    long = Fixes.of(
        np.r_[stamps_ns, made.fixes.stamps_ns],
        np.vstack([places, made.fixes.places]),
        np.vstack([np.full((3600, 3), 0.02), made.fixes.sigmas]),
    )
    alone, found = (align(made.trajectory, fixes, lever=LEVER) for fixes in (made.fixes, long))
    assert found.reference == alone.reference and found.offset_s == alone.offset_s
    assert [int(name) - 3600 for name in found.names] == [int(name) for name in alone.names]


def test_a_line_at_even_pace_shows_no_offset_and_none_is_made_up() -> None:
    made = walked(path=LINE, noise=3.0, outliers=0.0, lever=(0.0, 0.0, 0.0), rate_hz=1.0, duration_s=60.0)
    found = align(made.trajectory, made.fixes, lever=(0.0, 0.0, 0.0))
    assert found.offset_s == 0.0 and np.isnan(found.offset_sigma_s)
    assert not any("Clock offset" in line for line in summary(found, "fixes"))


def test_a_lever_arm_that_is_no_number_is_named() -> None:
    made = walked()
    with pytest.raises(HemislamError, match="lever arm"):
        align(made.trajectory, made.fixes, lever=(0.1, float("nan"), 0.0))


def test_a_trajectory_of_three_poses_is_refused() -> None:
    made = walked(duration_s=3.0)
    short = Trajectory.from_poses(made.trajectory.stamps_ns[:3], made.trajectory.poses[:3])
    with pytest.raises(HemislamError, match="fewer than 4 poses"):
        align(short, made.fixes)


def test_someone_who_stands_still_learns_that_no_heading_follows() -> None:
    made = walked(duration_s=2.4, outliers=0.0, rate_hz=10.0)  # the walker rests at the start
    with pytest.raises(HemislamError, match="heading only to"):
        align(made.trajectory, made.fixes, lever=LEVER)


def test_the_users_word_on_a_fix_overrides_the_residuals() -> None:
    made = walked()
    wild, sound = str(made.outliers[2]), next(str(n) for n in range(30, 99) if n not in made.outliers)
    found = align(made.trajectory, made.fixes, lever=LEVER, overridden={wild: True, sound: False})
    verdict = dict(zip(found.names, found.used.tolist(), strict=True))
    assert verdict[wild] and not verdict[sound]
    few = dict.fromkeys(found.names[7:], False)
    with pytest.raises(HemislamError, match="Only 7 fixes are left"):
        align(made.trajectory, made.fixes, lever=LEVER, overridden=few)


def test_a_line_at_uneven_pace_shows_the_offset_although_the_tilt_about_it_stays_open() -> None:
    made = walked(path=LINE)
    times = (made.trajectory.stamps_ns - made.trajectory.stamps_ns[0]) * 1e-9
    positions = np.column_stack([times + 3.0 * np.sin(0.5 * times), 0.0 * times, 0.0 * times])
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    even = Trajectory(made.trajectory.stamps_ns, positions, level)
    stamps_ns = made.trajectory.stamps_ns[5:-5]
    places = TRUTH.to_geographic(positions[5:-5])
    fixes = Fixes.of(stamps_ns + 80_000_000, places, np.full(places.shape, 0.02))
    found = align(even, fixes, lever=(0.0, 0.0, 0.0))
    assert abs(found.offset_s - 0.08) < 0.002 and 1e-4 < found.offset_sigma_s < 0.01


def test_a_clock_offset_that_is_given_is_used_and_not_looked_for() -> None:
    made = walked(offset_s=0.08)
    right, wrong = (align(made.trajectory, made.fixes, lever=LEVER, offset_s=offset) for offset in (0.08, -0.4))
    assert (right.offset_s, wrong.offset_s) == (0.08, -0.4) and np.isnan(right.offset_sigma_s)
    assert right.rms.max() < 0.03 < wrong.rms[:2].max()
