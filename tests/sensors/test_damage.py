"""Tests app/sensors/source.py: a damaged place costs little, and the advice for damaged files works as written."""

import re
import shlex
import sqlite3
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader

from app.sensors.doctor import DAMAGE, examine
from app.sensors.recording import LOST, LostEntry, open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig


@pytest.mark.parametrize("imu_first_s", [0.05, 3.0])
def test_the_duration_that_a_damaged_file_advises_ends_before_the_damage(tmp_path: Path, imu_first_s: float) -> None:
    """--duration counts from the first scan, which may come seconds after the first IMU sample."""
    entries = rig.walk(turns=160, columns=20, imu_start_ns=-round(imu_first_s * 1e9))
    path = rig.write(tmp_path / "walk", sorted(entries, key=lambda entry: entry[1]), "small-chunks")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with open_recording(path, Params()) as recording:
        with pytest.raises(HemislamError) as caught:
            list(recording.measurements())
        (advised,) = re.findall(r"start hemislam with --duration ([\d.]+)", str(caught.value))
        used = [entry for entry in recording.measurements(0.0, float(advised)) if isinstance(entry, Measurement)]
    assert len(used) == pytest.approx(float(advised) / (rig.PERIOD_NS / 1e9), abs=2)
    assert len(used) > 30


def damaged(folder: Path, container: str) -> Path:
    """A walk of 60 scans with a hole of 2000 bytes in the middle, or in a message. Scans are logged with samples."""
    entries = rig.walk(turns=60, columns=40, ros=1 if "bag" in container else 2, delay_ns=500_000)
    path = rig.write(folder / "walk", entries, container.removesuffix("-cut"))
    if container == "sqlite3-message":
        with sqlite3.connect(next(path.glob("*.db3"))) as database:
            together = "SELECT max(id) FROM messages GROUP BY timestamp HAVING count(*) = 2 LIMIT 1 OFFSET 30"
            database.execute(f"UPDATE messages SET data = x'0102' WHERE id = ({together})")
        database.close()
        return path
    content = bytearray(path.read_bytes())
    at = len(content) // 2
    content[at : at + 2000] = bytes(2000)
    path.write_bytes(content[: at * 3 // 2] if container.endswith("-cut") else content)
    return path


@pytest.mark.parametrize("container", ["bag-bz2", "bag-lz4", "small-chunks", "small-chunks-cut", "sqlite3-message"])
def test_a_damaged_chunk_costs_no_more_than_what_it_held(tmp_path: Path, container: str) -> None:
    """It is said where, also by a reading that continues an earlier one."""
    read: list[Measurement | DroppedScan] = []
    with open_recording(damaged(tmp_path, container), Params()) as recording:
        reading = recording.measurements()
        end = pytest.raises(HemislamError, match=r"damaged 4\.\d s after its start \(the file ends here")
        ends = end if container.endswith("-cut") else nullcontext()
        with ends:
            while (entry := next(reading, None)) is not None:
                read.append(entry)
                reading = recording.measurements(after=reading.place())
    whole = 45 if container.endswith("-cut") else 60
    used = [entry for entry in read if isinstance(entry, Measurement)]
    dropped = [entry.reason for entry in read if isinstance(entry, DroppedScan)]
    assert whole - 5 <= len(used) < whole + 1 and set(dropped) <= {LOST}
    assert used[-1].scan.stamp_ns - used[0].scan.stamp_ns > (whole - 3) * rig.PERIOD_NS
    (said,) = [notice for entry in used for notice in entry.notices if "damaged" in notice]
    at = float(re.findall(r"damaged (\d+) s after its start: what was there is lost \(", said)[0])
    gaps = [a for a, b in pairwise(used) if b.scan.stamp_ns - a.scan.stamp_ns > 1.5 * rig.PERIOD_NS]
    assert not gaps or at == pytest.approx((gaps[0].scan.stamp_ns - rig.START_NS) / 1e9, abs=0.8)
    if not container.endswith("-cut"):
        (finding,) = [finding for finding in examine(recording.path, Params()) if finding.subject == DAMAGE]
        assert finding.verdict == "needs you" and finding.text.startswith(f"{said}; messages lost: at least ")


@pytest.mark.parametrize("container", ["bag-lz4", "small-chunks"])
@pytest.mark.parametrize("part", [(4.0, None), (0.0, 2.0)])
def test_scans_that_damage_took_before_or_after_the_part_that_is_read_are_not_counted(
    tmp_path: Path, container: str, part: tuple[float, float | None]
) -> None:
    """The file is read from some time before the part until some time after it."""
    with open_recording(damaged(tmp_path, container), Params()) as recording:
        assert any(isinstance(entry, DroppedScan) for entry in recording.measurements())
        read = list(recording.measurements(*part))
    assert len(read) == 20 and all(isinstance(entry, Measurement) for entry in read)


def test_a_part_that_begins_in_the_middle_of_a_damaged_chunk_says_so(tmp_path: Path) -> None:
    """Chunks of four seconds: this one begins before the messages that are read for the part."""
    path = rig.write_mcap(tmp_path / "walk.mcap", rig.walk(turns=150, columns=10), chunk_size=250_000)
    content = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[1]
    at = chunk.chunk_start_offset + chunk.chunk_length // 2
    content[at : at + 2000] = bytes(2000)
    path.write_bytes(content)
    start_s = (chunk.message_start_time - rig.START_NS) / 1e9 + 3.0
    with open_recording(path, Params()) as recording:
        read = list(recording.measurements(start_s))
        continued, reading = list[Measurement | DroppedScan](), recording.measurements(start_s)
        while (entry := next(reading, None)) is not None:
            continued.append(entry)
            if isinstance(entry, Measurement):
                reading = recording.measurements(start_s, after=reading.place())
    first = next(entry for entry in read if isinstance(entry, Measurement))
    assert first.scan.stamp_ns > rig.START_NS + (start_s + 1.0) * 1e9 and "damaged" in first.notices[0]
    assert [repr(entry) for entry in continued] == [repr(entry) for entry in read]


@pytest.mark.parametrize("container", ["bag-bz2", "bag-lz4"])
def test_a_damaged_chunk_of_a_bag_costs_exactly_what_it_held(tmp_path: Path, container: str) -> None:
    """A scan of the chunk before it is logged together with its first sample."""
    path = damaged(tmp_path, container)
    with Reader(path) as bag:
        at = path.stat().st_size // 2
        begin_of = {one.pos: bag.chunks[one.pos].datapos for one in bag.chunk_infos}
        chunk = max((one for one in bag.chunk_infos if begin_of[one.pos] <= at), key=lambda one: one.pos)
        held = {one.topic: chunk.connection_counts[one.id] for one in bag.connections}
    with open_recording(path, Params()) as recording:
        lost = [entry for entry in recording.entries() if isinstance(entry, LostEntry)]
    assert sum(entry.scan is not None for entry in lost) == held["/points"]
    assert len(lost) == sum(held.values())


def test_a_damaged_record_of_a_bag_costs_one_message(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=20, columns=20, ros=1), "bag")
    with Reader(path) as bag:
        entry = bag.indexes[next(one.id for one in bag.connections if one.topic == "/points")][7]
        at = bag.chunks[entry.chunk_pos].datapos + entry.offset
    content = bytearray(path.read_bytes())
    content[at : at + 4] = b"\xff" * 4  # the length of its header
    path.write_bytes(content)
    with open_recording(path, Params()) as recording:
        (lost,) = [entry for entry in recording.entries() if isinstance(entry, LostEntry)]
    assert lost.log_ns == entry.time and lost.scan is not None


def test_damage_in_one_bag_of_a_folder_costs_nothing_of_the_others(tmp_path: Path) -> None:
    entries = rig.walk(turns=40, columns=20, ros=1)
    for number, part in enumerate((entries[: len(entries) // 2], entries[len(entries) // 2 :])):
        path = rig.write(tmp_path / f"walk_{number}", part, "bag-lz4")
    content = bytearray(path.read_bytes())
    content[6000:6500] = bytes(500)  # in the first chunk
    path.write_bytes(content)
    with open_recording(tmp_path, Params()) as recording:
        used = [entry for entry in recording.measurements() if isinstance(entry, Measurement)]
    assert used[0].scan.stamp_ns < rig.START_NS + rig.PERIOD_NS and len(used) >= 35
    (said,) = [notice for entry in used for notice in entry.notices if "damaged" in notice]
    assert "damaged 2 s after its start" in said


def test_of_a_folder_of_databases_the_damaged_one_is_to_be_repaired(tmp_path: Path) -> None:
    """`ros2 bag reindex` cannot repair a database."""
    for name in ("w_0", "w_1", "w_2"):
        rig.write(tmp_path / name, rig.walk(turns=9, columns=12), "bare-db3").rename(tmp_path / f"{name}.db3")
    damaged = tmp_path / "w_1.db3"
    damaged.write_bytes(damaged.read_bytes()[:-40_000])
    with pytest.raises(HemislamError, match=rf"`sqlite3 {damaged} \.recover"):
        open_recording(tmp_path, Params())


def test_paths_in_commands_are_written_as_a_shell_takes_them(tmp_path: Path) -> None:
    folder = tmp_path / "Halle (alt)"
    folder.mkdir()
    for name in ("my walk.mcap", "my walk.db3", "my walk.bag", "my walk.osf", "my walk.bag.active", "my walk.db3.zst"):
        path = folder / name
        magic = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
        path.write_bytes(magic.get(path.suffix, b"x") + bytes(100))
        with pytest.raises(HemislamError) as caught:
            open_recording(path, Params())
        (command,) = re.findall("`(.*)`", str(caught.value))
        assert str(path) in shlex.split(command)
