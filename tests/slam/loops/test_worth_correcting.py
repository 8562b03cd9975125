"""Loops that odometry meets already are not followed, since that would only add their noise.

Tests app/slam/loops/verdicts.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from app.slam.loops.types import Evidence, LoopEdge, Origin, Verdict
from app.slam.loops.verdicts import FLOOR_M, FLOOR_YAW, worth_correcting

POSES = np.tile(np.eye(4), (60, 1, 1))
POSES[:, 0, 3] = np.arange(60)


def loops(off_m: float, verdict: Verdict = Verdict.ACCEPTED, sideways_m: float = FLOOR_M) -> list[LoopEdge]:
    """Ten loops that place the newer keyframe so far to the side of where odometry has it.

    sideways_m: standard deviation that they have in that direction.
    """
    covariance = np.diag([FLOOR_YAW**2] * 3 + [FLOOR_M**2, sideways_m**2, FLOOR_M**2])
    edges = []
    for newer in range(50, 60):
        T = np.linalg.inv(POSES[newer - 50]) @ POSES[newer]
        T[1, 3] += off_m
        edges.append(LoopEdge(newer - 50, newer, newer, T, covariance, Evidence(), verdict, ""))
    return edges


@pytest.mark.parametrize(("off_m", "worth"), [(0.0, False), (0.005, False), (0.03, True), (0.5, True)])
def test_a_correction_must_be_more_than_the_noise_of_registrations(off_m: float, worth: bool) -> None:
    assert worth_correcting(loops(off_m), POSES) is worth


def test_loops_that_slide_need_to_be_farther_off_in_that_direction() -> None:
    """Along a corridor a registration may be half a metre out, and says so."""
    assert not worth_correcting(loops(0.1, sideways_m=0.5), POSES)
    assert worth_correcting(loops(0.5, sideways_m=0.5), POSES)


def test_one_loop_that_is_far_off_is_enough() -> None:
    assert worth_correcting([*loops(0.0)[:-1], loops(0.3)[-1]], POSES)


def test_what_was_not_accepted_says_nothing() -> None:
    assert not worth_correcting(loops(0.5, Verdict.REJECTED), POSES)
    assert not worth_correcting([], POSES)


def test_the_word_of_the_user_counts_however_little_it_moves() -> None:
    first, *others = loops(0.001)
    for told in (replace(first, edited=True), replace(first, origin=Origin.USER), replace(first, weight=2.0)):
        assert worth_correcting([told, *others], POSES)
