"""LIOM in a room where every pose is known. Tests app/baselines/liom.py."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from app.baselines.liom import Liom
from app.slam.errors import HemislamError
from app.slam.types import F64, ImuSamples, Measurement, Scan
from tests.baselines.test_loam import FRAMES, RIG, errors
from tests.slam.scenes import Rig, Walk, furnished_room, measurements, params_for

REAL = replace(RIG, gyro_noise=0.01, accel_noise=0.1, b_gyro=(0.01, -0.008, 0.005), b_accel=(0.03, -0.02, 0.04))


@cache
def walked(rig: Rig = REAL) -> tuple[Measurement, ...]:
    return tuple(measurements(furnished_room(), Walk(), rig, FRAMES))


def estimate(walk: tuple[Measurement, ...]) -> list[tuple[int, F64]]:
    liom = Liom(params_for(REAL))
    return [liom.step(measurement) for measurement in walk]


def test_it_walks_through_a_room_and_knows_where_it_is() -> None:
    found = errors(estimate(walked()))
    assert found[:, 0].max() < 0.1 and found[:, 1].max() < 3.0


def test_the_same_scans_give_the_same_bytes() -> None:
    first, again = (estimate(walked()[:25]) for _ in range(2))
    assert all(a[1].tobytes() == b[1].tobytes() for a, b in zip(first, again, strict=True))


def test_the_imu_carries_it_through_scans_without_returns() -> None:
    walk = list(walked()[:45])
    for index in range(38, 41):
        scan = walk[index].scan
        some = np.array([0, len(scan) - 1])  # too few to match, but they carry the scan's times
        empty = Scan(scan.stamp_ns, scan.points[some], scan.offsets_ns[some], scan.intensity[some], scan.ring[some])
        walk[index] = replace(walk[index], scan=empty)
    found = errors(estimate(tuple(walk)))
    assert found[:, 0].max() < 0.15


def test_it_says_that_it_needs_an_imu() -> None:
    none = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(HemislamError, match="needs an IMU"):
        Liom(params_for(REAL)).step(Measurement(walked()[0].scan, none))
