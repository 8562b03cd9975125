"""A client of foxglove_bridge: any ROS 1 or ROS 2 robot, without ROS here.

The protocol: JSON texts announce channels and subscribe to them. A binary message is 0x01, the subscription's number
(u32), a log time (u64 ns), little-endian, and the ROS message as it is (CDR or ROS 1).
"""

import json
import struct
import threading
import time
from dataclasses import dataclass
from typing import Literal

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Subprotocol

from app.sensors.cloud_types import CLOUD_TYPES
from app.sensors.live.cloud_reader import CloudReader
from app.sensors.live.intake import Intake
from app.sensors.log_times import LATEST_NS
from app.sensors.probe import usable_types
from app.sensors.ros import ENCODINGS, Deserialiser, imu_values, ros2_type, stamp_ns

SUBPROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))
MAX_MESSAGE = 256 << 20
RETRY_S = 1.0
_MOST_DELAY_NS = 800_000_000
"""Largest delay of a network; older log times are not trusted."""
MESSAGE = struct.Struct("<BIQ")

Sensor = Literal["lidar", "imu"]
NAMES: dict[Sensor, str] = {"lidar": "LiDAR", "imu": "IMU"}


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel that a server announces. type: as in ROS 2. definition: the type's text."""

    id: int
    topic: str
    encoding: str
    type: str
    definition: str


class FoxgloveReceiver:
    """Receives point clouds and IMU samples; connects again whenever the connection ends.

    Args:
        wanted: "lidar", "imu" or both: on the topics that the parameters name, else on the first of the type.
    """

    def __init__(self, intake: Intake, host: str, port: int, wanted: frozenset[str]) -> None:
        self._intake = intake
        self._url = f"ws://{f'[{host}]' if ':' in host else host}:{port}"
        self._wanted: list[Sensor] = [sensor for sensor in NAMES if sensor in wanted]
        chosen = intake.params.recording
        self._topics: dict[Sensor, str] = {"lidar": chosen.lidar_topic, "imu": chosen.imu_topic}
        self._deserialiser = Deserialiser()
        self._channels: dict[int, Channel] = {}
        self._subscribed: dict[int, tuple[Sensor, Channel]] = {}
        self._reader: CloudReader | None = None
        self._least_delay_ns = 0

    def __call__(self, stop: threading.Event) -> None:
        connected = False
        while not stop.is_set():
            try:
                with connect(
                    self._url, subprotocols=SUBPROTOCOLS, max_size=MAX_MESSAGE, compression=None, open_timeout=5.0,
                    close_timeout=1.0, max_queue=64, proxy=None,
                ) as connection:  # fmt: skip
                    self._intake.counters.reconnects += connected
                    connected = True
                    self._intake.put_status("connected", f"connected to {self._url}")
                    self._listen(connection, stop)
            except (OSError, WebSocketException, TimeoutError) as error:
                text = f"no connection to {self._url} ({_brief(error)}); trying again"
                self._intake.put_status("disconnected", text, once=True)
            stop.wait(RETRY_S)

    def _listen(self, connection: Connection, stop: threading.Event) -> None:
        """One connection, until it ends."""
        self._channels, self._subscribed = {}, {}
        self._least_delay_ns = time.time_ns()
        begun = time.monotonic()
        while not stop.is_set():
            try:
                message = connection.recv(timeout=0.1)
            except TimeoutError:
                if not self._channels and time.monotonic() - begun > RETRY_S:
                    text = f"{self._url} offers no topic at all; waiting for one"
                    self._intake.put_status("configuration", text, once=True)
                continue
            if isinstance(message, str):
                if self._note(message):
                    self._subscribe(connection)
            elif len(message) >= MESSAGE.size and message[0] == 1:
                _, number, log_ns = MESSAGE.unpack_from(message)
                log_ns = log_ns if log_ns < LATEST_NS else 0
                if number in self._subscribed:
                    self._receive(*self._subscribed[number], message[MESSAGE.size :], log_ns)

    def _note(self, text: str) -> bool:
        """Note channels that come and go. Returns whether any did."""
        try:
            said = json.loads(text)
            operation = said["op"]
            if operation == "advertise":
                for channel in said["channels"]:
                    kind, definition = ros2_type(str(channel["schemaName"])), str(channel.get("schema", ""))
                    found = Channel(
                        int(channel["id"]), str(channel["topic"]), str(channel["encoding"]), kind, definition
                    )
                    self._channels[found.id] = found
            elif operation == "unadvertise":
                for gone in map(int, said["channelIds"]):
                    self._channels.pop(gone, None)
                    self._subscribed.pop(gone, None)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):  # not of the protocol
            return False
        return operation in ("advertise", "unadvertise")

    def _subscribe(self, connection: Connection) -> None:
        """Subscribe to wanted channels that are not subscribed yet. A subscription has its channel's number."""
        missing = []
        for sensor in self._wanted:
            if any(sensor == other for other, _ in self._subscribed.values()):
                continue
            kinds, wanted = usable_types(sensor), self._topics[sensor]
            usable = [c for c in self._channels.values() if c.type in kinds and c.encoding in ENCODINGS]
            found = next((c for c in usable if not wanted or c.topic == wanted), None)
            if found is None:
                there = ", ".join(c.topic for c in usable or sorted(self._channels.values(), key=lambda c: c.topic))
                lacking = wanted or f"of type {' or '.join(kinds)}"
                missing.append(f"no topic {lacking} (it has {there or 'none'})")
                continue
            self._subscribed[found.id] = (sensor, found)
            self._deserialiser.learn(found.type, found.definition, found.encoding)
            request = {"op": "subscribe", "subscriptions": [{"id": found.id, "channelId": found.id}]}
            connection.send(json.dumps(request))
            others = [c.topic for c in usable if c is not found]
            hint = f"; there are also {', '.join(others)}" if others and not wanted else ""
            self._intake.put_status("connected", f"{NAMES[sensor]} on {found.topic}{hint}")
            if sensor == "lidar":
                self._reader = CloudReader(self._intake, found.topic, CLOUD_TYPES[found.type])
                self._intake.sensor = f"{found.topic} from {self._url}"
        if missing:
            text = f"{self._url} offers {'; '.join(missing)}; waiting for it"
            self._intake.put_status("configuration", text, once=True)

    def _receive(self, sensor: Sensor, channel: Channel, data: bytes, log_ns: int) -> None:
        arrival = self._arrival(log_ns)
        try:
            message = self._deserialiser.read(data, channel.type, channel.encoding)
        except Exception:  # rosbags lets errors of struct, numpy and assert pass
            self._intake.counters.unreadable += 1
            return
        if sensor == "imu":
            self._intake.counters.imu += 1
            self._intake.put_imu(stamp_ns(message.header.stamp) or log_ns, *imu_values(message), arrival)
            return
        self._intake.counters.packets += 1
        assert self._reader is not None
        for scan, arrival_ns in self._reader.add(message, log_ns, arrival):
            self._intake.counters.frames += 1
            self._intake.put_scan(scan, arrival_ns)

    def _arrival(self, log_ns: int) -> int:
        """The arrival of a message by the host's clock, corrected for the network's varying delay.

        Large clouds take longer than IMU samples. The log time is the moment at which the server had them, so the
        smallest delay so far is assumed for every message.
        """
        now = time.time_ns()
        if not log_ns:
            return now
        self._least_delay_ns = min(self._least_delay_ns, now - log_ns)
        arrival = log_ns + self._least_delay_ns
        return arrival if now - arrival < _MOST_DELAY_NS else now


def _brief(error: BaseException) -> str:
    strerror = getattr(error, "strerror", None)
    return str(strerror or " ".join(str(error).split())[:120] or type(error).__name__).rstrip(".")
