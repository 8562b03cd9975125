"""Recording files as a stream of messages, and every failure of theirs as one clear sentence."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from app.sensors.findings import Finding
from app.sensors.live.capture import SUFFIXES as CAPTURES
from app.sensors.live.capture import CaptureStream
from app.sensors.live.pcap import CaptureError
from app.sensors.mcap_stream import McapStream
from app.slam.errors import HemislamError

SUFFIXES = (".bag", ".mcap", ".db3", *CAPTURES)
_MAGIC = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_REPAIR = {
    ".bag": "`rosbag reindex {path}` repairs it",
    ".mcap": "`mcap recover {path} -o repaired.mcap` saves what is whole",
    ".db3": "`sqlite3 {path} .recover | sqlite3 repaired.db3` saves what is whole",
    **dict.fromkeys(CAPTURES, "`tcpdump -r {path} -w repaired.pcap` saves what is whole"),
    "": "`ros2 bag reindex {path}` may repair it",
}
_KINDS = "a ROS 1 .bag, a ROS 2 folder, an .mcap, a .db3, or a .pcap of an RS-Bpearl"
_FOREVER = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording. `messages`: how many it holds."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Mark:
    """A message that was read: how many there were until then, its log time, and how many of them had just that."""

    read: int
    log_ns: int
    at_log_ns: int

    @classmethod
    def after(cls, mark: "Mark | None", log_ns: int) -> "Mark":
        """The mark of the message, logged at `log_ns`, that comes next after `mark`."""
        if mark is None:
            return cls(1, log_ns, 1)
        return cls(mark.read + 1, log_ns, mark.at_log_ns + 1 if mark.log_ns == log_ns else 1)


class Source:
    """A recording opened for reading: its topics, and its messages by log time.

    Attributes:
        path: as given. topics: by name. start_ns, end_ns: log times of the first and last message.
        findings: what is unusual about the file and was overcome.
    """

    def __init__(self, path: Path) -> None:
        """Open.

        Raises:
            HemislamError: missing, empty, cut, foreign, corrupt or unindexed file.
        """
        self.path = path
        self.findings: tuple[Finding, ...] = ()
        files = _recording_files(path)
        self._reader: AnyReader | McapStream | CaptureStream = self._open(files)
        if isinstance(self._reader, McapStream | CaptureStream):
            counts = self._reader.counts
            self.start_ns, self.end_ns = self._reader.start_ns, self._reader.end_ns
        else:
            counts = {}
            for connection in self._reader.connections:
                _, before = counts.get(connection.topic, ("", 0))
                counts[connection.topic] = (connection.msgtype, before + connection.msgcount)
            self.start_ns, self.end_ns = int(self._reader.start_time), int(self._reader.end_time)
        self.topics = tuple(Topic(name, kind, count) for name, (kind, count) in sorted(counts.items()))
        if not any(topic.messages for topic in self.topics):
            self.close()
            raise HemislamError(f"{path} is a recording without a single message; record it again.")

    def messages(
        self,
        topics: tuple[str, ...],
        start_ns: int | None = None,
        stop_ns: int | None = None,
        after: Mark | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, deserialised message) of these topics, logged within [start, stop).

        Args:
            after: where an earlier call with the same arguments was; this one goes on from there.

        Raises:
            HemislamError: the file is damaged here; everything before was given.
        """
        first, stop = 0 if start_ns is None else start_ns, _FOREVER if stop_ns is None else stop_ns
        stream: Iterator[tuple[str, int, Any]]
        if isinstance(self._reader, McapStream):  # in the order of the file, whatever the log times
            stream = self._reader.messages(topics, first, stop)
            known = after.read if after else 0
        else:
            known = after.at_log_ns if after else 0
            first = after.log_ns if after else first
            if isinstance(self._reader, CaptureStream):
                stream = self._reader.messages(topics, first, stop)
            else:
                stream = self._rosbags_messages(self._reader, topics, first, stop)
        stream = islice(stream, known, None)
        log_ns = self.start_ns
        while True:
            try:
                entry = next(stream, None)
            except Exception as error:  # rosbags lets those of zstd, lz4, sqlite, struct and asserts through
                at = (log_ns - self.start_ns) / 1e9
                advice = _repair(self.path)
                if at > 1:
                    advice = f"what comes before can be used (--duration {at - 0.5:.1f}), and {advice}"
                raise HemislamError(
                    f"{self.path} is damaged {at:.1f} s after its start ({_brief(error)}); {advice}."
                ) from error
            if entry is None:
                return
            log_ns = entry[1]
            yield entry

    @staticmethod
    def _rosbags_messages(
        reader: AnyReader, topics: tuple[str, ...], start_ns: int, stop_ns: int
    ) -> Iterator[tuple[str, int, Any]]:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:  # which rosbags would take for all of them
            return
        for connection, log_ns, raw in reader.messages(connections, start=start_ns, stop=stop_ns):
            yield connection.topic, log_ns, reader.deserialize(raw, connection.msgtype)

    def _open(self, files: list[Path]) -> AnyReader | McapStream | CaptureStream:
        if self.path.suffix in CAPTURES:
            return self._open_capture()
        reader = None
        try:
            reader = AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        except Exception as error:  # as above
            salvaged = self._salvage(files, _brief(error))
            if salvaged is not None:
                return salvaged
            raise HemislamError(self._refusal(error)) from error
        if self.path.is_dir() and files != [self.path]:
            text = f"the folder has no metadata.yaml; its {len(files)} {files[0].suffix} file(s) were read without it"
            self.findings = (Finding("file", "corrected", text),)
        return reader

    def _open_capture(self) -> CaptureStream:
        try:
            stream = CaptureStream(self.path)
        except CaptureError as error:
            raise HemislamError(f"{self.path} is no capture of a network ({error}); {_KINDS} can be read.") from None
        if not stream.counts:
            raise HemislamError(
                f"{self.path} holds no packets of an RS-Bpearl and no imu-udp datagrams; capture its UDP ports, mostly "
                "6699 and 7788."
            )
        self.findings = stream.findings
        return stream

    def _salvage(self, files: list[Path], why: str) -> McapStream | None:
        """A single MCAP read from front to back, if that yields anything."""
        inner = sorted(self.path.glob("*.mcap")) if files == [self.path] and self.path.is_dir() else files
        if len(inner) != 1 or inner[0].suffix != ".mcap":
            return None
        try:
            stream = McapStream(inner[0])
        except Exception:  # whatever a damaged file may cause: the first error is the one to report
            return None
        if not stream.counts:
            return None
        if stream.complete:
            text = f"read from front to back, since its index can not be used ({why})"
        else:
            length = (stream.end_ns - stream.start_ns) / 1e9
            text = f"the file is cut off {length:.1f} s after its start ({why}); what comes before is used"
        self.findings = (Finding("file", "corrected" if stream.complete else "needs you", text),)
        return stream

    def _refusal(self, error: Exception) -> str:
        path, brief = self.path, _brief(error)
        if isinstance(error, PermissionError):
            return f"{path} can not be opened (permission denied); change its permissions or copy it."
        if path.is_dir() and "metadata" in brief.lower():
            return f"The metadata.yaml of {path} can not be understood; {_REPAIR[''].format(path=path)}."
        if "not indexed" in brief:
            return f"{path} has no index, as after a recorder that was stopped hard; {_repair(path)}."
        return f"{path} is cut off or damaged ({brief}); {_repair(path)}."

    def close(self) -> None:
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _recording_files(path: Path) -> list[Path]:
    """What to hand to rosbags for this path; refuses what is clearly no recording."""
    try:
        if not path.exists():
            raise HemislamError(f"There is no recording {path}; check the path.")
        if path.is_dir():
            return _folder_files(path)
        if path.suffix not in SUFFIXES:
            raise HemislamError(f"{path} is no recording by its name; what can be read is {_KINDS}.")
        if path.stat().st_size == 0:
            raise HemislamError(f"{path} is empty (0 bytes); record or copy it again.")
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise HemislamError(
            f"{path} can not be opened ({error.strerror}); check the path and its permissions."
        ) from error
    if path.suffix in CAPTURES:
        return [path]
    magic = _MAGIC[path.suffix]
    if not start.startswith(magic[: len(start)]):
        other = next((suffix for suffix, known in _MAGIC.items() if start.startswith(known)), None)
        hint = f"by its content it is a {other}: rename it" if other else f"what can be read is {_KINDS}"
        raise HemislamError(f"{path} does not begin like a {path.suffix} file; {hint}.")
    return [path]


def _folder_files(path: Path) -> list[Path]:
    if (path / "metadata.yaml").is_file():
        return [path]
    for suffix in (".mcap", ".db3"):
        if files := sorted(path.glob(f"*{suffix}")):
            return files
    bags = sorted(path.glob("*.bag"))
    hint = f"open one of its files, such as {bags[0].name}" if bags else "give the folder that holds metadata.yaml"
    raise HemislamError(f"The folder {path} is no ROS 2 recording (it has neither metadata.yaml nor .mcap); {hint}.")


def _repair(path: Path) -> str:
    if path.is_dir():
        inside = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
        path = inside[0] if len(inside) == 1 else path
    return _REPAIR["" if path.is_dir() else path.suffix].format(path=path)


def _brief(error: BaseException) -> str:
    """The library's own words, shortened to fit into our sentence."""
    text = " ".join(str(error).split()).rstrip(".")
    return text[:120] or type(error).__name__
