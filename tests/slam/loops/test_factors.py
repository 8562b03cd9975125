"""Factors of the graph from odometry."""

from dataclasses import replace

import numpy as np
import pytest

from app.slam.loops.drift import Drift
from app.slam.loops.factors import EVEN_M, STILL_M, odometry_factor
from app.slam.types import Cloud, Keyframe

NO_POINTS = Cloud(
    np.zeros((0, 3), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.float32), np.zeros(0, np.uint16),
    np.zeros(0, np.int32),
)  # fmt: skip
SIGMA_M = 0.004


def keyframe(x: float, drift: float = 0.0) -> Keyframe:
    """At x m along the first axis, matched to the map to SIGMA_M, with so much drift (variance) since the start."""
    T = np.eye(4)
    T[0, 3] = x
    return Keyframe(0, 0, 0, T, np.eye(4), SIGMA_M**2 * np.eye(6), NO_POINTS, drift * np.eye(6))


@pytest.mark.parametrize("walked", [0.0, 1.0, 4.0])
def test_a_step_is_as_certain_as_both_matches_and_the_drift_on_its_way(walked: float) -> None:
    step = odometry_factor(1, keyframe(0.0), keyframe(walked), Drift(0.01, 0.002, 0.0))
    drift = np.array([0.01, 0.01, 0.002])  # the last axis is up
    expected = 2 * SIGMA_M**2 + STILL_M**2 + drift**2 * walked * EVEN_M
    np.testing.assert_allclose(step.covariance[3:, 3:], np.diag(expected))
    np.testing.assert_allclose(step.T_first_second[:3, 3], [walked, 0.0, 0.0])


def test_a_step_late_in_a_walk_is_as_certain_as_an_early_one() -> None:
    early, late = (
        odometry_factor(1, keyframe(0.0, d), keyframe(1.0, d), Drift(0.01, 0.002, 0.001)) for d in (0.0, 1.0)
    )
    np.testing.assert_array_equal(early.covariance, late.covariance)


def test_a_step_that_a_scan_contradicted_is_loose() -> None:
    step = odometry_factor(1, keyframe(0.0), replace(keyframe(1.0), astray=2.0), Drift(0.01, 0.002, 0.0))
    assert np.sqrt(np.diag(step.covariance)[3:]) == pytest.approx(2.0, rel=0.01)
    assert np.sqrt(np.diag(step.covariance)[:3]).max() < 0.01
