"""The client copes with any bridge: both protocol names, ROS 1 and 2, lost connections, and nonsense.

Tests app/sensors/live/foxglove_server.py, app/sensors/live/pcap.py, app/sensors/mcap_stream.py, app/sensors/probe.py,
app/sensors/source.py.
"""

import contextlib
import json
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import Server, ServerConnection, serve

from app.sensors import ros
from app.sensors.live.foxglove import Channel
from app.sensors.live.foxglove_server import FoxgloveServer
from app.sensors.live.source import Event
from app.sensors.live.status import Status
from app.sensors.live.urls import open_live
from app.slam.errors import HemislamError
from app.slam.params import Params
from tests.sensors import rig, test_livox
from tests.sensors.live import ports


class Bridge:
    """A bridge of ROS 1 or ROS 2, written after the protocol's description: sends a walk to whoever subscribes."""

    def __init__(
        self, port: int, *, ros: int = 2, name: str = "foxglove.sdk.v1", noise: bool = False, livox: bool = False
    ) -> None:
        self.ros, self.noise, self.livox = ros, noise, livox
        self.entries = rig.walk(turns=20, ros=ros, columns=30)
        self.subscribed: list[str] = []
        self.connections: list[ServerConnection] = []
        self.server: Server = serve(self._meet, "127.0.0.1", port, subprotocols=[name], max_size=None)  # type: ignore[list-item]
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()

    def __enter__(self) -> "Bridge":
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        for connection in self.connections:
            connection.close()
        self.thread.join(5.0)

    def _meet(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            self._speak(connection)

    def _speak(self, connection: ServerConnection) -> None:
        middle = "msg/" if self.ros == 2 else ""
        encoding = "cdr" if self.ros == 2 else "ros1"
        cloud = "livox_ros_driver2/CustomMsg" if self.livox else "sensor_msgs/PointCloud2"
        types = [("/other", "std_msgs/String"), ("/points", cloud), ("/imu", "sensor_msgs/Imu")]
        channels = [
            {
                "id": 7 + k,
                "topic": topic,
                "encoding": encoding,
                "schemaName": kind.replace("/", "/" + middle),
                "schema": "",
            }
            for k, (topic, kind) in enumerate(types)
        ]
        connection.send(json.dumps({"op": "serverInfo", "name": "bridge", "capabilities": ["time"]}))
        if self.noise:
            for text in (
                "",
                "[1]",
                "{}",
                '{"op": 3}',
                '{"op": "advertise"}',
                '{"op": "advertise", "channels": [{}]}',
                "x",
            ):
                connection.send(text)
            for data in (b"", b"\x01", b"\x02" + bytes(8), b"\x01" + struct.pack("<IQ", 99, 0), b"\xff" * 30):
                connection.send(data)
        connection.send(json.dumps({"op": "advertise", "channels": channels}))
        numbers: dict[int, int] = {}
        while len(numbers) < 2:
            said = json.loads(connection.recv(timeout=10.0))
            assert said["op"] == "subscribe"
            numbers.update({s["channelId"]: s["id"] for s in said["subscriptions"]})
        self.subscribed = [types[channel - 7][0] for channel in sorted(numbers)]
        typestore = rig.TYPESTORES[self.ros]
        serialise = typestore.serialize_ros1 if self.ros == 1 else typestore.serialize_cdr
        for topic, log_ns, message in self.entries:
            if self.livox and topic == "/points":
                turn = rig.turn((log_ns - rig.START_NS) // rig.PERIOD_NS - 1, columns=30)
                message = test_livox.message(turn, ros=self.ros)
            channel = 8 if topic == "/points" else 9
            data = bytes(serialise(message, message.__msgtype__))
            if self.noise and channel == 9 and log_ns % 3 == 0:
                connection.send(b"\x01" + struct.pack("<IQ", numbers[9], log_ns) + data[:20])
            connection.send(b"\x01" + struct.pack("<IQ", numbers[channel], log_ns) + data)
        connection.recv(timeout=10.0)


def enough(count: int) -> Callable[[list[Event]], bool]:
    return lambda events: len(ports.measurements(events)) >= count


def port() -> int:
    return ports.free(1, __import__("socket").SOCK_STREAM)[0]


@pytest.mark.parametrize("name", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
@pytest.mark.parametrize("ros", [1, 2])
def test_every_kind_of_bridge_is_understood(ros: int, name: str) -> None:
    number = port()
    with Bridge(number, ros=ros, name=name) as bridge, open_live(f"foxglove://127.0.0.1:{number}", Params()) as source:
        events = ports.collect(source, enough(19))
        assert bridge.subscribed == ["/points", "/imu"]
    for turn, measurement in enumerate(ports.measurements(events)):
        truth = rig.turn(turn, columns=30)
        np.testing.assert_array_equal(measurement.scan.points, truth.points)
        np.testing.assert_array_equal(measurement.scan.ring, truth.ring)
        assert measurement.imu.stamps_ns[0] <= measurement.scan.stamp_ns


@pytest.mark.parametrize("ros", [1, 2])
def test_livoxs_own_message_arrives_point_by_point(ros: int) -> None:
    number = port()
    with Bridge(number, ros=ros, livox=True), open_live(f"foxglove://127.0.0.1:{number}", Params()) as source:
        events = ports.collect(source, enough(19))
    for number, measurement in enumerate(ports.measurements(events)):
        truth = rig.turn(number, columns=30)
        assert measurement.scan.stamp_ns == truth.begin_ns
        np.testing.assert_array_equal(measurement.scan.points, truth.points.astype(np.float32))
        np.testing.assert_array_equal(measurement.scan.offsets_ns, truth.offsets_ns)


@pytest.mark.parametrize("stated", [True, False])
def test_clouds_that_arrive_late_count_from_when_the_server_had_them(stated: bool) -> None:
    """The stamps are not the time of day, so that they cannot show it."""
    entries = rig.walk(turns=16, columns=30)
    late_ns = {"/points": 300_000_000, "/imu": 0}
    kinds = {topic: message.__msgtype__ for topic, _, message in entries}
    channels = [Channel(n, topic, "cdr", kinds[topic], ros.definition(kinds[topic])) for n, topic in enumerate(late_ns)]
    with (
        FoxgloveServer("127.0.0.1", 0, channels) as server,
        open_live(f"foxglove://127.0.0.1:{server.port}", Params()) as source,
    ):
        assert server.wait_for_subscribers(10.0)
        begun = time.monotonic_ns() - entries[0][1]
        for topic, log_ns, message in sorted(entries, key=lambda entry: entry[1] + late_ns[entry[0]]):
            time.sleep(max(begun + log_ns + late_ns[topic] - time.monotonic_ns(), 0) * 1e-9)
            server.publish([*late_ns].index(topic), log_ns if stated else 0, ros.serialised(message))
        ports.collect(source, enough(10))
        assert source.state().clock == ("sensor" if stated else "host")


def test_nonsense_from_a_server_is_passed_over() -> None:
    number = port()
    with Bridge(number, noise=True), open_live(f"foxglove://127.0.0.1:{number}", Params()) as source:
        ports.collect(source, enough(19))
        assert source.state().counters.unreadable > 20


def test_a_log_time_that_no_integer_holds_is_none() -> None:
    channels = [Channel(0, "/points", "cdr", ros.CLOUD, ""), Channel(1, "/imu", "cdr", ros.IMU, "")]
    with (
        FoxgloveServer("127.0.0.1", 0, channels) as server,
        open_live(f"foxglove://127.0.0.1:{server.port}", Params()) as source,
    ):
        assert server.wait_for_subscribers(5.0)
        for topic, _, message in rig.walk(turns=20, columns=30):
            message.header = ros.header(0, "")
            server.publish(["/points", "/imu"].index(topic), 2**63, ros.serialised(message))
        ports.collect(source, lambda events: source.state().counters.packets == 20)
        assert source.state().lidar_age_s is not None


def test_a_connection_that_ends_is_made_again() -> None:
    number = port()
    with open_live(f"foxglove://127.0.0.1:{number}", Params()) as source:
        events = ports.collect(source, lambda e: told(e, "disconnected") == 1)
        with Bridge(number):
            events += ports.collect(source, enough(19))
        events += ports.collect(source, lambda e: told(e, "disconnected") >= 1)
        with Bridge(number):
            ports.collect(source, lambda e: told(e, "connected") >= 3)
        assert source.state().counters.reconnects >= 1


def told(events: list[Event], kind: str) -> int:
    return sum(isinstance(event, Status) and event.kind == kind for event in events)


def test_topics_are_chosen_by_name_and_missing_ones_are_reported() -> None:
    number = port()
    params = Params().with_values({"recording.lidar_topic": "/elsewhere"})
    with Bridge(number), open_live(f"foxglove://127.0.0.1:{number}", params) as source:
        events = ports.collect(source, lambda e: told(e, "configuration") >= 1)
    text = next(e.text for e in events if isinstance(e, Status) and e.kind == "configuration")
    assert "no topic /elsewhere" in text and "/points" in text


def test_our_server_offers_both_names_and_survives_clients_that_leave() -> None:
    channels = [Channel(i, name, "cdr", "sensor_msgs/msg/Imu", "text") for i, name in enumerate(("/a", "/b"))]
    with FoxgloveServer("127.0.0.1", 0, channels) as server:
        for name in ("foxglove.sdk.v1", "foxglove.websocket.v1"):
            with connect(f"ws://127.0.0.1:{server.port}", subprotocols=[name], proxy=None) as client:  # type: ignore[list-item]
                assert client.subprotocol == name
                said: list[Any] = [json.loads(client.recv(timeout=5.0)) for _ in range(2)]
                assert [s["op"] for s in said] == ["serverInfo", "advertise"]
                assert [c["topic"] for c in said[1]["channels"]] == ["/a", "/b"]
                client.send("nonsense")
                client.send(b"nonsense")
                for number in (-1, 2**32, 1e999):
                    client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": number, "channelId": 0}]}))
                client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 5, "channelId": 1}]}))
                assert not server.wait_for_subscribers(0.2)
                server.publish(0, 1, b"nobody asked")
                server.publish(1, 77, b"data")
                assert client.recv(timeout=5.0) == b"\x01" + struct.pack("<IQ", 5, 77) + b"data"
        time.sleep(0.05)
        server.publish(1, 78, b"to nobody")
        with pytest.raises(HemislamError, match="cannot be opened"):
            FoxgloveServer("127.0.0.1", server.port, channels)
