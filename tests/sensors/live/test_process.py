"""Receiving continues in its own process, whatever happens to the engine that polls it."""

import os
import signal
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from app.child import put
from app.sensors.live.process import LiveClient, LiveProcess
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors.live import sensor
from tests.sensors.live.test_live import Wire


def take(client: LiveClient, count: int) -> list[Measurement]:
    found: list[Measurement] = []
    deadline = time.monotonic() + 20.0
    while len(found) < count:
        assert time.monotonic() < deadline
        event = client.poll(0.1)
        assert not isinstance(event, DroppedScan)
        if isinstance(event, Measurement):
            found.append(event)
    return found


def test_an_engine_that_dies_is_followed_by_one_that_misses_nothing(tmp_path: Path) -> None:
    wire, record = Wire(), tmp_path / "session.mcap"
    packets = sensor.turns(60)
    with LiveProcess(wire.url, Params(), wire.imu_url, record) as process:
        with pytest.raises(HemislamError, match="cannot be opened"):
            LiveProcess(wire.url, Params(), wire.imu_url)
        wire.send(wire.device, sensor.difop())
        feeder = threading.Thread(target=wire.turns, args=(0, packets))
        feeder.start()
        first = LiveClient(process.address)
        before = take(first, 12)
        checkpoint = first.place
        take(first, 8)
        put(first._connection, ("poll", first.place, 5.0))  # and dies before the answer
        first.close()
        feeder.join(20.0)
        time.sleep(0.3)  # nearly forty scans have come meanwhile
        second = LiveClient(process.address)
        second.place = checkpoint
        after = take(second, 58 - 12)
        onlooker = LiveClient(process.address)
        counters = onlooker.state().counters
        assert (counters.lost, counters.dropped) == (0, 0)
        onlooker.close()
        second.close()
    whole = [*before, *after]
    turns = [round((m.scan.stamp_ns - sensor.START_NS) / (1801 * 55_520)) for m in whole]
    assert turns == list(range(58))
    arrays = [array for m in whole for array in (m.scan.points, m.scan.ring, m.imu.gyro)]
    assert not any(array.flags.writeable for array in arrays), "else kernels are compiled for them once more"
    for one, following in pairwise(whole):
        assert following.imu.stamps_ns[0] <= one.scan.end_ns <= following.imu.stamps_ns[1]
    with open_recording(record, Params()) as recording:
        recorded = [m for m in recording.measurements() if isinstance(m, Measurement)]
    assert len(recorded) >= 58
    np.testing.assert_array_equal(recorded[30].scan.points, whole[30].scan.points)
    with pytest.raises(HemislamError, match="has ended"):
        LiveClient(process.address)


def test_signals_to_the_whole_group_leave_it_to_its_owner_to_end_the_recording(tmp_path: Path) -> None:
    wire, record = Wire(), tmp_path / "session.mcap"
    with LiveProcess(wire.url, Params(), wire.imu_url, record) as process:
        client = LiveClient(process.address)
        pid = process.pid
        assert pid is not None and not process.address.ended()
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(pid, number)
        for _ in range(5):
            client.poll(0.1)
        assert process.pid == pid and client.state().counters.restarts == 0
        process.close()
        with pytest.raises(HemislamError, match="has ended"):
            client.poll(0.1)
        client.close()
        assert process.address.ended()
    assert record.read_bytes().endswith(b"\x89MCAP0\r\n")
