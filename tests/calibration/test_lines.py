"""Tests app/calibration/lines.py: the errors of each scan line follow from the distances of points to planes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.calibration.excerpt import Excerpt
from app.calibration.lines import Lines, fit_lines
from app.calibration.odometry import Track
from app.slam.types import F64, ImuSamples, Scan

ROOM = np.array([4.3, 3.4, 2.2])
"""m, half of its edges."""
COUNT = 16
NO_IMU = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


def walk_in_a_room(elevations: F64, ranges: F64) -> tuple[Excerpt, Track]:
    """A scanner that is turned about all axes in a box; its lines are really `elevations` rad higher and measure
    `ranges` m too far."""
    rng = np.random.default_rng(1)
    azimuth = np.linspace(-np.pi, np.pi, 160, endpoint=False)
    ring = np.repeat(np.arange(COUNT), len(azimuth)).astype(np.uint16)
    nominal = np.radians(np.linspace(-10.0, 80.0, COUNT))[ring]
    around = np.tile(azimuth, COUNT)

    def beams(up: F64) -> F64:
        return np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])

    t = np.arange(181) * 0.1
    angles = np.column_stack([0.8 * t, 0.5 * np.sin(0.9 * t), 0.5 * np.sin(1.3 * t)])
    rotations = Rotation.from_euler("ZYX", angles).as_matrix()
    positions = np.column_stack([2.0 * np.sin(0.5 * t), 1.2 * np.sin(0.8 * t), 0.3 * np.sin(1.1 * t)])
    scans = []
    for k, (R, p) in enumerate(zip(rotations, positions, strict=True)):
        d = beams(nominal + elevations[ring]) @ R.T
        distance = np.min(np.where(d > 0, ROOM - p, -ROOM - p) / np.where(d == 0, 1e-9, d), axis=1)
        measured = distance + ranges[ring] + rng.normal(0, 0.01, len(ring))
        points = (beams(nominal) * measured[:, None]).astype(np.float32)
        zero = np.zeros(len(ring), np.float32)
        scans.append(Scan(k * 100_000_000, points, zero.astype(np.int32), zero, ring))
    track = Track(t, rotations, positions, np.zeros(len(t)), tuple(scan.points for scan in scans))
    return Excerpt(tuple(scans), NO_IMU, COUNT), track


def uneven(values: F64) -> F64:
    """Without what is common to all lines or changes evenly over them, which is held at zero."""
    place = np.arange(COUNT)
    return np.asarray(values - np.polyval(np.polyfit(place, values, 1), place))


def test_what_each_line_gets_wrong_is_found_and_corrected() -> None:
    rng = np.random.default_rng(0)
    elevations, ranges = np.radians(0.2) * rng.normal(size=COUNT), 0.015 * rng.normal(size=COUNT)
    elevations, ranges = uneven(elevations), uneven(ranges)
    excerpt, track = walk_in_a_room(elevations, ranges)
    found = Lines.none(COUNT)
    for _ in range(2):
        seen = found.applied(excerpt)
        found = fit_lines(seen, replace(track, points=tuple(scan.points for scan in seen.scans)), found)
    assert np.degrees(np.abs(found.elevations - elevations).max()) < 0.03
    assert np.abs(found.ranges + ranges).max() < 0.003
    assert found.found().keys() == {"sensor.elevation_corrections", "sensor.range_corrections"}
    assert np.nanmean(found.after) < 0.8 * np.nanmean(found.before)


def test_a_scanner_without_such_errors_is_left_as_it_is() -> None:
    nothing = np.zeros(COUNT)
    found = fit_lines(*walk_in_a_room(nothing, nothing), Lines.none(COUNT))
    assert found.found() == {}


def test_the_stated_uncertainty_is_that_of_the_errors() -> None:
    nothing = np.zeros(COUNT)
    found = fit_lines(*walk_in_a_room(nothing, nothing), Lines.none(COUNT))
    for values, sigmas in zip((found.elevations, found.ranges), found.sigmas, strict=True):
        assert 0.2 < np.sqrt(np.mean((values / sigmas) ** 2)) < 3.0


def test_a_line_that_sees_nothing_stays_as_it_is() -> None:
    excerpt, track = walk_in_a_room(np.full(COUNT, 0.0), 0.02 * np.cos(np.pi * np.arange(COUNT)))
    scans = [scan.part(scan.ring < COUNT - 1) for scan in excerpt.scans]
    track = replace(track, points=tuple(scan.points for scan in scans))
    found = fit_lines(replace(excerpt, scans=tuple(scans)), track, Lines.none(COUNT))
    assert np.isnan(found.after[-1]) and abs(found.ranges[-1]) < 1e-6
    assert "sensor.range_corrections" in found.found()


@pytest.mark.parametrize("scans", [0, 30])
def test_a_walk_too_short_for_planes_tells_nothing(scans: int) -> None:
    excerpt, track = walk_in_a_room(np.zeros(COUNT), np.zeros(COUNT))
    so_far = Lines.none(COUNT)
    assert fit_lines(replace(excerpt, scans=excerpt.scans[: scans + 1]), track, so_far) is so_far
    assert so_far.found() == {}
