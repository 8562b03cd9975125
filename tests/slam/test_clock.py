"""A late or early IMU clock, estimated while moving, on walks with exactly known samples."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from app.slam.clock import JITTER_S, USUAL_S, ClockOffset
from app.slam.engine import Engine
from app.slam.types import ImuSamples, Measurement
from tests.slam.engine_runs import REAL, run
from tests.slam.scenes import Walk, furnished_room, measurements, params_for

RIG = replace(REAL, columns=48)
LIVELY = Walk(turn=((0.3, 4.0, 0.0), (0.10, 3.0, 0.3), (0.08, 3.5, 1.0)))
FRAMES = 70


def stamped(walk: Iterable[Measurement], late_s: float) -> Iterator[Measurement]:
    """The same scans, each with the samples that seem to cover it by a clock that is late."""
    walk = list(walk)
    stamps, first = np.unique(np.concatenate([m.imu.stamps_ns for m in walk]), return_index=True)
    gyro, accel = (np.concatenate([getattr(m.imu, name) for m in walk])[first] for name in ("gyro", "accel"))
    stamps = stamps + round(late_s * 1e9)
    begin = 0
    for m in walk:
        end = int(np.searchsorted(stamps, m.scan.end_ns)) + 1
        yield replace(m, imu=ImuSamples(stamps[begin:end], gyro[begin:end], accel[begin:end]))
        begin = max(0, int(np.searchsorted(stamps, m.scan.end_ns, side="right")) - 1)


def learnt(late_s: float, values: dict[str, object] | None = None) -> ClockOffset:
    """What the engine believes after a lively walk of seven seconds."""
    engine = Engine(params_for(RIG, values))
    run(engine, stamped(measurements(furnished_room(), LIVELY, RIG, FRAMES), late_s))
    return engine.checkpoint().progress.clock


@pytest.mark.parametrize("late_s", [0.006, -0.006])
def test_a_clock_that_is_off_is_found_while_moving(late_s: float) -> None:
    assert learnt(late_s).late == pytest.approx(late_s, abs=0.001)


def test_the_stated_uncertainty_falls_from_the_usual_one_to_that_of_the_errors() -> None:
    assert ClockOffset().sigma == pytest.approx(USUAL_S, rel=0.01)
    assert JITTER_S < learnt(0.0).sigma < 0.0015


def test_a_clock_that_is_right_is_left_alone() -> None:
    assert abs(learnt(0.0).late) < 0.0003


def test_switched_off_it_learns_nothing() -> None:
    assert learnt(0.006, {"imu.learn_clock": False}) == ClockOffset()
