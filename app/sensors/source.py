"""Recording files as a stream of messages. Each failure becomes one clear sentence."""

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import yaml

from app.sensors.findings import Finding
from app.sensors.live.capture import SUFFIXES as CAPTURES
from app.sensors.live.capture import CaptureStream
from app.sensors.live.pcap import CaptureError
from app.sensors.log_times import LATEST_NS
from app.sensors.mcap_stream import McapStream
from app.sensors.ouster import OusterStream, metadata_beside
from app.sensors.ros import IMU, Lost, brief
from app.sensors.rosbags_stream import RosbagsStream
from app.slam.errors import HemislamError, quoted
from app.slam.text_files import is_file

_COMPRESSED = (".zst", ".zstd")
SUFFIXES = (".bag", ".mcap", ".db3", *CAPTURES)
_MAGIC = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_REPAIR = {
    ".bag": "`rosbag reindex {path}` repairs it",
    ".mcap": "`mcap recover {path} -o repaired.mcap` saves what is whole",
    ".db3": "`sqlite3 {path} .recover | sqlite3 repaired.db3` saves what is whole",
    **dict.fromkeys(CAPTURES, "`tcpdump -r {path} -w repaired.pcap` saves what is whole"),
    "": "`ros2 bag reindex {path}` may repair it",
}
_KINDS = "a ROS 1 .bag, a ROS 2 folder, an .mcap, a .db3, or a .pcap of an RS-Bpearl, an Airy, a Mid-360 or an Ouster"
LOG_MARGIN_NS = 2_000_000_000
"""A message logged this much later or earlier than usual is still found by its time."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording. `messages`: how many it holds."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Mark:
    """The place of a message: how many were read up to it, its log time, and how many of these share that time."""

    read: int
    log_ns: int
    at_log_ns: int

    @classmethod
    def after(cls, mark: "Mark | None", log_ns: int) -> "Mark":
        """The mark of the message, logged at `log_ns`, that comes next after `mark`."""
        if mark is None:
            return cls(1, log_ns, 1)
        return cls(mark.read + 1, log_ns, mark.at_log_ns + 1 if mark.log_ns == log_ns else 1)


Stream = RosbagsStream | McapStream | CaptureStream | OusterStream
"""One kind of file, opened. `counts`: topic -> (type, number of messages). `start_ns`, `end_ns`: log times of the first
and last message. `by_log_time`: whether messages come sorted by log time. `wild`: how many have a wrong log time."""


class Source(AbstractContextManager["Source"]):
    """A recording opened for reading: its topics and its messages. A context manager.

    Attributes:
        path: as given. topics: by name. start_ns, end_ns: log times of the first and last message.
        findings: unusual properties of the file that were overcome.
        first_scan_ns: log time from which `--duration` counts; the first message's until a reader knows better.
    """

    def __init__(self, path: Path) -> None:
        """Open a file or folder.

        Raises:
            HemislamError: the file is missing, empty, truncated, corrupt, without an index, or of another kind.
        """
        self.path = path
        self._stream, self.findings = _open(path)
        self.start_ns, self.end_ns = self._stream.start_ns, self._stream.end_ns
        self.first_scan_ns = self.start_ns
        self.topics = tuple(Topic(name, *content) for name, content in sorted(self._stream.counts.items()))
        if not any(topic.messages for topic in self.topics):
            self.close()
            raise HemislamError(f"{path} is a recording without a single message; record it again.")
        if self._stream.wild:
            what = "left out" if self._stream.by_log_time else "read as if logged with those before them"
            messages = sum(topic.messages for topic in self.topics)
            text = f"far from all others for {self._stream.wild} of {messages} messages, which are {what}"
            self.findings += (Finding("log times", "corrected", text),)

    def messages(
        self,
        topics: tuple[str, ...],
        start_ns: int | None = None,
        stop_ns: int | None = None,
        after: Mark | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, deserialised message) of these topics, logged within [start, stop).

        It is `Lost` for each message that cannot be read. Those of a damaged chunk of an MCAP have the time at which it
        begins, which may be before `start`.

        Args:
            after: the last message of an earlier call with the same arguments; this call continues from there.

        Raises:
            HemislamError: the file cannot be read beyond this place, where all earlier messages have been given.
        """
        first, stop = start_ns or 0, LATEST_NS + 1 if stop_ns is None else stop_ns
        if after is None:
            stream = self._stream.messages(topics, first, stop)
        elif self._stream.by_log_time:
            later = self._stream.messages(topics, max(first, after.log_ns), stop)
            stream = islice((entry for entry in later if entry[1] >= after.log_ns), after.at_log_ns, None)
        else:
            stream = islice(self._stream.messages(topics, first, stop), after.read, None)
        log_ns = self.start_ns if after is None else after.log_ns
        try:
            for entry in stream:
                log_ns = entry[1]
                yield entry
        except Exception as error:  # rosbags lets errors of zstd, lz4, sqlite, struct and assert pass
            raise self._damaged(log_ns, brief(error)) from error

    def readable(self, topic: str) -> Iterator[tuple[int, Any]]:
        """(log time ns, message) of a topic, without what cannot be read. Raises HemislamError also if nothing can."""
        given, why = False, ""
        for _, log_ns, message in self.messages((topic,)):
            if isinstance(message, Lost):
                why = why or message.why
            else:
                given = True
                yield log_ns, message
        if why and not given:
            raise self._damaged(self.start_ns, why)

    def _damaged(self, log_ns: int, why: str) -> HemislamError:
        """That nothing can be read after this log time."""
        advice = _repair(self.path)
        usable = (log_ns - self.first_scan_ns - LOG_MARGIN_NS) / 1e9 - 0.5
        if usable > 1:
            advice = f"what comes before can be used (start hemislam with --duration {usable:.1f}), and {advice}"
        at = (log_ns - self.start_ns) / 1e9
        return HemislamError(f"{self.path} is damaged {at:.1f} s after its start ({why}); {advice}.")

    def lacks(self, topics: tuple[str, ...], read: int) -> bool:
        """Whether `read` messages, from a complete reading of these topics, are fewer than the file's index states."""
        return read < sum(topic.messages for topic in self.topics if topic.name in topics) - self._stream.wild

    def close(self) -> None:
        self._stream.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _open(path: Path) -> tuple[Stream, tuple[Finding, ...]]:
    """The file as a stream, and what is unusual about it."""
    files = _recording_files(path)
    if path.suffix.lower() in CAPTURES:
        capture = _open_capture(path)
        return capture, capture.findings
    try:
        reader, found = _read_by_rosbags(path, files)
    except Exception as error:  # as above
        if (salvaged := _front_to_back(path, files)) is None:
            raise HemislamError(_refusal(path, error)) from error
        return salvaged, (_salvage_finding(salvaged, brief(error)),)
    unindexed = reader.is_unindexed()
    in_order = _front_to_back(path, files) if unindexed or reader.may_be_disordered() else None
    if in_order and (unindexed or in_order.wild or not in_order.sorted):
        reader.close()
        wrong = "it has no index of its messages" if unindexed else "log times in it are wrong"
        why = "the recorder's clock was set back while recording" if in_order.set_back else wrong
        return in_order, (*found, Finding("file", "corrected", f"read in the order of the file, since {why}"))
    if reader.mixed is not None:
        from_s, until_s = ((log_ns - reader.start_ns) / 1e9 for log_ns in reader.mixed)
        text = (
            f"the recorder's clock was set back, and what it recorded from {from_s:.1f} to {until_s:.1f} s is mixed "
            "with what it recorded after that; map the parts on either side"
        )
        advice = f"--duration {from_s:.1f}, and --start {until_s:.1f}"
        found = (*found, Finding("log times", "needs you", text, advice))
    if unmerged := [wal for file in files for wal in _write_ahead_logs(file)]:
        database = str(unmerged[0]).removesuffix("-wal")
        text = (
            f"{unmerged[0].name} holds messages that are not yet in the database and are not read, as after a recorder "
            f"that was killed; `sqlite3 {quoted(Path(database))} 'PRAGMA wal_checkpoint(TRUNCATE)'` moves them there"
        )
        return reader, (*found, Finding("file", "needs you", text))
    if reader.has_torn_index():
        text = f"its index contradicts itself, so messages may be missing without further notice; {_repair(path)}"
        return reader, (*found, Finding("file", "needs you", text))
    if path.is_dir() and files != [path]:
        if files[0].suffix == ".bag":
            text = f"{len(files)} .bag file(s), read as one recording"
            numbers = [int(bag.stem.rpartition("_")[2]) for bag in files if len(files) > 1]
            if skipped := [n for a, b in pairwise(numbers) for n in range(a + 1, b)]:
                text += f"; number {', '.join(map(str, skipped))} is missing: copy it there, or the map has a gap"
            return reader, (Finding("file", "needs you" if skipped else "fine", text),)
        text = f"the folder has no metadata.yaml; its {len(files)} {files[0].suffix} file(s) were read without it"
        return reader, (Finding("file", "corrected", text),)
    return reader, found


def _read_by_rosbags(path: Path, files: list[Path]) -> tuple[RosbagsStream, tuple[Finding, ...]]:
    """The files as a stream; a wrong metadata.yaml of a folder is ignored. Raises whatever the library raises."""
    stream: RosbagsStream | Exception
    try:
        stream, why = RosbagsStream(files), "it states other messages than the files hold"
        if not stream.is_contradicted():
            return stream, ()
    except Exception as error:
        stream, why = error, brief(error)
    inside = _single_files(path, files)
    with suppress(Exception):
        if inside not in ([], files) and not (bare := RosbagsStream(inside)).is_packed():
            if isinstance(stream, RosbagsStream):
                stream.close()
            if missing := _missing(path):
                return bare, (Finding("file", "needs you", f"{missing}, or the map has a gap"),)
            text = f"the folder's metadata.yaml cannot be used ({why}); its {len(inside)} file(s) were read without it"
            return bare, (Finding("file", "corrected", text),)
    if isinstance(stream, Exception):
        raise stream
    return stream, ()


def _missing(folder: Path) -> str:
    """Which of the files that a folder's metadata.yaml names are missing, and what to do; "" if none is.

    A file that it does not name is one of them that was renamed.
    """
    with suppress(Exception):  # whatever is wrong with it, rosbags says
        told = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        named = {Path(name).name for name in told["relative_file_paths"]}
        there = {path.name for path in folder.iterdir() if path.suffix in (*_MAGIC, *_COMPRESSED)}
        if there < named:
            names = ", ".join(sorted(named - there))
            return f"the folder lacks {names}, which its metadata.yaml names: copy that there"
    return ""


def _open_capture(path: Path) -> CaptureStream | OusterStream:
    metadata = metadata_beside(path)
    try:
        stream = CaptureStream(path) if metadata is None else OusterStream(path, metadata)
    except CaptureError as error:
        raise HemislamError(f"{path} is not a network capture ({error}); hemislam reads {_KINDS}.") from None
    if stream.shortened and all(kind == IMU for kind, _ in stream.counts.values()):
        raise HemislamError(
            f"{path} holds only the beginning of each packet; capture them whole, as `tcpdump -s 0 -w walk.pcap` does."
        )
    if not stream.counts:
        beside = path.with_suffix(".json")
        unread = " That file is there, but is no metadata of an Ouster; copy it from the sensor again."
        raise HemislamError(
            f"{path} holds no packets of an RS-Bpearl, an Airy or a Mid-360 and no imu-udp datagrams; capture their "
            "UDP ports, usually 6699 and 7788, or 56301 and 56401. Those of an Ouster need its metadata beside them, "
            f"as {beside.name}.{unread if metadata is None and is_file(beside) else ''}"
        )
    return stream


def _write_ahead_logs(path: Path) -> list[Path]:
    """The -wal files of SQLite, beside a database or in a folder, that are not empty."""
    found = sorted(path.glob("*.db3-wal")) if path.is_dir() else [path.with_name(f"{path.name}-wal")]
    return [wal for wal in found if is_file(wal) and wal.stat().st_size]


def _front_to_back(path: Path, files: list[Path]) -> McapStream | None:
    """MCAP files read from front to back, if that yields anything."""
    pieces = _single_files(path, files)
    try:
        stream = McapStream(pieces) if {piece.suffix.lower() for piece in pieces} == {".mcap"} else None
    except Exception:  # whatever a damaged file may cause; then it is as rosbags says
        return None
    return stream if stream and stream.counts else None


def _salvage_finding(stream: McapStream, why: str) -> Finding:
    if not stream.cut:
        return Finding("file", "corrected", f"read from front to back, since its index cannot be used ({why})")
    if len(stream.pieces) == 1:
        length = (stream.end_ns - stream.start_ns) / 1e9
        text = f"the file is cut off {length:.1f} s after its start ({why}); what comes before is used"
    else:
        names = ", ".join(piece.name for piece in stream.cut)
        cut = f"{len(stream.cut)} of {len(stream.pieces)} files cut off ({names}: {why})"
        text = f"{cut}; what they hold before that is used"
    return Finding("file", "needs you", text)


def _refusal(path: Path, error: Exception) -> str:
    why = brief(error)
    if isinstance(error, PermissionError):
        return f"{path} cannot be opened (permission denied); change its permissions or copy it."
    if path.is_dir() and (missing := _missing(path)):
        return f"{path} is incomplete: {missing}."
    if path.is_dir() and "metadata" in why.lower():
        return f"The metadata.yaml of {path} cannot be understood; {_REPAIR[''].format(path=quoted(path))}."
    if "not indexed" in why:
        return f"{path} has no index, as after a recorder that was killed; {_repair(path)}."
    inside = _ros2_files(path) if path.is_dir() else []
    damaged = next((file for file in inside if file.name in str(error)), path)
    return f"{path} is cut off or damaged ({why}); {_repair(damaged)}."


def _recording_files(path: Path) -> list[Path]:
    """The files to give to rosbags for this path; refuses what is clearly not a recording."""
    try:
        if not path.exists():
            raise HemislamError(f"There is no recording {path}; check the path.")
        if path.is_dir():
            return _folder_files(path)
        if path.suffix.lower() == ".osf":
            convert = f"ouster-cli source {quoted(path)} save {quoted(path.with_suffix('.pcap'))}"
            raise HemislamError(f"{path} is read by Ouster's own tool only; `{convert}`.")
        if path.suffix.lower() in _COMPRESSED:
            whole = (path.parent / "metadata.yaml").is_file()
            advice = f"open its folder {path.parent}" if whole else f"`unzstd {quoted(path)}` unpacks it"
            raise HemislamError(f"{path} is compressed as a whole file; {advice}.")
        if path.name.endswith(".bag.active"):
            raise HemislamError(
                f"{path} was left by a recorder that was killed; `rosbag reindex {quoted(path)}` repairs it, then "
                f"rename it to {path.stem}."
            )
        if path.suffix.lower() not in SUFFIXES:
            raise HemislamError(f"{path} does not look like a recording; hemislam reads {_KINDS}.")
        if path.stat().st_size == 0:
            raise HemislamError(f"{path} is empty (0 bytes); record or copy it again.")
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise HemislamError(
            f"{path} cannot be opened ({error.strerror}); check the path and its permissions."
        ) from error
    if path.suffix.lower() in CAPTURES:
        return [path]
    magic = _MAGIC[path.suffix.lower()]
    if not start.startswith(magic[: len(start)]):
        other = next((suffix for suffix, known in _MAGIC.items() if start.startswith(known)), None)
        hint = f"by its content it is a {other}: rename it" if other else f"hemislam reads {_KINDS}"
        raise HemislamError(f"{path} does not begin like a {path.suffix} file; {hint}.")
    return [path]


def _folder_files(path: Path) -> list[Path]:
    if (path / "metadata.yaml").is_file():
        return [path]
    if files := _ros2_files(path):
        return files
    bags = sorted(path.glob("*.bag"))
    if pieces := _pieces(bags):
        return pieces
    hint = "give the folder that holds metadata.yaml"
    if bags:
        hint = f"its .bag files are not numbered as pieces of one: open one of them, such as {bags[0].name}"
    elif compressed := sorted(file for file in path.iterdir() if file.suffix in _COMPRESSED):
        hint = f"copy its metadata.yaml too, or unpack its files, as by `unzstd {quoted(compressed[0])}`"
    raise HemislamError(f"The folder {path} is not a ROS 2 recording (it has neither metadata.yaml nor .mcap); {hint}.")


def _ros2_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap")) or sorted(folder.glob("*.db3"))


def _single_files(path: Path, files: list[Path]) -> list[Path]:
    """The files in a folder that rosbags reads by its metadata.yaml; else the files as given."""
    return _ros2_files(path) if files == [path] and path.is_dir() else files


def _pieces(bags: list[Path]) -> list[Path]:
    """The bags of one recording, in order: a single one, or NAME_0.bag, NAME_1.bag, … of `rosbag record --split`.

    Empty if they are of several. rosbag puts the time into NAME at which each piece begins.
    """
    if len(bags) < 2:
        return bags
    numbers = {int(found[1]): bag for bag in bags if (found := re.search(r"_(\d+)$", bag.stem))}
    names = {re.sub(r"\d+", "", bag.stem) for bag in bags}
    return [numbers[n] for n in sorted(numbers)] if len(names) == 1 and len(numbers) == len(bags) else []


def _repair(path: Path) -> str:
    if path.is_dir():
        inside = sorted(file for suffix in _MAGIC for file in path.glob(f"*{suffix}"))
        if len(inside) == 1:
            path = inside[0]
        elif {file.suffix for file in inside} == {".bag"}:
            return _REPAIR[".bag"].format(path=f"{quoted(path)}/*.bag")
    return _REPAIR["" if path.is_dir() else path.suffix.lower()].format(path=quoted(path))
