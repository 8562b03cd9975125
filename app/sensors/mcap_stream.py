"""Reads an MCAP from front to back, for files that rosbags refuses: cut off, or without a ROS 2 profile."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Footer, Message, Schema
from mcap.stream_reader import StreamReader

from app.sensors.findings import Finding
from app.sensors.ros import ENCODINGS, Deserialiser, ros2_type


class McapStream:
    """Topics and messages of a file, as far as it reaches. Needs no index, no summary and no end.

    Attributes:
        counts: topic -> (type as in ROS 2, number of messages). start_ns, end_ns: log times.
        complete: whether the file has its end. findings: none; whoever opens the file knows why.
    """

    by_log_time = False
    findings: tuple[Finding, ...] = ()

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
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[Channel, str]] = {}
        with self._path.open("rb") as file:
            records = iter(StreamReader(file, validate_crcs=False, record_size_limit=1 << 30).records)
            while True:
                try:
                    record = next(records, None)
                except (EndOfFile, McapError, struct.error):  # the last of a record that is cut in its middle
                    return
                if record is None or isinstance(record, Footer):
                    self.complete = True
                    return
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.message_encoding in ENCODINGS:
                    schema = schemas.get(record.schema_id)
                    kind = ros2_type(schema.name) if schema else ""
                    if schema:
                        text = schema.data.decode(errors="replace")
                        self._deserialiser.learn(kind, text, record.message_encoding)
                    channels[record.id] = record, kind
                elif isinstance(record, Message) and record.channel_id in channels:
                    channel, kind = channels[record.channel_id]
                    yield channel.topic, kind, record.log_time, channel.message_encoding, record.data
