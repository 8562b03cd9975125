"""Unpacks compressed chunks of recordings, each to a limited size, in all the libraries that read them.

A chunk of a few kilobytes may unpack to gigabytes of zeros.
"""

import bz2
import io
from collections.abc import Iterator
from itertools import repeat
from types import SimpleNamespace
from typing import IO, Any, Final, Self

import lz4.frame
import rosbags.rosbag1.reader
import rosbags.rosbag2.reader
import zstandard
from rosbags.rosbag2 import storage_mcap

LIMIT: Final = 256 << 20
"""Most bytes of a chunk, or of a message that is compressed on its own. Writers make chunks of about 1 MB."""


class TooLarge(ValueError):
    """A chunk would unpack to more than `LIMIT`."""

    def __init__(self) -> None:
        super().__init__(f"a compressed chunk unpacks to more than {LIMIT >> 20} MB, which no recorder writes")


def unpack_zstd(data: bytes, size: int = LIMIT) -> bytes:
    """At most `size` bytes. Raises TooLarge, or zstandard's error."""
    known = zstandard.frame_content_size(data)
    size = min(size, LIMIT, known if known >= 0 else LIMIT)
    if known > LIMIT:
        raise TooLarge
    return _checked(zstandard.ZstdDecompressor().stream_reader(data).read(size + 1), size)


def unpack_lz4(data: bytes, size: int = LIMIT) -> bytes:
    """At most `size` bytes, and never more than `LIMIT`. Raises TooLarge, or lz4's error."""
    size = min(size, LIMIT)
    decompressor: Any = lz4.frame.LZ4FrameDecompressor
    return _checked(decompressor().decompress(data, max_length=size + 1), size)


def unpack_bz2(data: bytes) -> bytes:
    """At most `LIMIT` bytes. Raises TooLarge, or ValueError: bz2's error is an OSError, like one of the disk."""
    try:
        return _checked(bz2.BZ2Decompressor().decompress(data, max_length=LIMIT + 1), LIMIT)
    except OSError as error:
        raise ValueError(error) from error


UNPACK: Final = {"zstd": unpack_zstd, "lz4": unpack_lz4}
"""Functions by the names that MCAP gives to compressions."""

_READ_CHUNK: Final = storage_mcap.msgsrc


def _checked(data: bytes, size: int) -> bytes:
    if len(data) > size:
        raise TooLarge
    return data


class _LimitedFile:
    """A zstd file that unpacks to at most 100 times its size; recordings shrink to a fifth or so."""

    def __init__(self, file: IO[bytes]) -> None:
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        self._left = max(LIMIT, 100 * size)
        self._reader = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)

    def read(self, size: int = LIMIT) -> bytes:
        data = self._reader.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise TooLarge
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()  # type: ignore[no-untyped-call]  # zstandard leaves it untyped


def _message_or_nothing(data: bytes) -> bytes:
    """A message that is compressed on its own; empty if it is damaged."""
    try:
        return unpack_zstd(data)
    except (TooLarge, zstandard.ZstdError):
        return b""


def _messages_or_nothing(
    chunk: storage_mcap.ChunkInfo, connections: dict[int, Any], start_ns: int, stop_ns: int, file: Any
) -> Iterator[storage_mcap.Msg]:
    """The messages of a chunk of an MCAP by time; if it is damaged, empty ones at its start, even before `start_ns`."""
    try:
        yield from _READ_CHUNK(chunk, connections, start_ns, stop_ns, file)
    except OSError:
        raise
    except Exception:  # rosbags lets errors of zstd, lz4 and struct pass; it has not yet given any message then
        for number, connection in connections.items():
            empty = storage_mcap.Msg(chunk.message_start_time, chunk.chunk_start_offset, connection, b"")
            yield from repeat(empty, chunk.channel_count.get(number, 0))


def adapt_rosbags() -> None:
    """Make rosbags use the functions above: it has no option for a limit, and stops at the first damaged chunk."""
    rosbags.rosbag1.reader.decompressors |= {"bz2": unpack_bz2, "lz4": unpack_lz4}
    storage_mcap.DECOMPRESSORS |= {"lz4": unpack_lz4, "zstd": unpack_zstd}
    storage_mcap.msgsrc = _messages_or_nothing  # type: ignore[assignment]  # it is a generator
    limited: Any = SimpleNamespace(decompress=_message_or_nothing, open=lambda file, mode: _LimitedFile(file))
    rosbags.rosbag2.reader.zstd = limited  # type: ignore[attr-defined]  # of messages and files compressed on their own
