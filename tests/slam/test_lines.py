"""Errors of scan lines, estimated while walking, on scanners with known errors."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from app.slam.engine import Engine
from app.slam.types import Measurement
from tests.slam.engine_runs import ALONG, REAL, run
from tests.slam.scenes import Walk, corridor, furnished_room, measurements, params_for

RNG = np.random.default_rng(5)
RANGE_M, ELEVATION = RNG.normal(scale=0.01, size=32), np.radians(RNG.normal(scale=0.12, size=32))
RIG = replace(REAL, columns=48)


def bent(points: np.ndarray, rings: np.ndarray) -> np.ndarray:
    """Points (n, 3) as a scanner reports them whose lines are RANGE_M too long and ELEVATION too high."""
    reach = np.linalg.norm(points, axis=1)
    azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / reach)
    reach, elevation = reach + RANGE_M[rings], elevation + ELEVATION[rings]
    level = reach * np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), reach * np.sin(elevation)])


def seen_bent(walk: Iterable[Measurement]) -> Iterator[Measurement]:
    for m in walk:
        points = bent(m.scan.points.astype(np.float64), m.scan.ring).astype(np.float32)
        yield replace(m, scan=replace(m.scan, points=points))


def learnt(walk: Iterable[Measurement], values: dict[str, object] | None = None) -> np.ndarray:
    """(32, 2) m and rad, what the engine believes of the lines after a walk."""
    engine = Engine(params_for(RIG, values))
    run(engine, walk)
    return engine.checkpoint().progress.lines.errors[:32]


def test_errors_are_found_while_walking() -> None:
    """Walls tell the ranges; floor and ceiling of a corridor tell less of the elevations."""
    found = learnt(seen_bent(measurements(corridor(30.0, pillars=True), ALONG, RIG, 160)))
    assert abs(found[:, 0].mean()) < 0.002
    assert np.std(found[:, 0] - RANGE_M) < 0.75 * np.std(RANGE_M)
    assert np.std(found[:, 1] - ELEVATION) < 0.97 * np.std(ELEVATION)


def test_the_points_of_a_good_scanner_are_left_alone() -> None:
    """What its lines seem to be off by is no more than what the map is."""
    assert not learnt(measurements(furnished_room(), Walk(), RIG, 60)).any()


def test_at_rest_and_when_switched_off_nothing_is_learnt() -> None:
    """At rest each line meets only what it mapped itself."""
    room = furnished_room()
    assert not learnt(seen_bent(measurements(room, Walk(still=100.0), RIG, 30))).any()
    assert not learnt(seen_bent(measurements(room, Walk(), RIG, 40)), {"filter.learn_lines": False}).any()
