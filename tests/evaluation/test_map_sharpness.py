"""Map sharpness on maps of exact walls: the measured values must equal the known ones."""

import numpy as np
import pytest

from app.evaluation.map_sharpness import MapPoints, collect, measure, revisit_gaps
from app.slam.types import Cloud, Keyframe


def wall(rng: np.random.Generator, thickness: float, offset: float, seconds: float, count: int = 20_000) -> MapPoints:
    """A wall of 6 x 3 m at x = offset, seen from x = -3 within 5 s."""
    points = rng.uniform([0, 0, 0], [0, 6, 3], (count, 3))
    points[:, 0] = offset + rng.normal(scale=thickness, size=count)
    times = seconds + rng.uniform(0, 5, count)
    return MapPoints(points, np.tile([-3.0, 3.0, 1.0], (count, 1)), times, times * 1.2)


def both(first: MapPoints, second: MapPoints) -> MapPoints:
    names = ("points", "sensors", "times", "walked")
    return MapPoints(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


@pytest.mark.parametrize("thickness", [0.004, 0.01, 0.02])
def test_the_thickness_of_a_wall_is_the_spread_of_its_points(thickness: float) -> None:
    fine = measure(wall(np.random.default_rng(0), thickness, 0.0, 0.0))
    assert fine.thickness == pytest.approx(thickness, rel=0.05)


def test_the_entropy_of_a_gaussian_slab_is_that_of_its_covariance() -> None:
    """In a ball of 0.3 m a thin disc has the variance r^2 / 4 along it and that of the noise across."""
    thickness = 0.005
    rng = np.random.default_rng(1)
    inner = wall(rng, thickness, 0.0, 0.0, 60_000)
    expected = 0.5 * np.log((2 * np.pi * np.e) ** 3 * (0.3**2 / 4) ** 2 * thickness**2)
    assert measure(inner).entropy == pytest.approx(expected, abs=0.1)  # balls at the wall's edge are halves


def test_a_blurred_map_has_more_entropy() -> None:
    fine, coarse = (measure(wall(np.random.default_rng(2), t, 0.0, 0.0)).entropy for t in (0.005, 0.03))
    assert coarse > fine + 0.5


@pytest.mark.parametrize("gap", [0.0, 0.03, 0.12, 0.4])
def test_the_gap_between_two_passes_is_found(gap: float) -> None:
    rng = np.random.default_rng(3)
    twice = both(wall(rng, 0.005, 0.0, 0.0), wall(rng, 0.005, gap, 60.0))
    gaps = revisit_gaps(twice)
    assert len(gaps) > 30
    assert np.median(gaps) == pytest.approx(gap, abs=0.005)


def test_a_wall_seen_once_or_from_its_other_side_is_no_revisit() -> None:
    rng = np.random.default_rng(4)
    first, later = wall(rng, 0.005, 0.0, 0.0), wall(rng, 0.005, 0.15, 60.0)
    behind = MapPoints(later.points, later.sensors * [-1, 1, 1], later.times, later.walked)
    assert len(revisit_gaps(first)) == 0
    assert len(revisit_gaps(both(first, behind))) == 0
    soon = wall(rng, 0.005, 0.15, 8.0)
    assert len(revisit_gaps(both(first, soon))) == 0


def test_keyframes_are_collected_in_the_map_frame() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-5, 5, (300, 3)).astype(np.float32)
    none = np.zeros(300)
    cloud = Cloud(points, none.astype(np.uint8), none.astype(np.float32), none.astype(np.uint16), none.astype(np.int32))
    T = np.eye(4)
    T[:3, 3] = [1, 2, 3]
    keyframe = Keyframe(0, 0, 5_000_000_000, np.eye(4), T, np.eye(6), cloud)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    made = collect([keyframe], pose[None])
    np.testing.assert_allclose(made.points, (points + T[:3, 3]) @ pose[:3, :3].T, atol=1e-5)
    np.testing.assert_allclose(made.sensors[0], [-2, 1, 3])
    assert set(made.times) == {5.0}


def test_an_empty_map_has_no_sharpness() -> None:
    nothing = measure(MapPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0)))
    assert np.isnan(nothing.entropy) and nothing.revisits == 0
