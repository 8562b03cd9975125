"""Scale errors of a gyroscope, estimated while moving, on walks with exactly known samples.

Tests app/slam/gyroscope.py.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam.engine import Engine
from app.slam.gyroscope import GYRO_SCALE, GyroErrors
from app.slam.types import F64, Measurement, NavState
from tests.slam.engine_runs import REAL, run
from tests.slam.scenes import Walk, furnished_room, measurements, params_for

RIG = replace(REAL, columns=48)
LIVELY = Walk(turn=((0.9, 4.0, 0.0), (0.3, 3.0, 0.3), (0.25, 3.5, 1.0)))
FRAMES = 100
OFF = np.array([[0.010, 0.004, 0.0], [0.004, -0.008, 0.003], [0.0, 0.003, 0.012]])
"""Shares by which the gyroscope reads too little."""


def read_wrongly(shares: F64) -> Iterator[Measurement]:
    wrong = np.linalg.inv(np.eye(3) + shares)
    for m in measurements(furnished_room(), LIVELY, RIG, FRAMES):
        yield replace(m, imu=replace(m.imu, gyro=m.imu.gyro @ wrong.T))


def learnt(shares: F64, values: dict[str, object] | None = None) -> F64:
    engine = Engine(params_for(RIG, values))
    run(engine, read_wrongly(shares))
    return engine.checkpoint().progress.gyro.shares


def test_scales_that_are_off_are_found_while_turning() -> None:
    found = learnt(OFF)
    assert np.abs(found - OFF).max() < 0.5 * np.abs(OFF).max()
    assert np.sum(found * OFF) / np.sum(OFF * OFF) > 0.6


def test_a_gyroscope_that_is_right_is_left_alone() -> None:
    assert np.abs(learnt(np.zeros((3, 3)))).max() < GYRO_SCALE / 4


def test_switched_off_it_learns_nothing() -> None:
    assert not learnt(OFF, {"imu.learn_scale": False}).any()


def turned(about: NavState, by: Rotation) -> NavState:
    return replace(about, R_odom_imu=about.R_odom_imu @ by.as_matrix())


def test_many_turns_determine_all_six_shares() -> None:
    """Each scan corrects what the gyroscope, set right so far, still lacks; the errors of scans average out."""
    rng = np.random.default_rng(0)
    zero, eye = np.zeros(3), np.eye(3)
    begin = NavState(0, eye, zero, zero, zero, zero, np.array([0.0, 0.0, -9.81]), eye, zero)
    errors = GyroErrors()
    for turn in rng.normal(0.0, 0.1, (2000, 3)):
        read = np.linalg.solve(np.eye(3) + OFF, turn)
        predicted = turned(begin, Rotation.from_rotvec(read + errors.shares @ read))
        seen = turned(begin, Rotation.from_rotvec(turn + rng.normal(0.0, 0.003, 3)))
        errors = errors.learnt(begin, predicted, seen)
    np.testing.assert_allclose(errors.shares, OFF, atol=0.0015)


def test_a_correction_too_large_for_a_scale_is_ignored() -> None:
    zero, eye = np.zeros(3), np.eye(3)
    begin = NavState(0, eye, zero, zero, zero, zero, np.array([0.0, 0.0, -9.81]), eye, zero)
    predicted = turned(begin, Rotation.from_rotvec([0.1, 0.0, 0.0]))
    for after in (
        turned(predicted, Rotation.from_rotvec([0.2, 0.0, 0.0])),
        replace(predicted, R_odom_imu=eye * np.nan),
    ):
        assert GyroErrors().learnt(begin, predicted, after).seen.sum() == 0.0
