"""A session on a recording whose recorder was paused."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.mapping.feed import Feed, FeedInfo
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.simulator import simulate
from app.sensors.simulator.imperfections import IMPERFECT
from app.slam.doubts import doubts
from app.slam.engine import Engine
from app.slam.loops.service import InlineLoops
from app.slam.params import Params
from app.slam.types import F64, ImuSamples, Measurement

AT, LASTED_S = 70, 20
"""Frame before which the recorder was paused; how long the walker waited meanwhile."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("walk") / "museum.mcap"
    simulate("museum", path, duration_s=16.0, seed=3, every_block=12, imperfections=IMPERFECT)
    return path


@pytest.fixture(scope="module")
def params(recording: Path) -> Params:
    return resolve_params(recording, None, None, [])


@pytest.fixture(scope="module")
def walk(recording: Path, params: Params) -> list[Measurement]:
    with open_recording(recording, params) as opened:
        return [entry for entry in opened.measurements() if isinstance(entry, Measurement)]


def paused(walk: list[Measurement]) -> Iterator[Measurement]:
    """The same walk, as it is recorded if the recorder is paused while the walker stands still for a while."""
    later = LASTED_S * 10**9
    for number, m in enumerate(walk):
        if number < AT:
            yield m
        else:
            stamps = m.imu.stamps_ns + later
            stamps[0] -= later * (number == AT)  # the last sample before the pause
            imu = ImuSamples(stamps, m.imu.gyro, m.imu.accel)
            yield replace(m, scan=replace(m.scan, stamp_ns=m.scan.stamp_ns + later), imu=imu)


class Given(Feed):
    """Measurements as they are."""

    def __init__(self, measurements: Iterator[Measurement]) -> None:
        self._measurements = measurements

    @property
    def info(self) -> FeedInfo:
        return FeedInfo(Path("given"))

    def next(self) -> Measurement | None:
        return next(self._measurements, None)


def walked(measurements: Iterator[Measurement], params: Params, *, loops: bool = True) -> tuple[F64, tuple[str, ...]]:
    """(n, 3) positions in the map, and what is doubtful."""
    session = Session(Given(measurements), Engine(params), loops=InlineLoops if loops else None)
    try:
        while session.advance() is not None:
            pass
        results = session.results()
        tied = {"tied_ns": results.loops.tied_ns} if results.loops else {}
        return results.trajectory.positions, doubts(session.log, **tied)
    finally:
        session.close()


def test_loops_tie_what_follows_to_what_was_mapped_before(walk: list[Measurement], params: Params) -> None:
    straight, no_doubt = walked(iter(walk), params)
    positions, doubt = walked(paused(walk), params)
    assert no_doubt == doubt == ()
    off = np.linalg.norm(positions - straight, axis=1)
    assert np.linalg.norm(straight[-1] - straight[AT]) > 5.0
    assert off.max() < 0.25
    assert off[-1] < 0.1


def test_without_loops_both_parts_may_lie_apart_and_the_run_says_so(walk: list[Measurement], params: Params) -> None:
    _, (doubt,) = walked(paused(walk), params, loops=False)
    assert "neither scans nor IMU samples for 20.1 s" in doubt
    assert "no loop ties what follows" in doubt
