"""A killed receiving process is restarted, and keeps everything that it had learnt, counted and recorded."""

import contextlib
import math
import os
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from app.sensors.live import process as live_process
from app.sensors.live.process import LiveClient, LiveProcess
from app.sensors.live.source import Event
from app.sensors.live.status import Status
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors.live import sensor
from tests.sensors.live.test_live import Wire

TURN_NS = 1801 * 55_520
TIMEOUT_S = 30.0


class Sender:
    """Revolutions in real time, and what becomes of them."""

    def __init__(self, wire: Wire, client: LiveClient) -> None:
        self._wire, self._client = wire, client
        self.events: list[Event] = []
        self._began_s = time.monotonic()

    def turn(self, count: int, *, polling: bool = True) -> int:
        """So many, of the sensor that turned all the time. Returns the number of the first."""
        first = math.ceil(self._now() + 8)  # making the packets takes time, and they must not be late
        packets = sensor.turns(count, start_ns=sensor.START_NS + first * TURN_NS)
        thread = threading.Thread(target=self._send, args=(first, packets))
        thread.start()
        while polling and thread.is_alive():
            self.poll()
        thread.join()
        return first

    def _send(self, first: int, packets: list[bytes]) -> None:
        """Each when it is due, or at once if that is over: who is late for long has set its clock, it would seem."""
        wire = self._wire
        for at in range(0, len(packets), 15):
            offset_ns = at // 15 * 10_000_000
            while self._now() < first + offset_ns / TURN_NS:
                time.sleep(0.002)
            for packet in packets[at : at + 15]:
                wire.send(wire.lidar, packet)
            for half in range(2):
                stamp = sensor.START_NS + first * TURN_NS + offset_ns + half * 5_000_000
                wire.send(wire.imu, struct.pack("<4sIq6d", b"HIMU", wire.number, stamp, 0, 0, 0, 0, 0, 9.81))
                wire.number += 1

    def _now(self) -> float:
        return (time.monotonic() - self._began_s) * 1e9 / TURN_NS

    def poll(self) -> None:
        event = self._client.poll(0.05)
        if event is not None:
            self.events.append(event)

    def until(self, place: int) -> None:
        """That revolution was given."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.turns or self.turns[-1] < place:
            assert time.monotonic() < deadline, (self.turns[-5:], self._client.state())
            self.poll()

    @property
    def turns(self) -> list[int]:
        return turns_of(self.events)


def turns_of(events: list[Event]) -> list[int]:
    found = [event for event in events if isinstance(event, Measurement)]
    return [round((event.scan.stamp_ns - sensor.START_NS) / TURN_NS) for event in found]


def recorded(path: Path) -> list[int]:
    """What can be read of it, be it that its end is missing."""
    found: list[Event] = []
    with contextlib.suppress(HemislamError), open_recording(path, Params()) as recording:
        found.extend(recording.measurements())
    return turns_of(found)


@contextmanager
def receiving(record: Path) -> Iterator[tuple[LiveProcess, LiveClient, Sender]]:
    wire = Wire()
    with LiveProcess(wire.url, Params(), wire.imu_url, record) as process:
        client = LiveClient(process.address)
        yield process, client, Sender(wire, client)
        client.close()


def until_told(process: LiveProcess) -> None:
    """Its owner knows what it knows now."""
    now_ns, deadline = time.time_ns(), time.monotonic() + TIMEOUT_S
    while process._known.at_ns < now_ns:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def kill(process: LiveProcess) -> None:
    """And wait until there is another one, or none any more."""
    killed = process.pid
    assert killed is not None
    os.kill(killed, signal.SIGKILL)
    deadline = time.monotonic() + TIMEOUT_S
    while not process.address.ended() and process.pid == killed:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_receiver_that_is_killed_comes_back_and_records_into_a_further_file(tmp_path: Path) -> None:
    record = tmp_path / "session.mcap"
    (tmp_path / "session-2.mcap").write_bytes(b"of somebody else")
    with receiving(record) as (process, client, sender):
        sender.until(sender.turn(16) + 13)
        last, deadline = sender.turns[-1], time.monotonic() + TIMEOUT_S
        while (before := client.state()).recorded == 0 or last - 1 not in recorded(record):  # the disk may be slow
            assert time.monotonic() < deadline
        until_told(process)
        kill(process)
        while client.state().counters.restarts == 0:  # it is asked all the time, and never in vain
            sender.poll()
        assert sender.turns == list(range(sender.turns[0], sender.turns[-1] + 1))
        first = sender.turn(8)
        sender.until(first + 5)
        after = client.state()
    assert after.counters.restarts == 1
    assert after.counters.frames >= before.counters.frames + 6 and after.counters.imu > before.counters.imu
    assert (after.counters.lost, after.counters.dropped, after.counters.jumps) == (0, 0, 0)
    assert before.recorded is not None and after.recorded is not None and after.recorded >= before.recorded > 0
    assert sender.turns[-6:] == list(range(first, first + 6)), "no second is waited for again to learn units and clocks"

    (told,) = [event for event in sender.events if isinstance(event, Status) and event.kind == "restarted"]
    assert "signal 9" in told.text and "session-3.mcap" in told.text and "nothing was received for" in told.text
    gap = next(event for event in sender.events if isinstance(event, Measurement) and turns_of([event])[0] >= first)
    assert any("no usable scan for" in notice for notice in gap.notices)

    assert last - 1 in recorded(record), "what was on disk stays readable"
    assert (tmp_path / "session-2.mcap").read_bytes() == b"of somebody else"
    assert set(recorded(tmp_path / "session-3.mcap")) >= set(range(first + 1, first + 6))


def test_scans_that_waited_for_the_engine_when_it_died_are_reported(tmp_path: Path) -> None:
    with receiving(tmp_path / "session.mcap") as (process, client, sender):
        sender.until(sender.turn(16) + 13)
        sender.turn(8, polling=False)
        time.sleep(2.0)  # the last revolution is complete after a second of silence
        waiting = client.state().backlog
        assert waiting >= 5
        until_told(process)
        kill(process)
        while not (told := [e for e in sender.events if isinstance(e, Status) and e.kind == "restarted"]):
            sender.poll()
    assert f"scans lost that waited for the engine: {waiting} by the last count" in told[0].text


def test_a_receiver_that_keeps_dying_is_given_up_and_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_process, "MOST_RESTARTS", 2)
    with receiving(tmp_path / "session.mcap") as (process, _, sender):
        for _ in range(3):
            kill(process)
        with pytest.raises(HemislamError, match=r"ended unexpectedly 3 times .*signal 9.*start hemislam again"):
            for _ in range(200):
                sender.poll()
        with pytest.raises(HemislamError, match="3 times"):
            LiveClient(process.address)
        assert process.address.ended()


def test_deaths_far_from_one_another_are_no_reason_to_give_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_process, "MOST_RESTARTS", 1)
    monkeypatch.setattr(live_process, "WITHIN_S", 0.0)
    with receiving(tmp_path / "session.mcap") as (process, client, _):
        for count in (1, 2):
            kill(process)
            while client.state().counters.restarts < count:
                time.sleep(0.05)
        assert not process.address.ended()
