"""Recording files as a stream of messages, and every failure of theirs as one clear sentence."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from app.slam.errors import HemislamError

POINTCLOUD = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"

SUFFIXES = (".bag", ".mcap", ".db3")


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording. `messages`: how many it holds."""

    name: str
    type: str
    messages: int


class Source:
    """A recording opened for reading: its topics, and its messages in the order they were logged."""

    def __init__(self, path: Path) -> None:
        """Open.

        Raises:
            HemislamError: missing, empty, cut, foreign, corrupt or unindexed file.
        """
        self.path = path
        self._reader = _open(path)
        counts: dict[str, tuple[str, int]] = {}
        for connection in self._reader.connections:
            _, before = counts.get(connection.topic, ("", 0))
            counts[connection.topic] = (connection.msgtype, before + connection.msgcount)
        self.topics = tuple(Topic(name, kind, count) for name, (kind, count) in sorted(counts.items()))
        self.start_ns = int(self._reader.start_time)
        self.end_ns = int(self._reader.end_time)

    def messages(
        self, topics: tuple[str, ...], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, deserialised message) of these topics, by log time.

        Raises:
            HemislamError: the file is damaged here; everything before was given.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        log_ns = self.start_ns
        stream = self._reader.messages(connections, start=start_ns, stop=stop_ns)
        while True:
            try:
                connection, log_ns, raw = next(stream)
                message = self._reader.deserialize(raw, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:  # rosbags lets errors of zstd, lz4, sqlite, struct and asserts through
                raise HemislamError(
                    f"{self.path} is damaged {(log_ns - self.start_ns) / 1e9:.1f} s after its start "
                    f"({_brief(error)}); what comes before it was read, the rest can not be."
                ) from error
            yield connection.topic, log_ns, message

    def close(self) -> None:
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _open(path: Path) -> AnyReader:
    if not path.exists():
        raise HemislamError(f"There is no recording {path}; check the path.")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:
        raise HemislamError(f"{path} can not be read as a recording ({_brief(error)}).") from error
    return reader


def _brief(error: BaseException) -> str:
    """The library's own words, shortened to fit into our sentence."""
    if isinstance(error, struct.error):
        return "a record is cut"
    text = " ".join(str(error).split()).rstrip(".")
    return text[:120] or type(error).__name__
