"""A chunk that would decompress to gigabytes is refused in time, in every format; normal recordings are read."""

import bz2
import struct
from functools import cache
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import Writer

from app.sensors import unpacking
from app.sensors.recording import open_recording
from app.sensors.source import Source
from app.sensors.unpacking import LIMIT, TooLarge, unpack_bz2, unpack_lz4, unpack_zstd
from app.slam.errors import HemislamError
from app.slam.params import Params
from tests.sensors import rig

ZEROS = bytes(1 << 20)


@cache
def zstd_bomb(megabytes: int, *, says_its_size: bool) -> bytes:
    total = megabytes << 20 if says_its_size else -1
    packer = zstandard.ZstdCompressor(write_content_size=says_its_size).compressobj(size=total)
    return b"".join(packer.compress(ZEROS) for _ in range(megabytes)) + packer.flush()


@cache
def lz4_bomb(megabytes: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    return packer.begin() + b"".join(packer.compress(ZEROS) for _ in range(megabytes)) + packer.flush()


def bz2_bomb(megabytes: int) -> bytes:
    packer = bz2.BZ2Compressor()
    return b"".join(packer.compress(ZEROS) for _ in range(megabytes)) + packer.flush()


@pytest.mark.parametrize("says_its_size", [True, False])
def test_a_bomb_is_refused(says_its_size: bool) -> None:
    with pytest.raises(TooLarge, match="more than 256 MB"):
        unpack_zstd(zstd_bomb(300, says_its_size=says_its_size))
    with pytest.raises(TooLarge):
        unpack_zstd(zstd_bomb(2, says_its_size=False), 1 << 20)  # more than its chunk says


def test_so_is_one_of_another_compression(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TooLarge):
        unpack_lz4(lz4_bomb(300))
    with pytest.raises(TooLarge):
        unpack_lz4(lz4_bomb(300), 300 << 20)  # as large as its chunk says, and still too large
    monkeypatch.setattr(unpacking, "LIMIT", 20 << 20)  # to pack more takes seconds
    with pytest.raises(TooLarge):
        unpack_bz2(bz2_bomb(21))
    assert unpack_bz2(bz2_bomb(20)) == 20 * ZEROS


def test_what_is_not_too_large_is_unpacked_whole() -> None:
    some = bytes(range(256)) * 5000
    assert unpack_zstd(zstandard.compress(some), len(some)) == some
    assert unpack_zstd(zstd_bomb(3, says_its_size=False)) == 3 * ZEROS
    assert unpack_lz4(lz4.frame.compress(some), len(some)) == some
    assert unpack_bz2(bz2.compress(some)) == some


def chunk(packed: bytes, compression: str, size: int) -> bytes:
    """An MCAP record that holds a compressed chunk, as the format's specification says."""
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    return b"\x06" + struct.pack("<Q", len(body)) + body


@pytest.mark.parametrize("declared", [300 << 20, 8 << 30, 1000])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("index", [True, False])
def test_a_recording_of_such_chunks_is_refused(tmp_path: Path, compression: str, declared: int, index: bool) -> None:
    packed = zstd_bomb(300, says_its_size=True) if compression == "zstd" else lz4_bomb(300)
    path = tmp_path / "bomb.mcap"
    if index:
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2")
            file.write(chunk(packed, compression, declared))
            writer.finish()
    else:
        path.write_bytes(b"\x89MCAP0\r\n" + chunk(packed, compression, declared))
    with pytest.raises(HemislamError), open_recording(path, Params()) as recording:
        list(recording.measurements())


def test_a_zstd_file_that_grows_beyond_measure_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unpacking, "LIMIT", 10_000)
    folder = rig.write(tmp_path / "walk", rig.walk(turns=2, columns=4), "sqlite3-file")
    (packed,) = folder.glob("*.zstd")
    packed.write_bytes(zstd_bomb(40, says_its_size=True))
    with pytest.raises(HemislamError, match="unpacks to more"):
        Source(folder)


def test_the_limit_is_in_force_in_rosbags() -> None:
    """By name, so that an upgrade that renames them is noticed."""
    import rosbags.rosbag1.reader
    import rosbags.rosbag2.reader
    import rosbags.rosbag2.storage_mcap

    unpacking.adapt_rosbags()
    assert {"bz2", "lz4"} <= {str(key) for key in rosbags.rosbag1.reader.decompressors}
    assert {"zstd", "lz4"} <= rosbags.rosbag2.storage_mcap.DECOMPRESSORS.keys()
    source = Path(rosbags.rosbag2.reader.__file__).read_text()
    assert "zstd.decompress(data)" in source and "zstd.open(bio, 'rb')" in source
    assert "DECOMPRESSORS[compression](data, size)" in Path(rosbags.rosbag2.storage_mcap.__file__).read_text()
    assert LIMIT == 256 << 20
