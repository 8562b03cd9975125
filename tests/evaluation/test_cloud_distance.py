"""Distances between maps. Tests app/evaluation/cloud_distance.py, app/slam/kernels/cells.py.

The oracle is geometry: sampled surfaces at a known distance.
"""

import numpy as np
import pytest

from app.evaluation.cloud_distance import Comparison, compare, density, sorted_cells
from app.slam import lie
from app.slam.errors import HemislamError

RANDOM = np.random.default_rng(11)
NOISE_M = 0.008


def floor(z: float, noise: float = NOISE_M, size: float = 4.0, n: int = 40_000) -> np.ndarray:
    points = RANDOM.uniform(0.0, size, (n, 3))
    points[:, 2] = z + RANDOM.normal(0.0, noise, n)
    return points


def from_above(points: np.ndarray, other: np.ndarray, **options: object) -> Comparison:
    return compare(points, points + np.array([0.0, 0.0, 5.0]), other, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("apart", [0.03, -0.2])
def test_a_floor_that_was_raised_or_sank_is_so_far_away(apart: float) -> None:
    found = from_above(floor(apart), floor(0.0))
    assert found.median == pytest.approx(apart, abs=5e-4)
    assert found.covered > 0.999 and found.changed > 0.99


@pytest.mark.parametrize("noise", [0.003, 0.015])
def test_of_two_samples_of_one_surface_one_in_twenty_distances_is_reported_wrongly(noise: float) -> None:
    found = from_above(floor(0.0, noise), floor(0.0, noise))
    assert found.changed == pytest.approx(0.05, abs=0.025)
    assert found.known.std() == pytest.approx(float(np.nanmedian(found.detectable)) / 1.96, rel=0.25)


def test_distances_are_along_the_normal_of_a_slope_whatever_its_direction() -> None:
    turn = lie.exp(np.array([0.5, 0.7, 0.2]))
    front = turn @ [0.0, 0.0, 1.0]
    points, other = floor(0.0) @ turn.T + 0.05 * front, floor(0.0) @ turn.T
    for side in (1.0, -1.0):
        found = compare(points, points + side * 3.0 * front, other)
        assert found.median == pytest.approx(side * 0.05, abs=1e-3), "positive is towards the sensor"


def test_the_far_side_of_a_thin_wall_does_not_count() -> None:
    wall = np.concatenate([floor(0.0), floor(-0.12)])
    found = from_above(floor(0.02), wall)
    assert found.median == pytest.approx(0.02, abs=1e-3) and found.p95 < 0.03


def test_what_the_other_map_does_not_show_has_no_distance() -> None:
    points, other = floor(0.0), floor(0.0)
    found = from_above(points, other[other[:, 0] < 2.0])
    missing = np.isnan(found.distance)
    assert missing[points[:, 0] > 2.5].all() and not missing[points[:, 0] < 1.9].any()
    with pytest.raises(HemislamError, match=r"within 0\.5 m"):
        from_above(floor(0.9), floor(0.0))
    assert from_above(floor(0.9), floor(0.0), reach=1.2).median == pytest.approx(0.9, abs=1e-3)


def test_coordinates_of_a_grid_lose_nothing() -> None:
    there = np.array([500_000.0, 5_400_000.0, 300.0])
    found = from_above(floor(0.03) + there, floor(0.0) + there)
    assert found.median == pytest.approx(0.03, abs=5e-4)


def room(n: int = 12_000) -> np.ndarray:
    """Floor and two walls that meet in a corner, 4 m wide and high."""
    sides = [floor(0.0, 0.003, n=n) for _ in range(3)]
    return np.concatenate([np.roll(side, turns, axis=1) for turns, side in enumerate(sides)])


def test_a_map_in_another_frame_nearby_is_fitted_first() -> None:
    T = lie.transform(lie.exp(np.array([0.01, -0.02, 0.05])), np.array([0.3, -0.2, 0.1]))
    moved = room() @ T[:3, :3].T + T[:3, 3]
    assert compare(moved, moved * 0 + 2.0, room()).typical > 0.02
    found = compare(moved, moved * 0 + 2.0, room(), fit=True)
    assert found.typical < 0.002 and np.abs(found.T - T).max() < 3e-3


def test_maps_that_do_not_meet_are_refused_in_a_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(HemislamError, match="do not lie on each other"):
        from_above(floor(0.0), floor(0.0) + 100.0)
    with pytest.raises(HemislamError, match="could not be fitted"):
        from_above(floor(0.0), floor(0.0) + 100.0, fit=True)
    with pytest.raises(HemislamError, match="could not be fitted"):
        from_above(floor(0.0), floor(0.0) + np.array([691_607.0, 5_334_760.0, 520.0]), fit=True)
    assert "out of range" not in capfd.readouterr().err
    with pytest.raises(HemislamError, match="without points"):
        from_above(floor(0.0), np.empty((0, 3)))


def test_progress_grows_to_the_whole() -> None:
    told: list[float] = []
    from_above(floor(0.0, size=16.0), floor(0.0, size=16.0), progress=told.append)
    assert told == sorted(told) and told[-1] == 1.0 and len(told) > 1


def test_density_counts_the_points_in_the_eight_cubes_around() -> None:
    points = RANDOM.uniform(-1.0, 1.0, (800, 3)).astype(np.float32)
    counts, edge = density(points, 0.25), 0.25
    low = np.floor(points / edge - 0.5)
    cell = np.floor(points / edge)
    for j in range(0, 800, 37):
        assert counts[j] == np.count_nonzero(((cell >= low[j]) & (cell <= low[j] + 1)).all(axis=1))


def test_cells_hold_every_point_once() -> None:
    points = RANDOM.uniform(-3.0, 3.0, (500, 3)).astype(np.float32)
    found = sorted_cells(points, 0.5)
    assert (np.sort(found.points, axis=0) == np.sort(points, axis=0)).all()
    for begin, end in zip(found.starts[:-1], found.starts[1:], strict=True):
        assert len(np.unique(np.floor(found.points[begin:end] / 0.5), axis=0)) == 1
    assert (np.diff(found.keys) > 0).all()
