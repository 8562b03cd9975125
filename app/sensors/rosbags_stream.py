"""What the rosbags library reads: ROS 1 bags, ROS 2 folders and their single files."""

from collections import Counter
from collections.abc import Iterable, Iterator
from heapq import merge
from io import SEEK_CUR, BytesIO
from itertools import chain, islice, pairwise, repeat
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_bytes, read_uint32
from rosbags.typesys import Stores, get_typestore

from app.sensors.cloud_types import CLOUD_TYPES
from app.sensors.log_times import FAR_NS, FEW, LATEST_NS, SET_BACK_NS, overlap, sound_span
from app.sensors.ros import IMU, Deserialiser, read_or_lose
from app.sensors.unpacking import adapt_rosbags
from app.slam.errors import printable
from app.slam.types import I64

_PACKED = b"\x28\xb5\x2f\xfd"
"""The first bytes of data compressed by zstd."""


class RosbagsStream:
    """One recording as rosbags reads it; see `app.sensors.source.Stream`.

    Attributes:
        wild: how many messages have log times far from all others; they are left out.
        mixed: the log times between which two parts are mixed, since the recorder's clock was set back; None if it was
            not, or if it is not known.
    """

    by_log_time = True

    def __init__(self, files: list[Path]) -> None:
        """Raises whatever the library raises for a file that it cannot read."""
        adapt_rosbags()
        self._links = TemporaryDirectory()  # of links whose names end as rosbags expects
        files = [self._in_small_letters(path) for path in files]
        self._reader = AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        self._reader.open()
        self._encoding = "cdr" if self._reader.is2 else "ros1"
        self._deserialiser = Deserialiser({self._encoding: self._reader.typestore})
        self.counts: dict[str, tuple[str, int]] = {}
        for connection in self._reader.connections:
            topic = printable(connection.topic)
            _, before = self.counts.get(topic, ("", 0))
            self.counts[topic] = (printable(connection.msgtype), before + connection.msgcount)
        times = self._log_times()
        self.start_ns, self.end_ns, self.wild = self._span(times)
        spans = [span for kind, log_ns in times if kind in {IMU, *CLOUD_TYPES} and (span := overlap(log_ns))]
        self.mixed = (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        if self.wild:
            start_ns, stop_ns = max(start_ns, self.start_ns), min(stop_ns, self.end_ns)
        connections = [one for one in self._reader.connections if printable(one.topic) in topics]
        if not connections:  # rosbags would read all topics then
            return
        for connection, log_ns, raw in self._raw(connections, start_ns, stop_ns):
            message = read_or_lose(self._deserialiser.read, raw, connection.msgtype, self._encoding)
            yield printable(connection.topic), log_ns, message

    def _raw(self, connections: list[Any], start_ns: int, stop_ns: int) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, log time ns, bytes); no bytes of damaged messages, for MCAP as `adapt_rosbags` says."""
        if self._reader.is2:
            return self._reader.messages(connections, start=start_ns, stop=stop_ns)
        bags = [(bag, [one for one in connections if one.owner is bag]) for bag in self._bags()]
        return merge(*(_messages_of_bag(*bag, start_ns, stop_ns) for bag in bags if bag[1]), key=itemgetter(1))

    def may_be_disordered(self) -> bool:
        """Whether chunks of an MCAP step back in time, last too long, or are few and far away; or there are none."""
        for chunks in (file.chunks for file in self._files() if hasattr(file, "chunks")):
            if not chunks or any(chunk.message_end_time - chunk.message_start_time > FAR_NS for chunk in chunks):
                return True
            for before, after in pairwise(sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)):
                back_ns = before.message_end_time - after.message_start_time
                shared = before.message_index_offsets.keys() & after.message_index_offsets.keys()
                few = min(sum(chunk.channel_count.values()) for chunk in (before, after)) <= FEW
                if back_ns > (SET_BACK_NS if shared else FAR_NS) or (few and -back_ns > FAR_NS):
                    return True
        return False

    def is_unindexed(self) -> bool:
        """Whether an MCAP does not state which messages a chunk holds, or how many messages each topic has."""
        for chunks in (getattr(file, "chunks", []) for file in self._files()):
            if chunks and not any(chunk.message_index_offsets for chunk in chunks):
                return True
        held = sum(file.metadata.message_count for file in self._files())
        return held > 0 and not any(count for _, count in self.counts.values())

    def is_contradicted(self) -> bool:
        """Whether a metadata.yaml states other messages than its files hold."""
        held = chain.from_iterable(file.connections for file in self._files())
        return self._reader.is2 and _counted(self._reader.connections) != _counted(held)

    def has_torn_index(self) -> bool:
        """Whether a bag states other numbers of messages than its index lists, or fewer chunks than there are."""
        for bag in self._bags():
            stated = Counter[int]()
            for chunk in bag.chunk_infos:
                stated.update(chunk.connection_counts)
            if stated != Counter({number: len(index) for number, index in bag.indexes.items()}):
                return True
            if bag.chunks and bag.chunk_infos[-1].pos == max(bag.chunks):  # rosbags has just read what follows it
                try:
                    Header.read(bag.bio, RecordType.CONNECTION)
                except (ReaderError, ValueError):  # of an unknown kind, or no text
                    return True
        return False

    def is_packed(self) -> bool:
        """Whether messages are compressed one by one, which only a metadata.yaml states."""
        return any(raw[:4] == _PACKED for _, _, raw in islice(self._reader.messages(), 1))

    def close(self) -> None:
        self._reader.close()
        self._links.cleanup()

    def _span(self, times: list[tuple[str, I64]]) -> tuple[int, int, int]:
        """Log time of the first message, the end after the last, and how many are too far away to count."""
        if any(len(log_ns) for _, log_ns in times):
            return sound_span(np.concatenate([log_ns for _, log_ns in times]))
        spans = [file.metadata for file in self._files()] or self._reader.readers  # a metadata.yaml may be wrong
        start_ns, end_ns = min(one.start_time for one in spans), max(one.end_time for one in spans)
        return min(start_ns, LATEST_NS), min(end_ns, LATEST_NS), 0

    def _log_times(self) -> list[tuple[str, I64]]:
        """The log times of all messages of bags and databases: type and times of each topic of a file, in its order."""
        topics = [(one.msgtype, bag.indexes[one.id]) for bag in self._bags() for one in bag.connections]
        in_order = itemgetter(1, 2)
        times = [(kind, np.array([at.time for at in sorted(index, key=in_order)], np.int64)) for kind, index in topics]
        for file in self._files():
            if (database := getattr(file, "dbconn", None)) is not None:
                rows = database.execute(
                    "SELECT topic_id, CAST(ifnull(timestamp, 0) AS INTEGER) FROM messages ORDER BY rowid"
                )
                numbers, log_ns = np.fromiter(chain.from_iterable(rows), np.int64).reshape(-1, 2).T
                kinds = {one.id: one.msgtype for one in file.connections}
                times += [(kinds.get(number, ""), log_ns[numbers == number]) for number in np.unique(numbers).tolist()]
        return times

    def _bags(self) -> list[Any]:
        """The ROS 1 bags, as rosbags has them open."""
        return [] if self._reader.is2 else list(self._reader.readers)

    def _files(self) -> Iterator[Any]:
        """The ROS 2 files, as rosbags has them open."""
        for storage in (getattr(reader, "storage", None) for reader in self._reader.readers if self._reader.is2):
            yield from getattr(storage, "storages", [storage])

    def _in_small_letters(self, path: Path) -> Path:
        if path.suffix == path.suffix.lower():
            return path
        link = Path(self._links.name) / path.with_suffix(path.suffix.lower()).name
        link.symlink_to(path.resolve())
        return link


def _counted(connections: Iterable[Any]) -> Counter[tuple[str, str, str]]:
    """Number of messages by topic, type and encoding."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for one in connections:
        counts[one.topic, one.msgtype, str(one.ext)] += one.msgcount
    return counts


def _messages_of_bag(bag: Any, connections: list[Any], start_ns: int, stop_ns: int) -> Iterator[tuple[Any, int, bytes]]:
    """(connection, log time ns, bytes), by time; no bytes of messages that are damaged or in a damaged chunk."""
    at, chunk = -1, None
    indexes = (zip(bag.indexes[one.id], repeat(one)) for one in connections)
    for entry, connection in merge(*indexes, key=lambda found: found[0].time):
        if entry.time >= stop_ns:
            return
        if entry.time < start_ns:
            continue
        if entry.chunk_pos != at:
            at, chunk = entry.chunk_pos, _chunk_of_bag(bag, entry.chunk_pos)
        yield connection, entry.time, b"" if chunk is None else _record_of_bag(chunk, entry, connection)


def _chunk_of_bag(bag: Any, at: int) -> BytesIO | None:
    """The chunk at this place of the file; None if it cannot be unpacked."""
    size, begin, unpack = bag.chunks[at]
    bag.bio.seek(begin)
    data = bag.bio.read(size)
    try:
        return BytesIO(unpack(data))
    except Exception:  # of bz2 and lz4
        return None


def _record_of_bag(chunk: BytesIO, entry: Any, connection: Any) -> bytes:
    """The message at a place of the index; empty if there is another record."""
    chunk.seek(entry.offset)
    try:
        head = Header.read(chunk)
        while head.get_uint8("op") == RecordType.CONNECTION:
            chunk.seek(read_uint32(chunk), SEEK_CUR)
            head = Header.read(chunk)
        message = head.get_uint8("op"), head.get_uint32("conn"), head.get_time("time")
        data = read_bytes(chunk, read_uint32(chunk))
    except (ReaderError, ValueError):
        return b""
    return data if message == (RecordType.MSGDATA, connection.id, entry.time) else b""
