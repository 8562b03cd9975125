"""A ROS 2 folder whose metadata.yaml does not match: a file was renamed, playback settings of topics were changed, or a
newer ROS wrote it."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.writer import IndexType

from app.sensors.doctor import DAMAGE, examine
from app.sensors.recording import LACKS, open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig

EVER = {"sec": 1, "nsec": 1}
QOS = {
    "history": "keep_last",
    "depth": 7,
    "reliability": "best_effort",
    "durability": "volatile",
    "deadline": EVER,
    "lifespan": EVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": EVER,
    "avoid_ros_namespace_conventions": False,
}


def replayed(told: dict[str, Any]) -> None:
    for topic in told["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = [QOS]


@pytest.mark.parametrize("container", ["sqlite3", "mcap"])
@pytest.mark.parametrize(
    "change",
    [
        lambda told: told.update(version=99),
        lambda told: told.update(version="x"),
        lambda told: told.update(relative_file_paths=["renamed.db3"]),
        lambda told: told.update(relative_file_paths=told["relative_file_paths"] * 2),
        lambda told: told["topics_with_message_count"].pop(),
        replayed,
    ],
)
def test_a_wrong_metadata_takes_nothing_from_a_recording(
    tmp_path: Path, container: str, change: Callable[[dict[str, Any]], None]
) -> None:
    duration_s, scans, samples, told = read(tmp_path, container, change)
    assert (duration_s, scans) == (pytest.approx(3.0, abs=0.2), 30) and samples > 300
    (finding,) = told
    assert finding.startswith("the folder's metadata.yaml cannot be used (")


@pytest.mark.parametrize("container", ["sqlite3", "sqlite3-message", "sqlite3-file", "mcap"])
@pytest.mark.parametrize("start_ns", [0, 2**62])
def test_times_are_those_of_the_messages_whatever_the_metadata_tells(
    tmp_path: Path, container: str, start_ns: int
) -> None:
    def change(told: dict[str, Any]) -> None:
        told["starting_time"]["nanoseconds_since_epoch"] = start_ns
        told["duration"]["nanoseconds"] = 7

    duration_s, scans, samples, told = read(tmp_path, container, change)
    assert (duration_s, scans, told) == (pytest.approx(3.0, abs=0.2), 30, []) and samples > 300


def read(folder: Path, container: str, change: Callable[[dict[str, Any]], None]) -> tuple[float, int, int, list[str]]:
    """Length in s, scans, IMU samples and what is said of the file."""
    path = rig.write(folder / "walk", rig.walk(turns=30, columns=4), container)
    told = yaml.safe_load((path / "metadata.yaml").read_text())
    change(told["rosbag2_bagfile_information"])
    (path / "metadata.yaml").write_text(yaml.safe_dump(told))
    with open_recording(path, Params()) as recording:
        used = [entry for entry in recording.measurements() if isinstance(entry, Measurement)]
        of_file = [finding.text for finding in recording.findings if finding.subject == "file"]
        return recording.duration_s, len(used), sum(len(entry.imu) for entry in used), of_file


@pytest.mark.parametrize("container", ["sqlite3", "sqlite3-message", "sqlite3-file", "mcap"])
def test_a_file_that_a_folder_lacks_is_named(tmp_path: Path, container: str) -> None:
    """Files compressed by rosbag2 cannot be read without their metadata.yaml, which tells that they are compressed."""
    path = rig.write(tmp_path / "walk", rig.walk(turns=30, columns=4), container)
    told = yaml.safe_load((path / "metadata.yaml").read_text())
    (there,) = told["rosbag2_bagfile_information"]["relative_file_paths"]
    gone = f"walk_7{Path(there).suffix}"
    told["rosbag2_bagfile_information"]["relative_file_paths"] = [there, gone]
    (path / "metadata.yaml").write_text(yaml.safe_dump(told))
    said = f"the folder lacks {gone}, which its metadata.yaml names: copy that there"
    if "-" in container:
        with pytest.raises(HemislamError, match=f"walk is incomplete: {said}"):
            open_recording(path, Params())
    else:
        with open_recording(path, Params()) as recording:
            (finding,) = [finding for finding in recording.findings if finding.subject == "file"]
        assert finding.verdict == "needs you" and finding.text.startswith(said)


def test_a_number_that_the_pieces_of_a_bag_lack_is_named(tmp_path: Path) -> None:
    entries = rig.walk(turns=20, columns=4, ros=1)
    for number, part in ((0, entries[: len(entries) // 2]), (2, entries[len(entries) // 2 :])):
        rig.write(tmp_path / f"walk_{number}", part, "bag")
    with open_recording(tmp_path, Params()) as recording:
        (finding,) = [finding for finding in recording.findings if finding.subject == "file"]
    assert finding.verdict == "needs you" and "number 1 is missing: copy it there" in finding.text


def test_messages_that_a_damaged_file_has_lost_are_missed(tmp_path: Path) -> None:
    """A length in a chunk without a checksum is wrong, and rosbags takes all that follows for one record."""
    path = rig.write(tmp_path / "walk", rig.walk(turns=30, columns=4), "bare-mcap")
    content = bytearray(path.read_bytes())
    sample = bytes(rig.TYPESTORES[2].serialize_cdr(rig.imu(0), "sensor_msgs/msg/Imu"))
    head = b"\x05" + (22 + len(sample)).to_bytes(8, "little")
    places = [found.start() for found in re.finditer(re.escape(head), content)]
    content[places[100] : places[100] + 9] = b"\x7f" + (2**40).to_bytes(8, "little")
    path.write_bytes(content)
    with open_recording(path, Params()) as recording:
        entries = list(recording.measurements())
    assert sum(isinstance(entry, Measurement) for entry in entries) < 20
    assert [entry.reason for entry in entries if isinstance(entry, DroppedScan)] == [LACKS]
    (finding,) = [finding for finding in examine(path, Params()) if finding.subject == DAMAGE]
    assert finding.verdict == "needs you" and "damaged" in finding.text


def one_index_record_too_few(content: bytearray) -> None:
    """Bytes before the last pair of connection and count."""
    content[-8:-8] = bytes(8)


def one_chunk_too_few(content: bytearray) -> None:
    content[content.index(b"chunk_count=") + 12] -= 1


def one_chunk_too_few_of_an_unknown_kind(content: bytearray) -> None:
    one_chunk_too_few(content)
    content[content.rindex(b"op=\x05") + 3] = 99


@pytest.mark.parametrize("container", ["bag", "bag-lz4"])
@pytest.mark.parametrize("damage", [one_index_record_too_few, one_chunk_too_few, one_chunk_too_few_of_an_unknown_kind])
def test_a_bag_whose_index_lists_fewer_messages_than_its_chunks_hold_says_so(
    tmp_path: Path, container: str, damage: Callable[[bytearray], None]
) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=30, columns=4, ros=1), container)
    with open_recording(path, Params()) as recording:
        assert not [finding for finding in recording.findings if finding.subject == "file"]
    content = bytearray(path.read_bytes())
    damage(content)
    path.write_bytes(content)
    with open_recording(path, Params()) as recording:
        (told,) = [finding for finding in recording.findings if finding.subject == "file"]
        assert recording.scan_count < 30
    assert told.verdict == "needs you" and f"`rosbag reindex {path}`" in told.text


@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("missing", ["counts", "message indexes"])
def test_an_mcap_may_leave_out_what_its_specification_lets_it(tmp_path: Path, missing: str, chunking: bool) -> None:
    index = IndexType.CHUNK if missing == "message indexes" else IndexType.ALL
    path = rig.write_mcap(
        tmp_path / "walk.mcap",
        rig.walk(turns=30, columns=4),
        counts=missing != "counts",
        use_chunking=chunking,
        index_types=index,
    )
    with open_recording(path, Params()) as recording:
        entries = list(recording.measurements())
        assert recording.scan_count == 30 and not [entry for entry in entries if isinstance(entry, DroppedScan)]
    assert len(entries) == 30
