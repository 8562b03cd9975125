"""The certainty of a registration compared with odometry; tests app/slam/loops/verdicts.py."""

from dataclasses import replace

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.drift import Deviation
from app.slam.loops.placing import Placement
from app.slam.loops.verdicts import FLOOR_M, INDEPENDENT, LOOSE_M, POINT_M, uncertainty_along
from app.slam.loops.verification import Fit
from app.slam.types import F64

WEAK_M = 0.2
"""Standard deviation along x, as between two rows of parked cars."""


def between_rows(x: float) -> Placement:
    """A registration that ended at x, with little to hold it along x."""
    weak = POINT_M**2 / INDEPENDENT / (WEAK_M**2 - FLOOR_M**2)
    fit = Fit(
        lie.transform(np.eye(3), np.array([x, 0.3, 0.1])),
        0.6,
        np.full(500, 0.03),
        np.diag([1e3] * 3 + [weak, 1e3, 1e3]),
    )
    return Placement(fit, Deviation(3.0, 0.0, 0.0), slides=0.01, open=None, loose=False, alternative_m=np.inf)


def odometry(sigma: float) -> F64:
    return np.diag([sigma**2, 1e-4, 1e-4])


@pytest.mark.parametrize("off", [-0.4, 0.02, 0.4])
def test_a_registration_less_certain_than_odometry_counts_for_less_the_more_it_contradicts_it(off: float) -> None:
    along, sigma = uncertainty_along(
        between_rows(1.0 + off), lie.transform(np.eye(3), np.array([1.0, 0.0, 0.0])), odometry(0.1)
    )
    np.testing.assert_allclose(np.abs(along), [1.0, 0.0, 0.0], atol=1e-9)
    assert sigma == pytest.approx(abs(off))


def test_where_odometry_is_less_certain_a_registration_counts_as_its_points_tell() -> None:
    assert uncertainty_along(between_rows(1.4), np.eye(4), odometry(1.5 * WEAK_M))[1] == 0.0


def test_nothing_is_known_along_a_direction_that_is_open() -> None:
    along = np.array([0.0, 1.0, 0.0])
    assert uncertainty_along(replace(between_rows(1.4), open=along), np.eye(4), odometry(0.1)) == (
        pytest.approx(along),
        LOOSE_M,
    )
