"""Reads an MCAP from front to back, for those that rosbags refuses: cut off, or without a ROS 2 profile."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Footer, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_typestore

_DECODERS = {"cdr", "ros1"}


class McapStream:
    """Topics and messages of a file, as far as it reaches.

    Opening reads the file once, to count. Needs no index, no summary and no end.

    Attributes:
        counts: topic -> (type as rosbags spells it, number of messages). start_ns, end_ns: log times.
        complete: whether the file has its end.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ros2, self._ros1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
        self.counts: dict[str, tuple[str, int]] = {}
        self.complete = False
        times: tuple[int, int] | None = None
        for topic, kind, log_ns, _, _ in self._records():
            self.counts[topic] = (kind, self.counts.get(topic, (kind, 0))[1] + 1)
            times = (min(times[0], log_ns), max(times[1], log_ns)) if times else (log_ns, log_ns)
        self.start_ns, self.end_ns = times or (0, 0)

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, deserialised message), in the order of the file.

        Raises:
            EndOfFile: where the file is cut off, if messages up to `stop_ns` might have followed.
        """
        for topic, kind, log_ns, encoding, data in self._records():
            if topic in topics and start_ns <= log_ns < stop_ns:
                if encoding == "ros1":
                    yield topic, log_ns, self._ros1.deserialize_ros1(data, kind)
                else:
                    yield topic, log_ns, self._ros2.deserialize_cdr(data, kind)
        if not self.complete and stop_ns > self.end_ns:
            raise EndOfFile("the file ends here, in the middle of a record")

    def close(self) -> None:
        """Nothing stays open between two readings."""

    def _records(self) -> Iterator[tuple[str, str, int, str, bytes]]:
        """(topic, type, log time, encoding, bytes) up to the end or to where the file is cut."""
        types: dict[int, str] = {}
        channels: dict[int, Channel] = {}
        with self._path.open("rb") as file:
            records = iter(StreamReader(file, validate_crcs=False, record_size_limit=1 << 30).records)
            while True:
                try:
                    record = next(records, None)
                except (EndOfFile, McapError):
                    return
                if record is None or isinstance(record, Footer):
                    self.complete = True
                    return
                if isinstance(record, Schema):
                    types[record.id] = ros2_type(record.name)
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels.get(record.channel_id)
                    if channel is not None and channel.message_encoding in _DECODERS:
                        kind = types.get(channel.schema_id, "")
                        yield channel.topic, kind, record.log_time, channel.message_encoding, record.data


def ros2_type(name: str) -> str:
    """`sensor_msgs/Imu` of ROS 1 as `sensor_msgs/msg/Imu`."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and not rest.startswith("msg/") else name
