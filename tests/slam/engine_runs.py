"""Runs of the whole engine on walks with exactly known poses, and the comparison of two runs."""

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from functools import cache

import numpy as np

from app.slam.engine import Engine
from app.slam.types import FrameStatus, Measurement, StepResult
from tests.slam.scenes import (
    Rig,
    Walk,
    furnished_room,
    measurements,
    mounted,
    pose_error,
    seconds_of,
)

REAL = Rig(
    T_imu_lidar=mounted((0, 0, 0), (0.0175, 0.0276, -0.1083)),
    range_noise=0.005,
    gyro_noise=1.2e-3 * np.sqrt(200),
    accel_noise=1.3e-2 * np.sqrt(200),
    b_gyro=(0.01, -0.008, 0.005),
    b_accel=(0.03, -0.02, 0.04),
)
ALONG = Walk(speed=(1.2, 0.0, 0.0), sway=((0.0, 1.0, 0.0), (0.05, 3.0, 0.4), (0.03, 6.0, 0.9)))
FRAMES = 60


@cache
def room_walk(frames: int = FRAMES) -> tuple[Measurement, ...]:
    return tuple(measurements(furnished_room(), Walk(), REAL, frames))


def run(engine: Engine, walk: Iterable[Measurement]) -> list[StepResult]:
    return [engine.step(m.scan, m.imu) for m in walk]


def errors(results: list[StepResult], walk: Walk) -> np.ndarray:
    """(n, 2) m and degrees, of the motion since the first frame that was tracked."""
    first = next(r for r in results if r.status is FrameStatus.TRACKING)
    T_first_odom = np.linalg.inv(first.state.T_odom_imu)
    T_first_world = np.linalg.inv(walk.pose(seconds_of(first.stamp_ns)))
    return np.array(
        [
            pose_error(T_first_odom @ r.state.T_odom_imu, T_first_world @ walk.pose(seconds_of(r.stamp_ns)))
            if r.status is not FrameStatus.INITIALISING
            else (0.0, 0.0)
            for r in results
        ]
    )


def worst(results: list[StepResult], walk: Walk, since: int = 0) -> tuple[float, float]:
    """Largest errors from frame `since` on, m and degrees."""
    metres, degrees = errors(results, walk)[since:].max(axis=0)
    return float(metres), float(degrees)


def assert_same(a: object, b: object, ignore: tuple[str, ...] = ("timings_ms",)) -> None:
    """Equal in every field and to the last bit."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype  # type: ignore[attr-defined]
        np.testing.assert_array_equal(a, b)  # type: ignore[arg-type]
    elif is_dataclass(a):
        for field in fields(a):
            if field.name not in ignore:
                assert_same(getattr(a, field.name), getattr(b, field.name), ignore)
    elif isinstance(a, float):
        assert a == b or (np.isnan(a) and np.isnan(b))  # type: ignore[call-overload]
    else:
        assert a == b


def assert_all_same(a: list[StepResult], b: list[StepResult], ignore: tuple[str, ...] = ("timings_ms",)) -> None:
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        assert_same(one, other, ignore)
