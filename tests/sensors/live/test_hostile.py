"""Input that no well-behaved sensor sends: it is counted or reported in one sentence, and has no other effect.

Tests app/sensors/ros.py.
"""

import random
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import ServerConnection, serve

from app.sensors import ros
from app.sensors.cloud_types import POINT_CLOUD_2
from app.sensors.live.foxglove import SUBPROTOCOLS, CloudReader
from app.sensors.live.intake import MAX_HELD, Intake
from app.sensors.live.source import Event
from app.sensors.live.status import Status
from app.sensors.live.urls import open_live, parse_address
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Scan
from tests.sensors.live import ports, sensor

SECOND_NS = 1_000_000_000


@pytest.mark.parametrize("host", ["[::1", "a..b", "x y", "user@robot", "\0", "é" * 70, "robot:1", "[not::an::address]"])
def test_a_host_that_can_be_none_is_refused_in_one_sentence(host: str) -> None:
    with pytest.raises(HemislamError, match="host"):
        parse_address(f"foxglove://{host}:8765")


@pytest.mark.parametrize("host", ["", "robot", "robot.local", "192.168.1.5", "[::1]", "roboter-größe"])
def test_a_host_that_can_be_one_is_taken(host: str) -> None:
    assert parse_address(f"foxglove://{host}:8765").host == host.strip("[]")


def test_a_second_sensor_at_the_same_port_is_reported_and_left_out() -> None:
    lidar, device, imu = ports.free(3)
    url, imu_url = f"rsbpearl://127.0.0.1:{lidar},{device}", f"imu-udp://127.0.0.1:{imu}"
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs,
        open_live(url, Params(), imu_url) as source,
    ):
        theirs.bind(("127.0.0.2", 0))
        ours.sendto(sensor.difop(), ("127.0.0.1", device))
        packets = zip(sensor.turns(15), sensor.turns(15, distance=2000), strict=True)

        def send() -> None:
            for number, (packet, other) in enumerate(packets):
                ours.sendto(packet, ("127.0.0.1", lidar))
                if number == 150:
                    theirs.sendto(sensor.difop(rpm=1200, reverse=True), ("127.0.0.1", device))
                if number >= 150:
                    theirs.sendto(other, ("127.0.0.1", lidar))
                if number % 15 < 2:
                    stamp = sensor.START_NS + number // 15 * 10_000_000 + number % 15 * 5_000_000
                    count = 2 * (number // 15) + number % 15
                    sample = struct.pack("<4sIq6d", b"HIMU", count, stamp, 0, 0, 0, 0, 0, 9.81)
                    ours.sendto(sample, ("127.0.0.1", imu))
                if number % 15 == 14:
                    time.sleep(0.002)

        thread = threading.Thread(target=send)
        thread.start()
        events: list[Event] = ports.collect(source, lambda found: len(ports.measurements(found)) >= 12)
        thread.join(10.0)
        counters = source.state().counters
    for measurement in ports.measurements(events):
        assert np.linalg.norm(measurement.scan.points, axis=1).max() < 6.0, "theirs are 10 m away"
    told = [event.text for event in events if isinstance(event, Status) and event.kind == "configuration"]
    assert len(told) == 1 and "127.0.0.2" in told[0]
    assert counters.foreign > 1000 and counters.jumps == 0


class CountedDeque(deque[Any]):
    """Knows how many of its entries were looked at one after the other."""

    looked_at = 0

    def __iter__(self) -> Iterator[Any]:
        self.looked_at += len(self)
        return super().__iter__()


def test_an_imu_that_is_there_before_the_lidar_costs_no_more_the_longer_it_waits() -> None:
    intake = Intake(Params())
    held = intake._held = CountedDeque()
    for number in range(20_000):
        stamp = sensor.START_NS + number * 1_000_000
        intake.put_imu(stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), stamp)
    assert held.looked_at == 0
    assert len(held) <= 10_001


def test_a_clock_that_is_set_back_at_the_start_piles_up_nothing() -> None:
    intake = Intake(Params())
    for number in range(MAX_HELD + 500):
        stamp = sensor.START_NS - number * 3 * SECOND_NS
        intake.put_imu(stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), stamp)
    assert intake._held is not None and len(intake._held) <= MAX_HELD


def _odd_cloud(luck: random.Random, number: int) -> Any:
    names = (["x", "y", "z"] if luck.random() < 0.8 else []) + luck.choices(["t", "x", "ring", "", "é"], k=3)
    fields = [
        ros.new(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=luck.choice([4 * at, 4 * at, 0, 3, 2**31, 2**32 - 1]),
            datatype=luck.choice([7, 7, 0, 2, 8, 255]),
            count=luck.choice([1, 1, 0, 2**31]),
        )
        for at, name in enumerate(names)
    ]
    step = luck.choice([0, 1, 24, 24, 2**31])
    return ros.new(
        ros.CLOUD,
        header=ros.header(sensor.START_NS + number * 100_000_000, "lidar"),
        height=luck.choice([1, 1, 2, 0, 2**31]),
        width=luck.choice([100, 100, 0, 2**31]),
        fields=fields,
        is_bigendian=luck.random() < 0.2,
        point_step=step,
        row_step=luck.choice([0, step * 100, 2**31]),
        data=np.frombuffer(luck.randbytes(luck.choice([2400, 2400, 1200, 0])), np.uint8),
        is_dense=True,
    )


@pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")  # random numbers do that
def test_clouds_that_contradict_themselves_are_reported_and_take_no_memory() -> None:
    """Billions of points of no bytes each once took all there is."""
    luck, intake = random.Random(0), Intake(Params())
    for _ in range(60):
        reader = CloudReader(intake, "/points", POINT_CLOUD_2)
        for number in range(30):
            arrived = reader.add(_odd_cloud(luck, number), sensor.START_NS, sensor.START_NS)
            assert all(isinstance(scan, DroppedScan) or len(scan) <= 2400 for scan, _ in arrived)
    nothing = ros.cloud_message(Scan(0, np.ones((5, 3), np.float32), *(np.zeros(5, k) for k in ("i4", "f4", "u2"))))
    nothing.point_step, nothing.width = 0, 2_000_000_000
    ((scan, _),) = CloudReader(intake, "/points", POINT_CLOUD_2).add(nothing, 0, 0)
    assert isinstance(scan, DroppedScan) and "of 0 bytes" in scan.reason


def _channels(*channels: str) -> str:
    return '{"op": "advertise", "channels": [' + ", ".join(channels) + "]}"


TEXTS = (
    "[" * 100_000,
    "[]",
    '{"op": "advertise", "channels": ' + "9" * 5000 + "}",
    _channels('{"id": 1e400, "topic": "/points", "encoding": "cdr", "schemaName": "sensor_msgs/msg/PointCloud2"}'),
    _channels('{"id": null, "topic": 3, "encoding": [], "schemaName": "sensor_msgs/msg/Imu"}'),
    '{"op": "unadvertise", "channelIds": [[], {}, 1e400]}',
)


def test_a_server_that_talks_nonsense_is_still_listened_to_afterwards() -> None:
    said = threading.Event()

    def speak(connection: ServerConnection) -> None:
        for text in TEXTS:
            connection.send(text)
        said.wait(10.0)
        connection.send(_channels('{"id": 3, "topic": "/imu", "encoding": "cdr", "schemaName": "sensor_msgs/msg/Imu"}'))
        connection.recv(5.0)

    with serve(speak, "127.0.0.1", 0, subprotocols=[SUBPROTOCOLS[0]]) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with open_live(f"foxglove://127.0.0.1:{server.socket.getsockname()[1]}", Params()) as source:

            def heard(words: str) -> bool:
                def told(found: list[Event]) -> bool:
                    return any(words in getattr(event, "text", "") for event in found)

                return told(ports.collect(source, told))

            assert heard("offers no topic at all")
            said.set()
            assert heard("IMU on /imu")
        server.shutdown()
        thread.join(5.0)


def test_an_imu_whose_clock_stands_still_is_reported_once() -> None:
    intake = Intake(Params())
    told = []
    for tenth in range(100):
        now = sensor.START_NS + tenth * SECOND_NS // 10
        for _ in range(20):
            intake.put_imu(sensor.START_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), now)
        points, nothing = np.ones((5, 3), np.float32), np.zeros(5)
        scan = Scan(now, points, *(nothing.astype(kind) for kind in ("i4", "f4", "u2")))
        intake.put_scan(scan, now)
        told += [entry.text for entry in intake.take(0.0, scan=False)[0] if isinstance(entry, Status)]
    assert told == ["the IMU's stamps do not advance; check its driver"]
