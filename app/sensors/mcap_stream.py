"""Reads MCAP files from front to back: files that rosbags refuses (cut off, or without a ROS 2 profile), and files that
it would put in a wrong order, since it sorts by log time and the recorder's clock was set back.
"""

import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from app.sensors.log_times import LATEST_NS, SET_BACK_NS, mended
from app.sensors.ros import ENCODINGS, Deserialiser, read_or_lose, ros2_type
from app.sensors.unpacking import LIMIT, UNPACK, TooLarge
from app.slam.errors import printable


class McapStream:
    """Topics and messages of the pieces of a recording, as far as each reaches. Needs no index, summary or footer.

    Attributes:
        counts: topic -> (type as in ROS 2, number of messages). start_ns, end_ns: log times.
        pieces: as given, in order of time. cut: those without an end.
        set_back: (number of a message, ns): where the recorder's clock was set back, and by how much. From there on,
            this is added to log times, so that they are continuous.
        sorted: whether log times never step back, not even by a little.
        wild: how many messages have log times far from those around them; better ones are given for these.
    """

    by_log_time = False

    def __init__(self, pieces: Sequence[Path]) -> None:
        """Reads the files once, to count."""
        self._deserialiser = Deserialiser()
        self.counts: dict[str, tuple[str, int]] = {}
        self.cut: list[Path] = []
        self.set_back: list[tuple[int, int]] = []
        self.pieces = sorted(pieces, key=self._begin)
        first_ns, last_ns, added_ns = 0, 0, 0
        last: dict[str, int] = {}
        topics, times = list[str](), array("q")
        for topic, kind, log_ns, _, _ in self._all_records():
            self.counts[topic] = (kind, self.counts.get(topic, (kind, 0))[1] + 1)
            topics.append(topic)
            times.append(log_ns)
        self._better = mended(np.array(times, np.int64))
        self.wild = len(self._better)
        self.sorted = all(before <= after for before, after in pairwise(times))
        for number, topic in enumerate(topics):
            log_ns = self._better.get(number, times[number])
            if log_ns + added_ns < last.get(topic, log_ns + added_ns) - SET_BACK_NS:
                self.set_back.append((number, last_ns + 1 - log_ns - added_ns))
                added_ns += self.set_back[-1][1]
            log_ns += added_ns
            first_ns = min(first_ns or log_ns, log_ns)
            last_ns = max(last_ns, log_ns)
            last[topic] = log_ns
        self.start_ns, self.end_ns = first_ns, last_ns

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, deserialised message), in the order of the file.

        Raises:
            EndOfFile: where the last piece is cut off, if messages up to `stop_ns` might have followed.
        """
        added_ns, set_back = 0, dict(self.set_back)
        for number, (topic, kind, log_ns, encoding, data) in enumerate(self._all_records()):
            added_ns += set_back.get(number, 0)
            log_ns = self._better.get(number, log_ns)
            if topic in topics and start_ns <= log_ns + added_ns < stop_ns:
                yield topic, log_ns + added_ns, read_or_lose(self._deserialiser.read, data, kind, encoding)
        if self.pieces[-1] in self.cut and stop_ns > self.end_ns:
            raise EndOfFile("the file ends here, in the middle of a record")

    def close(self) -> None:
        """Nothing stays open between two readings."""

    def _begin(self, piece: Path) -> int:
        """Log time of one of its first messages; 0 without any."""
        first = sorted(log_ns for _, _, log_ns, _, _ in islice(self._records_of(piece), 5))
        return first[len(first) // 2] if first else 0

    def _all_records(self) -> Iterator[tuple[str, str, int, str, bytes]]:
        for piece in self.pieces:
            yield from self._records_of(piece)

    def _records_of(self, piece: Path) -> Iterator[tuple[str, str, int, str, bytes]]:
        """(topic, type, log time, encoding, bytes) up to the end or to where the file is cut."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, tuple[str, str, str]] = {}  # topic, type, encoding
        with piece.open("rb") as file:
            try:
                for record in _unpacked(file):
                    if isinstance(record, Chunk):  # a damaged one
                        for topic, kind, encoding in channels.values():
                            yield topic, kind, min(record.message_start_time, LATEST_NS), encoding, b""
                    elif isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel) and record.message_encoding in ENCODINGS:
                        schema, encoding = schemas.get(record.schema_id), record.message_encoding
                        kind = ros2_type(printable(schema.name)) if schema else ""
                        channels[record.id] = (printable(record.topic), kind, encoding)
                        self._deserialiser.learn(kind, schema.data.decode(errors="replace") if schema else "", encoding)
                    elif isinstance(record, Message) and record.channel_id in channels:
                        topic, kind, encoding = channels[record.channel_id]
                        yield topic, kind, min(record.log_time, LATEST_NS), encoding, record.data
            except (EndOfFile, McapError, struct.error):  # the last of a record that is cut in its middle
                if piece not in self.cut:
                    self.cut.append(piece)


def _unpacked(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records of a file and of its chunks; a chunk that is damaged comes as it is. Raises what mcap raises."""
    for record in StreamReader(file, emit_chunks=True, record_size_limit=LIMIT).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            records = _records_in(record)
        except Exception:  # of the compressions, struct and mcap
            records = [record]
        yield from records


def _records_in(chunk: Chunk) -> list[McapRecord]:
    if chunk.uncompressed_size > LIMIT:
        raise TooLarge
    if chunk.compression:
        data = UNPACK[chunk.compression](chunk.data, chunk.uncompressed_size)
        chunk = replace(chunk, compression="", data=data)
    return breakup_chunk(chunk, validate_crc=True)
