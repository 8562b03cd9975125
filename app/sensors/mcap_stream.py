"""Reads an MCAP from front to back, for files that rosbags refuses: cut off, or without a ROS 2 profile."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile, McapError
from mcap.reader import NonSeekingReader

from app.sensors.ros import ENCODINGS, Deserialiser, ros2_type


class McapStream:
    """Topics and messages of a file, as far as it reaches. Needs no index, no summary and no end.

    Attributes:
        counts: topic -> (type as in ROS 2, number of messages). start_ns, end_ns: log times.
        complete: whether the file has its end.
    """

    by_log_time = False

    def __init__(self, path: Path) -> None:
        """Reads the file once, to count."""
        self._path = path
        self._deserialiser = Deserialiser()
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
                yield topic, log_ns, self._deserialiser.read(data, kind, encoding)
        if not self.complete and stop_ns > self.end_ns:
            raise EndOfFile("the file ends here, in the middle of a record")

    def close(self) -> None:
        """Nothing stays open between two readings."""

    def _records(self) -> Iterator[tuple[str, str, int, str, bytes]]:
        """(topic, type, log time, encoding, bytes) up to the end or to where the file is cut."""
        known: dict[int, str] = {}
        with self._path.open("rb") as file:
            reader = NonSeekingReader(file, record_size_limit=1 << 30)
            try:
                for schema, channel, message in reader.iter_messages(log_time_order=False):
                    encoding = channel.message_encoding
                    if encoding not in ENCODINGS:
                        continue
                    if channel.id not in known:
                        kind = known[channel.id] = ros2_type(schema.name) if schema else ""
                        self._deserialiser.learn(kind, schema.data.decode(errors="replace") if schema else "", encoding)
                    yield channel.topic, known[channel.id], message.log_time, encoding, message.data
            except (EndOfFile, McapError, struct.error):  # the last of a record that is cut in its middle
                return
        self.complete = True
