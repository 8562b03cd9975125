"""A recording sent over real sockets arrives with the content of the file.

Tests app/sensors/live/feed.py, app/sensors/live/urls.py.
"""

import contextlib
import itertools
import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.feed import Pace, feed, packets_of
from app.sensors.live.livox_udp import LivoxWriter
from app.sensors.live.source import Event
from app.sensors.live.urls import open_live, parse_address
from app.sensors.livox import DRIVERS
from app.sensors.presets import resolve_params
from app.sensors.recording import ImuEntry, ScanEntry, open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement, Scan
from tests.sensors import rig, test_livox
from tests.sensors.live import ports

SAMPLE = Path(__file__).resolve().parents[3] / "sample_data" / "cloister.mcap"
SECONDS = 2.5


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, [])


@pytest.fixture(scope="module")
def filed(params: Params) -> list[Measurement]:
    with open_recording(SAMPLE, params) as recording:
        return [m for m in recording.measurements(0, SECONDS) if isinstance(m, Measurement)]


@contextlib.contextmanager
def feeding(
    params: Params, to: str, imu_to: str | None = None, speed: float = 1.0, path: Path = SAMPLE
) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(
        target=feed,
        args=(path, params, parse_address(to), parse_address(imu_to) if imu_to else None),
        kwargs={"pace": Pace(speed, stop), "duration_s": SECONDS},
    )
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10.0)
        assert not thread.is_alive()


def pairs(events: list[Event], filed: list[Measurement]) -> list[tuple[Measurement, Measurement]]:
    """Each with the file's, by time; all but the last few that were still to come."""
    got = ports.measurements(events)
    assert len(got) >= len(filed) - 2
    by_time = {round(m.scan.end_ns / 1e7): m for m in filed}
    return [(m, by_time[round(m.scan.end_ns / 1e7)]) for m in got]


def test_as_packets_the_same_but_for_the_packets_steps(
    params: Params, filed: list[Measurement], tmp_path: Path
) -> None:
    msop, difop, imu = ports.free(3)
    url, beside = f"rsbpearl://127.0.0.1:{msop},{difop}", f"imu-udp://127.0.0.1:{imu}"
    record = tmp_path / "session.mcap"
    with open_live(url, params, beside, record) as source, feeding(params, url, beside):
        events = ports.collect(source, lambda e: len(ports.measurements(e)) >= len(filed) - 1)
        state = source.state()
    for live, file in pairs(events, filed):
        assert len(live.scan) == len(file.scan)
        distance = np.linalg.norm(live.scan.points - file.scan.points, axis=1)
        assert (
            np.median(distance) < 0.0025 and distance.max() < 0.010
        )  # half a step, and what rounding to 1/256 m hides
        times = [m.scan.stamp_ns + m.scan.offsets_ns.astype(np.int64) for m in (live, file)]
        assert np.abs(times[0] - times[1]).max() < 12_000
        np.testing.assert_array_equal(live.scan.ring, file.scan.ring)
        np.testing.assert_array_equal(live.scan.intensity, file.scan.intensity)
        np.testing.assert_array_equal(live.imu.stamps_ns, file.imu.stamps_ns)
        np.testing.assert_array_equal(live.imu.gyro, file.imu.gyro)
        np.testing.assert_array_equal(live.imu.accel, file.imu.accel)
    counters = state.counters
    assert (counters.lost, counters.late, counters.dropped, counters.imu_lost) == (0, 0, 0, 0)
    assert state.lidar_hz == pytest.approx(10.0, rel=0.3) and state.imu_hz == pytest.approx(200.0, rel=0.3)
    assert state.imu_lag_s == pytest.approx(0.0, abs=0.1) and state.clock == "sensor"
    with open_recording(record, params) as recording:
        recorded = [m for m in recording.measurements() if isinstance(m, Measurement)]
    assert len(recorded) >= len(ports.measurements(events))
    for live, again in zip(ports.measurements(events), recorded, strict=False):
        np.testing.assert_array_equal(again.scan.points, live.scan.points)
        assert abs(again.scan.stamp_ns - live.scan.stamp_ns) < 480  # f64 seconds, as drivers have them: twice 238 ns
        np.testing.assert_array_equal(again.imu.accel, live.imu.accel)
        np.testing.assert_array_equal(again.imu.stamps_ns, live.imu.stamps_ns)


def test_through_foxglove_the_same_to_the_bit(params: Params, filed: list[Measurement]) -> None:
    (port,) = ports.free(1)
    url = f"foxglove://127.0.0.1:{port}"
    with feeding(params, url, speed=2.0), open_live(url, params) as source:
        events = ports.collect(source, lambda e: len(ports.measurements(e)) >= len(filed) - 2)
    for live, file in pairs(events, filed):
        assert live.scan.stamp_ns == file.scan.stamp_ns
        for name in ("points", "offsets_ns", "intensity", "ring", "truth_ground"):
            np.testing.assert_array_equal(getattr(live.scan, name), getattr(file.scan, name))
        for name in ("stamps_ns", "gyro", "accel"):
            np.testing.assert_array_equal(getattr(live.imu, name), getattr(file.imu, name))


@pytest.mark.parametrize(("driver", "ros"), [(DRIVERS[0], 2), (DRIVERS[1], 1)])
def test_livoxs_own_message_goes_through_foxglove_as_it_is(tmp_path: Path, driver: str, ros: int) -> None:
    path = rig.write(tmp_path / "walk", livox_walk(driver, ros), "bag" if ros == 1 else "mcap")
    url = f"foxglove://127.0.0.1:{ports.free(1, socket.SOCK_STREAM)[0]}"
    with feeding(Params(), url, path=path), open_live(url, Params()) as source:
        found = ports.measurements(ports.collect(source, lambda e: len(ports.measurements(e)) >= 15))
    for number, measurement in enumerate(found):
        truth = rig.turn(number, 30)
        assert measurement.scan.stamp_ns == truth.begin_ns
        np.testing.assert_array_equal(measurement.scan.points, truth.points.astype(np.float32))
        np.testing.assert_array_equal(measurement.scan.offsets_ns, truth.offsets_ns)
        np.testing.assert_array_equal(measurement.scan.intensity, 10 + np.arange(len(truth)) % 200)


def livox_walk(driver: str, ros: int) -> list[rig.Entry]:
    def cloud(log_ns: int) -> object:
        return test_livox.message(rig.turn((log_ns - rig.START_NS) // rig.PERIOD_NS - 1, 30), driver, ros)

    entries = rig.walk(20, columns=30, ros=ros)
    return [(topic, log_ns, cloud(log_ns) if topic == "/points" else made) for topic, log_ns, made in entries]


def test_a_recording_without_an_imu_goes_through_foxglove_too(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", [entry for entry in rig.walk(20, columns=30) if entry[0] == "/points"])
    url = f"foxglove://127.0.0.1:{ports.free(1, socket.SOCK_STREAM)[0]}"
    with open_live(url, Params()) as source, feeding(Params(), url, path=path):
        deadline = time.monotonic() + 20.0
        while source.state().counters.frames < 20 and time.monotonic() < deadline:
            source.poll(0.05)
        assert source.state().counters.frames == 20


@pytest.mark.parametrize("kind", [ImuEntry, ScanEntry])
def test_one_wrong_stamp_delays_nothing(params: Params, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    """It is an hour ahead: played by the stamps alone, everything after it would wait for an hour."""
    with open_recording(SAMPLE, params) as recording:
        first, *rest = list(itertools.islice(recording.entries(), 900))
        at = [k for k, entry in enumerate(rest) if isinstance(entry, kind)][15]
        entry, hour_ns = rest[at], 3600 * 10**9
        if isinstance(entry, ImuEntry):
            rest[at] = replace(entry, stamp_ns=entry.stamp_ns + hour_ns)
        elif isinstance(entry, ScanEntry):
            rest[at] = replace(entry, scan=replace(entry.scan, stamp_ns=entry.scan.stamp_ns + hour_ns))
        plain = list(packets_of(recording, SECONDS))
        monkeypatch.setattr(recording, "entries", lambda: iter([first, *rest]))
        sent = list(packets_of(recording, SECONDS))
    assert len(sent) == pytest.approx(len(plain), abs=5)
    assert max(np.diff([one.time_ns for one in sent])) < 200_000_000
    assert sent[-1].time_ns == pytest.approx(plain[-1].time_ns, abs=200_000_000)


def test_another_lidars_recording_is_no_rsbpearls(shared_data: Path) -> None:
    path = shared_data / "garage_hdl32e.mcap"
    with open_recording(path, Params()) as recording, pytest.raises(HemislamError, match="not those of an RS-Bpearl"):
        list(packets_of(recording))


def test_a_denser_lidars_scan_is_no_mid360s() -> None:
    points, rings = np.ones((32_000, 3), np.float32), np.zeros(32_000, np.uint16)
    offsets = np.repeat(np.arange(1_000, dtype=np.int32) * 100_000, 32)
    scan = Scan(10**18, points, offsets, points[:, 0], rings)
    with pytest.raises(HemislamError, match="not those of a Mid-360"):
        LivoxWriter().add(scan)
    alone = LivoxWriter().add(Scan(10**18, points[::32], offsets[::32], points[::32, 0], rings[::32]))
    assert alone, "each point is a firing of its own"


def test_no_address_for_the_imu_is_refused(params: Params) -> None:
    with pytest.raises(HemislamError, match="--imu-to"):
        feed(SAMPLE, params, parse_address("rsbpearl://127.0.0.1:1,2"), pace=Pace(math.inf))
