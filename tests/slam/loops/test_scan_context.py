import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.slam import lie
from app.slam.loops.scan_context import RADIUS, SECTORS, YAWS, ScanContext, describe, shift_distances
from app.slam.types import F32


def place(seed: int) -> F32:
    """A floor and upright things at random, none on the border of a cell."""
    rng = np.random.default_rng(seed)
    ring, sector = rng.integers(2, 18, 60), rng.integers(0, SECTORS, 60)
    angle = (sector + 0.5) * 2 * np.pi / SECTORS
    foot = np.column_stack([(ring + 0.5) * np.cos(angle), (ring + 0.5) * np.sin(angle)])
    tall = rng.uniform(0.5, 4.0, 60)
    things = [np.column_stack([foot, np.full(60, z)])[tall > z] for z in np.arange(-1.1, 4.0, 0.2)]
    return np.vstack(things).astype(np.float32)


@given(st.integers(0, 5), st.integers(0, SECTORS - 1))
def test_a_turned_place_is_the_same_place_at_the_shift_it_was_turned_by(seed: int, shift: int) -> None:
    points = place(seed)
    turned = points @ lie.exp(np.array([0.0, 0.0, shift * 2 * np.pi / SECTORS])).T.astype(np.float32)
    a, b = describe(turned), describe(points)
    distances = shift_distances(a, b)
    assert int(np.argmin(distances)) == shift
    assert distances[shift] < 1e-5
    assert abs(np.exp(1j * YAWS[shift]) - np.exp(2j * np.pi * shift / SECTORS)) < 1e-9
    np.testing.assert_allclose(a.ring_key, b.ring_key, atol=1e-6)


def test_other_places_are_farther_away_than_the_same_place_seen_half() -> None:
    whole = describe(place(0))
    half = describe(place(0)[place(0)[:, 0] > 0])
    assert shift_distances(whole, half)[0] < 0.02
    assert min(shift_distances(whole, describe(place(seed))).min() for seed in range(1, 6)) > 0.2


def test_what_was_never_seen_counts_for_neither_side() -> None:
    a, b = describe(place(0)), describe(place(0)[place(0)[:, 1] > 0])
    assert not b.seen[:, SECTORS // 2 :].any()
    blind = ScanContext(b.cells, a.seen)  # as if the empty half had been seen, and was empty
    assert shift_distances(a, b)[0] < 0.02 < 0.1 < shift_distances(a, blind)[0]


def test_places_that_share_too_little_view_are_not_compared() -> None:
    points = place(0)
    east, west = describe(points[points[:, 0] > 1]), describe(points[points[:, 0] < -1])
    assert shift_distances(east, west)[0] == 1.0


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.full((1, 3), 10 * RADIUS, np.float32)])
def test_nothing_in_reach_is_like_nothing(points: F32) -> None:
    empty = describe(points)
    assert not empty.seen.any()
    assert (shift_distances(empty, describe(place(0))) == 1.0).all()


def test_the_distance_is_that_of_a_loop_over_cells_and_shifts() -> None:
    a, b = describe(place(0)), describe(place(3)[place(3)[:, 0] > -4])
    expected = np.ones(SECTORS)
    for shift in range(SECTORS):
        both = a.seen & np.roll(b.seen, shift, axis=1)
        x, y = a.cells[both].astype(np.float64), np.roll(b.cells, shift, axis=1)[both].astype(np.float64)
        if both.sum() >= 0.4 * min(a.seen.sum(), b.seen.sum()):
            expected[shift] = 1 - x @ y / np.sqrt((x @ x) * (y @ y))
    np.testing.assert_allclose(shift_distances(a, b), expected, atol=1e-5)
