"""A live source survives faults of sensors, networks and a busy engine, and reports them.

Tests app/sensors/live/clock.py, app/sensors/live/intake.py, app/sensors/live/source.py.
"""

import random
import re
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.clock import ClockMap
from app.sensors.live.intake import BUSY, MAX_BACKLOG, Intake
from app.sensors.live.source import Event, LiveSource
from app.sensors.live.status import Status
from app.sensors.live.urls import open_live, parse_address
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement, Scan
from tests.sensors.live import ports, sensor

TURN_NS = 100_000_000


class Rig:
    """A LiDAR and an IMU without sockets: put in by hand, each stamped by a clock of its own."""

    def __init__(self, params: Params | None = None) -> None:
        self.intake = Intake(params or Params())
        self.source = LiveSource([], self.intake)
        self.lidar_ns = self.imu_ns = sensor.START_NS
        self.now = time.time_ns()
        self.accel = (0.0, 0.0, 9.81)
        self.turns = 0
        self.noise = np.random.default_rng(0)

    def turn(self, *, lidar: bool = True, imu: bool = True, zeros: bool = False) -> None:
        """A tenth of a second, and the IMU sample after it: the last one is used when another follows."""
        for k in range(0 if self.turns == 0 else 2, 22):
            if imu:
                (wx, wy, wz), (x, y, z) = self.noise.normal(size=(2, 3)) * 1e-3
                accel = (self.accel[0] + x, self.accel[1] + y, self.accel[2] + z)
                gyro, accel = ((0.0, 0.0, 0.0),) * 2 if zeros else ((wx, wy, wz), accel)
                self.intake.put_imu(self.imu_ns + k * 5_000_000, gyro, accel, self.now + k * 5_000_000)
        if lidar:
            points = np.full((100, 3), 2.0 + self.turns, np.float32)
            offsets = np.linspace(0, 99_000_000, 100).astype(np.int32)
            scan = Scan(self.lidar_ns, points, offsets, np.zeros(100, np.float32), np.zeros(100, np.uint16))
            self.intake.put_scan(scan, self.now + 100_000_000)
        self.lidar_ns += TURN_NS
        self.imu_ns += TURN_NS
        self.now += TURN_NS
        self.turns += 1

    def events(self) -> list[Event]:
        found: list[Event] = []
        while (event := self.source.poll(0.0)) is not None:
            found.append(event)
        return found


def scans(events: list[Event]) -> list[int]:
    """Which revolutions were paired."""
    return [int(m.scan.points[0, 0] - 2.0) for m in events if isinstance(m, Measurement)]


def kinds(events: list[Event]) -> list[tuple[str, str]]:
    """The kinds of news, each with the sensor that its text names first."""
    told = [event for event in events if isinstance(event, Status)]
    return [(one.kind, next(iter(re.findall("LiDAR|IMU", one.text)), "")) for one in told]


def test_nothing_is_given_before_the_first_second_and_nothing_of_it_is_lost() -> None:
    rig = Rig()
    for _ in range(9):
        rig.turn()
    assert rig.events() == []
    for _ in range(6):
        rig.turn()
    assert scans(rig.events()) == list(range(15))


def test_a_busy_engine_loses_whole_scans_the_oldest_first_and_no_sample() -> None:
    rig = Rig()
    for _ in range(12):
        rig.turn()
    before = rig.events()
    for _ in range(MAX_BACKLOG + 15):
        rig.turn()
    events = rig.events()
    dropped = [e for e in events if isinstance(e, DroppedScan)]
    last = 12 + MAX_BACKLOG + 15
    assert scans(events) == list(range(last - MAX_BACKLOG, last))
    assert [d.stamp_ns for d in dropped] == [sensor.START_NS + k * TURN_NS for k in range(12, last - MAX_BACKLOG)]
    assert {d.reason for d in dropped} == {BUSY}
    assert rig.source.state().counters.dropped == 15
    stamps = np.concatenate([m.imu.stamps_ns for m in ports.measurements(before + events)])
    assert np.diff(np.unique(stamps)).max() == 5_000_000  # without a gap, over the scans that were dropped too


def test_no_scan_is_dropped_while_another_engine_starts() -> None:
    rig = Rig()
    for _ in range(80):
        rig.turn()
    assert scans(rig.events()) == list(range(80))


@pytest.mark.parametrize("who", ["lidar", "imu", "both"])
@pytest.mark.parametrize("jump_s", [-86_400, -2, 3, 86_400])
def test_a_clock_that_is_set_is_reported_and_time_goes_on(who: str, jump_s: int) -> None:
    rig = Rig()
    for _ in range(15):
        rig.turn()
    events = rig.events()
    if who != "imu":
        rig.lidar_ns += jump_s * 10**9
    if who != "lidar":
        rig.imu_ns += jump_s * 10**9
    for _ in range(15):
        rig.turn()
    events += rig.events()
    expected = {"lidar": ["LiDAR"], "imu": ["IMU"], "both": ["IMU", "LiDAR"]}[who]
    assert sorted(name for kind, name in kinds(events) if kind == "jump") == expected
    found = ports.measurements(events)
    assert scans(events) in (list(range(30)), list(range(29)))  # a jitter of nothing, so the last sample may do or not
    for m in found[-5:]:  # the two still agree
        turn = round(float(m.scan.points[0, 0])) - 2
        assert m.scan.stamp_ns == pytest.approx(sensor.START_NS + turn * TURN_NS, abs=1_000_000)
        assert m.imu.stamps_ns[0] <= m.scan.stamp_ns <= m.scan.end_ns <= m.imu.stamps_ns[-1]


def test_one_wild_stamp_of_the_imu_is_left_out() -> None:
    rig = Rig()
    for number in range(20):
        rig.turn()
        if number == 14:
            rig.intake.put_imu(sensor.START_NS + 10**13, (0, 0, 0), (0, 0, 9.81), rig.now)
    events = rig.events()
    assert kinds(events) == []
    assert rig.source.state().counters.strays == 1
    assert scans(events) == list(range(20))


def test_sensors_with_clocks_of_their_own_are_put_on_the_hosts() -> None:
    rig = Rig()
    rig.imu_ns = 5 * 10**9  # counts from its start
    for _ in range(20):
        rig.turn()
    events = rig.events()
    assert kinds(events) == [("clocks", "IMU")]
    assert rig.source.state().clock == "host"
    found = ports.measurements(events)
    assert len(found) >= 19
    for m in found:
        assert m.scan.end_ns == pytest.approx(
            rig.now - (rig.turns - 1 - round(float(m.scan.points[0, 0]) - 2)) * 1e8, abs=5e6
        )


def test_acceleration_in_g_is_scaled_and_reported() -> None:
    rig = Rig()
    rig.accel = (0.0, 0.0, 1.0)
    for _ in range(12):
        rig.turn()
    events = rig.events()
    assert ("units", "IMU") in kinds(events)
    assert ports.measurements(events)[0].imu.accel[0, 2] == pytest.approx(9.80665, abs=0.05)


@pytest.mark.parametrize("zeros", [False, True])
def test_scans_go_on_without_an_imu_that_dies_and_with_it_when_it_is_back(
    zeros: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    silence_s = "app.sensors.live.source.SILENCE_S"
    monkeypatch.setattr(silence_s, 100.0)
    rig = Rig()
    for _ in range(12):
        rig.turn()
    assert scans(rig.events()) == list(range(12))
    for _ in range(8):
        rig.turn(imu=zeros, zeros=zeros)
    assert scans(rig.events()) == [], "it may only be late"
    monkeypatch.setattr(silence_s, 0.0)
    alone = rig.events() + rig.events()
    assert scans(alone) == list(range(12, 19)), "the last one waits for the next"
    monkeypatch.setattr(silence_s, 100.0)
    for _ in range(5):
        rig.turn()
    back = rig.events()
    assert scans(alone + back) == list(range(12, 25))
    notices = [notice for m in ports.measurements(alone + back) for notice in m.notices]
    assert sum("fallen silent" in notice for notice in notices) == 1
    assert sum("no IMU sample for 0.8" in notice for notice in notices) == 1
    assert not [event for event in alone + back if isinstance(event, DroppedScan)]


def test_the_hosts_clock_follows_a_drifting_sensor_by_the_messages_that_did_not_wait() -> None:
    rng = random.Random(0)
    clock = ClockMap(host=True)
    errors = []
    for number in range(60_000):  # five minutes at 200 Hz, 50 ppm too slow, half of the messages up to 30 ms late
        true = 10**18 + number * 5_000_000
        stamp = 7 * 10**9 + round(number * 5_000_000 * (1 - 50e-6))
        delay = 1_000_000 + (rng.randrange(30_000_000) if rng.random() < 0.5 else 0)
        errors.append(clock.map(stamp, true + delay) - true)
    late = np.array(errors[2_000:])
    assert np.abs(late - 1_000_000).max() < 600_000
    assert not clock.jumped_at_ns


# --- over sockets --------------------------------------------------------------------------------


class Wire:
    """Sends packets of an RS-Bpearl and IMU samples to a source on this machine, as fast as one likes."""

    def __init__(self, options: str = "") -> None:
        self.lidar, self.device, self.imu = ports.free(3)
        self.url = f"rsbpearl://127.0.0.1:{self.lidar},{self.device}{options}"
        self.imu_url = f"imu-udp://127.0.0.1:{self.imu}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.number = 0

    def send(self, port: int, data: bytes) -> None:
        self._socket.sendto(data, ("127.0.0.1", port))

    def turns(self, begin: int, packets: list[bytes], pause_s: float = 0.02) -> None:
        """Packets of revolutions from `begin` on, with the IMU beside them."""
        for at in range(0, len(packets), 15):
            for packet in packets[at : at + 15]:
                self.send(self.lidar, packet)
            for _ in range(2):
                stamp = sensor.START_NS + begin * 1801 * 55_520 + at // 15 * 10_000_000 + self.number % 2 * 5_000_000
                self.send(self.imu, struct.pack("<4sIq6d", b"HIMU", self.number, stamp, 0, 0, 0, 0, 0, 9.81))
                self.number += 1
            time.sleep(pause_s / 10)


def count(kind: str) -> object:
    return lambda events: any(isinstance(e, Status) and e.kind == kind for e in events)


def test_ten_percent_lost_doubled_shuffled_and_broken_packets_still_make_every_scan() -> None:
    wire = Wire()
    rng = random.Random(0)
    packets = []
    for packet in sensor.turns(25):
        luck = rng.random()
        packets += [] if luck < 0.1 else [packet, packet] if luck < 0.15 else [packet]
        if luck > 0.95:
            packets.append(rng.randbytes(rng.randrange(1400)))
        if luck > 0.9:
            packets.append(packet[: rng.randrange(8, 1248)])
    order = sorted(range(len(packets)), key=lambda k: k + rng.uniform(0, 2.5))
    with open_live(wire.url, Params(), wire.imu_url) as source:
        wire.send(wire.device, sensor.difop())
        thread = threading.Thread(target=wire.turns, args=(0, [packets[k] for k in order]))
        thread.start()
        events = ports.collect(source, lambda e: len(ports.measurements(e)) >= 23)
        thread.join(10.0)
        counters = source.state().counters
    found = ports.measurements(events)
    assert [round((m.scan.stamp_ns - sensor.START_NS) / (1801 * 55_520)) for m in found[:23]] == list(range(23))
    assert all(len(m.scan) > 0.8 * 1801 * 32 for m in found[1:23])
    assert counters.lost == pytest.approx(0.1 * 25 * 150, rel=0.3)
    assert counters.truncated > 100 and counters.foreign > 50 and counters.duplicates > 50 and counters.reordered > 100


def test_silence_return_and_another_configuration_are_reported() -> None:
    wire = Wire()
    packets = sensor.turns(14)
    with open_live(wire.url, Params(), wire.imu_url) as source:
        wire.send(wire.device, sensor.difop())
        wire.turns(0, packets[:1800])
        events = ports.collect(source, lambda events: [kind for kind, _ in kinds(events)].count("silent") == 2)
        wire.send(wire.device, sensor.difop(rpm=1200, reverse=True))
        wire.turns(12, packets[1800:])
        for kind in ("back", "configuration"):  # in either order
            if not any(found == kind for found, _ in kinds(events)):
                events += ports.collect(source, count(kind))  # type: ignore[arg-type]
    told = kinds(events)
    first = next(event for event in events if isinstance(event, Status))
    assert first.kind == "connected" and "RS-Bpearl" in first.text
    assert ("silent", "LiDAR") in told and ("silent", "IMU") in told
    assert ("configuration", "LiDAR") in told and any(kind == "back" for kind, _ in told)
    text = next(e.text for e in events if isinstance(e, Status) and e.kind == "configuration")
    assert "1200 rpm" in text and "reversed" in text


def test_angles_are_waited_for_but_not_forever() -> None:
    wire = Wire()
    with open_live(wire.url, Params(), wire.imu_url) as source:
        wire.turns(0, sensor.turns(13))
        events = ports.collect(source, lambda e: bool(ports.measurements(e)))
    text = next(e.text for e in events if isinstance(e, Status) and e.kind == "configuration")
    assert "nominal" in text


@pytest.mark.parametrize(
    ("lidar", "imu", "words"),
    [
        ("rosbag://x", None, "is not a live source"),
        ("rsbpearl://0.0.0.0:6699,7788", None, "hold no IMU samples"),
        ("rsbpearl://0.0.0.0:66999", "imu-udp://:1", "no valid ports"),
        ("rsbpearl://0.0.0.0:a,b", "imu-udp://:1", "no valid ports"),
        ("rsbpearl://0.0.0.0?speed=2", "imu-udp://:1", "no option `speed`"),
        ("rsbpearl://0.0.0.0?clock=moon", "imu-udp://:1", "`auto`, `sensor` or `host`"),
        ("rsbpearl://0.0.0.0?angles=/none.csv", "imu-udp://:1", "cannot be read"),
        ("imu-udp://:1", None, "gives no point clouds"),
    ],
)
def test_an_address_that_cannot_be_is_refused_in_one_sentence(lidar: str, imu: str | None, words: str) -> None:
    with pytest.raises(HemislamError, match=words):
        open_live(lidar, Params(), imu)


def test_addresses_have_the_sensors_own_ports_by_default() -> None:
    assert parse_address("rsbpearl://0.0.0.0").ports == (6699, 7788)
    assert parse_address("rsbpearl://:1700").ports == (1700, 7788)
    assert parse_address("foxglove://robot").host == "robot"
    assert parse_address("foxglove://[::1]:9").host == "::1"
    assert (parse_address("foxglove://[::1]").host, parse_address("foxglove://[::1]").ports) == ("::1", (8765,))
    assert parse_address("rsbpearl://10.0.0.1:1,2?clock=host&angles=a.csv").options == {
        "clock": "host",
        "angles": "a.csv",
    }


def test_a_port_in_use_is_refused() -> None:
    wire = Wire()
    with (
        open_live(wire.url, Params(), wire.imu_url),
        pytest.raises(HemislamError, match=f"UDP port {wire.imu} .* cannot be opened"),
    ):
        open_live(wire.url, Params(), wire.imu_url)


def test_recording_over_a_file_is_refused(tmp_path: Path) -> None:
    wire = Wire()
    (tmp_path / "x.mcap").write_bytes(b"precious")
    with pytest.raises(HemislamError, match="is there already"):
        open_live(wire.url, Params(), wire.imu_url, tmp_path / "x.mcap")
    assert (tmp_path / "x.mcap").read_bytes() == b"precious"
    with open_live(wire.url, Params(), wire.imu_url):  # the ports were given back
        pass


@pytest.mark.parametrize("bad", [(0.0, 0.0, 1e30), (float("nan"), 0.0, 9.81), (0.0, 80.0, 9.81)])
def test_a_bad_sample_is_left_out_and_nothing_else(bad: tuple[float, float, float]) -> None:
    rig = Rig()
    for _ in range(12):
        rig.turn()
    rig.intake.put_imu(rig.imu_ns + 6_500_000, (0.0, 0.0, 0.0), bad, rig.now + 6_500_000)
    for _ in range(5):
        rig.turn()
    found = ports.measurements(rig.events())
    assert scans(list(found)) == list(range(17))
    assert sum("left out" in notice for one in found for notice in one.notices) == 1
    assert max(np.abs(one.imu.accel).max() for one in found) < 20


def test_an_accelerometer_that_reads_nothing_is_reported_and_waited_for() -> None:
    rig = Rig()
    for turn in range(140):
        if turn < 20:
            for k in range(20):
                rig.intake.put_imu(rig.imu_ns + k * 5_000_000, (0, 0, 0), (0.0, 0.0, 0.0), rig.now + k * 5_000_000)
        rig.turn(imu=turn >= 20)
    events = rig.events()
    assert ("units", "IMU") in kinds(events)
    assert len(scans(events)) >= 100
