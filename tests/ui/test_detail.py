"""Which part of a large map is drawn.

Tests app/ui/chunks.py.
"""

import numpy as np
import pytest

from app.ui.chunks import parts

WALK = np.column_stack((np.arange(1000.0), np.zeros((1000, 2))))
"""A kilometre on foot, a keyframe each metre."""
COUNTS = np.full(1000, 20_000)
BUDGET = 3_000_000


def drawn(*eyes: tuple[float, float, float]) -> np.ndarray:
    return parts(COUNTS, WALK, np.array(eyes).reshape(-1, 3), BUDGET)


def test_all_of_a_map_within_the_budget_is_drawn() -> None:
    assert (parts(COUNTS[:150], WALK[:150], np.zeros((1, 3)), BUDGET) == COUNTS[:150]).all()


@pytest.mark.parametrize(
    "eyes", [(), ((500.0, 0.0, 1.5),), ((500.0, 0.0, 900.0),), ((0.0, 0.0, 2.0), (999.0, 0.0, 2.0))]
)
def test_of_twenty_million_points_as_many_are_drawn_as_the_budget_allows(
    eyes: tuple[tuple[float, float, float], ...],
) -> None:
    assert BUDGET / 2 < drawn(*eyes).sum() <= BUDGET


def test_from_nearby_all_points_are_drawn_and_of_far_keyframes_as_many_as_are_as_dense_in_the_picture() -> None:
    near = drawn((500.0, 0.0, 1.5))
    assert (near[480:520] == 20_000).all()
    assert near[0] == pytest.approx(near[250] / 4, rel=0.01), "twice as far away"
    above = drawn((500.0, 0.0, 3000.0))
    assert above.min() >= 20_000 / 16 and above.max() <= 2 * above.min(), "from afar nearly alike"


def test_two_who_look_at_different_places_both_see_them_in_detail() -> None:
    shown = drawn((0.0, 0.0, 2.0), (999.0, 0.0, 2.0))
    assert shown[0] == shown[999] == 20_000 and shown[500] < 2_000


def test_a_step_changes_few_keyframes() -> None:
    assert np.mean(drawn((500.0, 0.0, 1.5)) != drawn((502.0, 0.0, 1.5))) < 0.1
