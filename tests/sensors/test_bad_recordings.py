"""Unusable recordings are refused with one sentence that says what is wrong, where, and what to do."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.sensors.doctor import examine
from app.sensors.findings import Finding
from app.sensors.probe import NO_GRAVITY, NO_NUMBERS
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig


def refusal(path: Path, params: Params | None = None) -> str:
    """The sentence, whether opening or reading raises it."""
    with pytest.raises(HemislamError) as caught, open_recording(path, params or Params()) as recording:
        list(recording.measurements())
    sentence = str(caught.value)
    assert "\n" not in sentence and sentence.endswith(".")
    assert "Traceback" not in sentence and "Error(" not in sentence
    options = [word for word in sentence.split() if word.strip("(`'").startswith("--")]
    assert not options or "start hemislam with" in sentence, "the page shows it, too, and has no command line"
    return sentence


# --- files -------------------------------------------------------------------------------------------
def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert str(tmp_path / "gone.mcap") in refusal(tmp_path / "gone.mcap")


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_an_empty_file_is_called_empty(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk{suffix}"
    path.touch()
    assert "is empty" in refusal(path)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_foreign_file_is_not_believed_by_its_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk{suffix}"
    path.write_bytes(b"\x7fELF" + bytes(5000))
    assert f"does not begin like a {suffix} file" in refusal(path)


def test_a_file_with_a_wrong_suffix_is_recognised(tmp_path: Path) -> None:
    bag = rig.write(tmp_path / "walk", rig.walk(turns=2, columns=4, ros=1), "bag")
    assert "it is a .bag: rename it" in refusal(bag.rename(tmp_path / "walk.mcap"))


def test_other_files_and_folders_are_refused_with_what_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "walk.pcap").write_bytes(b"1")
    assert "ROS 1 .bag" in refusal(tmp_path / "walk.pcap")
    assert "metadata.yaml" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("container", "repair"), [("bag", "rosbag reindex"), ("bare-db3", "sqlite3"), ("sqlite3", "sqlite3")]
)
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.9])
def test_a_cut_file_names_the_command_that_repairs_it(tmp_path: Path, container: str, repair: str, kept: float) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=20, columns=12, ros=1 if container == "bag" else 2), container)
    file = path if path.is_file() else next(path.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    assert repair in refusal(path)


def test_a_cut_mcap_is_read_up_to_the_cut_and_says_so(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=40, columns=30), "small-chunks")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    used: list[Measurement] = []
    with open_recording(path, Params()) as recording:
        assert any("cut off" in finding.text for finding in recording.findings)
        with pytest.raises(HemislamError, match="the file ends here"):
            used.extend(entry for entry in recording.measurements() if isinstance(entry, Measurement))
    assert 10 <= len(used) <= 21
    np.testing.assert_array_equal(used[5].scan.points, rig.turn(5, columns=30).points)


@pytest.mark.parametrize(("cut", "used", "ends_early"), [(1, 30, True), (0, 30, False)])
def test_a_recording_in_pieces_of_which_one_is_cut_is_read_around_the_cut(
    tmp_path: Path, cut: int, used: int, ends_early: bool
) -> None:
    """As a recorder leaves it that lost its power: without metadata.yaml. Names tell nothing about the order."""
    entries = sorted(rig.walk(turns=40, columns=30), key=lambda entry: entry[1])
    half = next(n for n, (_, log_ns, _) in enumerate(entries) if log_ns >= rig.START_NS + 20 * rig.PERIOD_NS)
    pieces = [
        rig.write(tmp_path / name, part, "small-chunks")
        for name, part in (("walk_9", entries[:half]), ("walk_10", entries[half:]))
    ]
    pieces[cut].write_bytes(pieces[cut].read_bytes()[: pieces[cut].stat().st_size // 2])
    found = 0
    with open_recording(tmp_path, Params()) as recording:
        assert any(f"1 of 2 files cut off ({pieces[cut].name}:" in finding.text for finding in recording.findings)
        with pytest.raises(HemislamError, match="ends here") if ends_early else nullcontext():
            for entry in recording.measurements():
                found += isinstance(entry, Measurement)
    assert abs(found - used) <= 3


@pytest.mark.parametrize("names", [["walk_9", "walk_10"], ["2024-05-01-10-59-58_0", "2024-05-01-11-00-00_1"], ["walk"]])
def test_the_pieces_of_a_ros_1_bag_are_read_as_one(tmp_path: Path, names: list[str]) -> None:
    entries = rig.walk(turns=20, columns=4, ros=1)
    for piece, name in enumerate(names):
        share = len(entries) // len(names)
        rig.write(tmp_path / name, entries[piece * share : (piece + 1) * share], "bag")
    with open_recording(tmp_path, Params()) as recording:
        assert f"{len(names)} .bag file(s)" in next(one.text for one in recording.findings if one.subject == "file")
        assert sum(isinstance(entry, Measurement) for entry in recording.measurements()) == 20
    last = tmp_path / f"{names[-1]}.bag"
    last.write_bytes(last.read_bytes()[:5000])
    assert f"`rosbag reindex {tmp_path / '*.bag' if len(names) > 1 else last}`" in refusal(tmp_path)


@pytest.mark.parametrize("names", [["hall_0", "yard_1"], ["2024-05-01", "2024-05-02"], ["walk", "walk_1"]])
def test_bags_of_several_recordings_are_not_mixed(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        rig.write(tmp_path / name, rig.walk(turns=2, columns=4, ros=1), "bag")
    assert f"such as {names[0]}.bag" in refusal(tmp_path)


def test_files_compressed_as_a_whole_name_the_command_that_unpacks_them(tmp_path: Path) -> None:
    folder = rig.write(tmp_path / "walk", rig.walk(turns=2, columns=4), "sqlite3-file")
    file = folder / "walk.db3.zstd"
    assert f"open its folder {folder}" in refusal(file)
    (folder / "metadata.yaml").unlink()
    assert f"`unzstd {file}`" in refusal(file)
    assert f"`unzstd {file}`" in refusal(folder)


def test_a_bag_that_is_still_active_names_the_command_that_repairs_it(tmp_path: Path) -> None:
    path = tmp_path / "walk.bag.active"
    path.write_bytes(b"#ROSBAG V2.0" + bytes(5000))
    assert f"`rosbag reindex {path}` repairs it, then rename it to walk.bag" in refusal(path)


@pytest.mark.parametrize("container", ["bare-db3", "sqlite3"])
def test_messages_left_in_the_write_ahead_log_of_sqlite_are_named(tmp_path: Path, container: str) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=4, columns=4), container)
    database = path if path.is_file() else next(path.glob("*.db3"))
    database.with_name(f"{database.name}-wal").write_bytes(bytes(100))
    with open_recording(path, Params()) as recording:
        (told,) = [finding for finding in recording.findings if finding.subject == "file"]
    assert told.verdict == "needs you" and f"`sqlite3 {database} 'PRAGMA wal_checkpoint(TRUNCATE)'`" in told.text


def test_an_mcap_without_the_ros2_profile_is_read_all_the_same(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=4, columns=12), "small-chunks")
    path.write_bytes(path.read_bytes().replace(b"\x04\x00\x00\x00ros2", b"\x04\x00\x00\x00xxxx", 1))
    with open_recording(path, Params()) as recording:
        assert sum(isinstance(entry, Measurement) for entry in recording.measurements()) == 4


def test_a_folder_with_broken_metadata_names_the_command_that_makes_it_again(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=2, columns=4), "sqlite3-message")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}")
    assert "ros2 bag reindex" in refusal(path)


def test_an_mcap_cut_in_its_head_is_refused(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=12), "bare-mcap")
    path.write_bytes(path.read_bytes()[:300])
    assert "mcap recover" in refusal(path)


def test_an_unindexed_bag_names_the_command_that_repairs_it(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=12, ros=1), "bag")
    content = bytearray(path.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    path.write_bytes(content)
    assert "has no index" in refusal(path) and "rosbag reindex" in refusal(path)


# --- contents ----------------------------------------------------------------------------------------
def test_a_recording_without_messages_says_so(tmp_path: Path) -> None:
    assert "without a single message" in refusal(rig.write(tmp_path / "walk", [], "mcap"))


def test_without_a_lidar_the_topics_that_there_are_are_listed(tmp_path: Path) -> None:
    blind = rig.write(tmp_path / "blind", [entry for entry in rig.walk(turns=3, columns=4) if entry[0] == "/imu"])
    assert "no point clouds" in refusal(blind) and "/imu (sensor_msgs/msg/Imu)" in refusal(blind)


def test_without_an_imu_the_scans_come_alone_and_in_order(tmp_path: Path) -> None:
    entries = [entry for entry in rig.walk(turns=8, columns=12) if entry[0] == "/points"]
    entries[4], entries[5] = (entries[4][0], *entries[5][1:]), (entries[5][0], *entries[4][1:])
    with open_recording(rig.write(tmp_path / "deaf", entries), Params()) as recording:
        assert recording.imu_topic == ""
        assert "no IMU" in next(finding.text for finding in recording.findings if finding.subject == "IMU topic")
        found = list(recording.measurements())
    assert len(found) == 8 and all(isinstance(entry, Measurement) and len(entry.imu) == 0 for entry in found)
    begins = [entry.scan.stamp_ns for entry in found if isinstance(entry, Measurement)]
    assert begins == sorted(begins)


def test_a_missing_topic_is_refused_with_the_topics_of_the_recording(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=4))
    assert "--lidar-topic /points" in refusal(path, Params().with_values({"recording.lidar_topic": "/nope"}))
    wrong_type = refusal(path, Params().with_values({"recording.imu_topic": "/points"}))
    assert "no IMU samples on /points" in wrong_type and "--imu-topic /imu" in wrong_type


@pytest.mark.parametrize(("lost", "keep"), [(True, True), (False, False)])
def test_clouds_of_nan_or_of_nothing_are_refused(tmp_path: Path, lost: bool, keep: bool) -> None:
    entries = []
    for topic, log, sent in rig.walk(turns=4, columns=4):
        if topic == "/points":
            number = (log - rig.START_NS) // rig.PERIOD_NS - 1
            made = rig.turn(number, columns=4)
            made = made if keep else made.only(np.zeros(len(made), bool))
            sent = rig.message(made, lost=range(len(made)) if lost else ())
        entries.append((topic, log, sent))
    sentence = refusal(rig.write(tmp_path / "walk", entries))
    assert "None of the 4 point clouds" in sentence and "--lidar-topic" in sentence


def test_a_few_empty_clouds_are_dropped_with_the_reason_and_the_rest_is_used(tmp_path: Path) -> None:
    entries = rig.walk(turns=6, columns=12)
    at = [n for n, (topic, _, _) in enumerate(entries) if topic == "/points"]
    for number in (0, 3):
        topic, log, _ = entries[at[number]]
        made = rig.turn(number, columns=12)
        entries[at[number]] = (topic, log, rig.message(made, lost=range(len(made))))
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        read = list(recording.measurements())
    reasons = [entry.reason for entry in read if isinstance(entry, DroppedScan)]
    assert reasons == ["all its points are NaN"] * 2
    assert sum(isinstance(entry, Measurement) for entry in read) == 4


def test_a_single_scan_is_too_little(tmp_path: Path) -> None:
    assert "a single usable scan" in refusal(rig.write(tmp_path / "walk", rig.walk(turns=1, columns=4)))


def test_an_imu_that_starts_after_the_end_or_stops_before_the_start_leaves_nothing(tmp_path: Path) -> None:
    late = rig.walk(turns=4, columns=4, imu_start_ns=600_000_000, imu_stop_ns=900_000_000)
    assert "None of the 4 scans" in refusal(rig.write(tmp_path / "late", late))
    assert "the IMU starts after it" in refusal(tmp_path / "late")
    early = rig.walk(turns=4, columns=4, imu_start_ns=-300_000_000, imu_stop_ns=-100_000_000)
    assert "the IMU stops before its end" in refusal(rig.write(tmp_path / "early", early))


def test_an_imu_that_starts_late_and_stops_early_leaves_all_but_the_begin(tmp_path: Path) -> None:
    entries = rig.walk(turns=9, columns=4, imu_start_ns=150_000_000, imu_stop_ns=720_000_000)
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        read = list(recording.measurements())
    assert [isinstance(entry, Measurement) for entry in read] == [False] * 2 + [True] * 7


def test_an_imu_that_begins_with_zeros_is_read_by_what_follows(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log, accel=(0.0, 0.0, 0.0 if log < rig.START_NS + 10**9 else 1.0)))
        if topic == "/imu"
        else (topic, log, sent)
        for topic, log, sent in rig.walk(turns=15, columns=4)
    ]
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        units = next(finding for finding in recording.findings if finding.subject == "IMU units")
        read = [entry for entry in recording.measurements() if isinstance(entry, Measurement)]
    assert "norm is 1 at the start" in units.text
    assert read and all(measurement.imu.accel[:, 2].min() > 9.0 for measurement in read)


def test_a_part_beyond_the_end_is_refused_with_the_length_of_the_recording(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=4, columns=4))
    with (
        open_recording(path, Params()) as recording,
        pytest.raises(HemislamError, match=r"no scan after 50 s.*lasts 0\.4"),
    ):
        list(recording.measurements(start_s=50))


def test_a_time_unit_that_makes_no_scans_names_the_option_that_does(tmp_path: Path) -> None:
    layout = rig.Layout(
        unit_ns=1_000, absolute=False, fields=[*rig.RELATIVE[:-1], ("time", "u4", "time")], header="first"
    )
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, layout=layout, columns=12))
    sentence = refusal(path, Params().with_values({"recording.time_unit": "s"}))
    assert "--set recording.time_unit=auto" in sentence


# --- points that cannot be returns -------------------------------------------------------------------
ABSOLUTE = rig.Layout([*[(axis, "f4", axis) for axis in "xyz"], ("timestamp", "f8", "time")])


def spoilt(field: str, value: float, share: float, layout: rig.Layout | None = None) -> list[rig.Entry]:
    """A walk in which a share of the points have this value in a field."""
    entries = []
    for topic, log, sent in rig.walk(turns=4, columns=12, layout=layout or ABSOLUTE):
        if topic == "/points":
            data = sent.data.copy()
            named = {column.name: column for column in sent.fields}[field]
            kind = np.dtype("f8" if named.datatype == 8 else "f4")
            column = np.ndarray((sent.width,), kind, data.data, named.offset, (sent.point_step,))
            column[: round(share * sent.width)] = value
            sent = replace(sent, data=data)
        entries.append((topic, log, sent))
    return entries


@pytest.mark.parametrize("share", [0.1, 0.6])
@pytest.mark.parametrize(
    ("field", "value"),
    [("timestamp", np.nan), ("timestamp", np.inf), ("timestamp", 1e300), ("x", np.inf), ("y", 1e30), ("z", -3e4)],
)
def test_points_that_cannot_be_returns_are_left_out_and_reported(
    tmp_path: Path, field: str, value: float, share: float
) -> None:
    path = rig.write(tmp_path / "walk", spoilt(field, value, share))
    with open_recording(path, Params()) as recording:
        read = list(recording.measurements())
    assert len(read) == 4
    for entry in read:
        assert isinstance(entry, Measurement)
        assert entry.scan.refused == round(share * 96) == 96 - len(entry.scan)
        assert np.abs(entry.scan.points).max() < 100 and entry.scan.end_ns - entry.scan.stamp_ns < 1e8
        assert "points beyond 10 km or without a time were left out" in entry.notices
    (returns,) = (finding for finding in examine(path, Params()) if finding.subject == "returns")
    assert "beyond 10 km or without a time" in returns.text
    assert returns.verdict == ("corrected" if share < 0.3 else "needs you")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_time_field_without_a_time_gives_way_to_the_azimuth(tmp_path: Path, value: float) -> None:
    path = rig.write(tmp_path / "walk", spoilt("timestamp", value, 1.0))
    with open_recording(path, Params()) as recording:
        assert any("derived from the azimuth" in finding.text for finding in recording.findings)
        assert all(isinstance(entry, Measurement) for entry in recording.measurements())


@pytest.mark.parametrize("big_endian", [False, True])
def test_a_byte_order_that_is_stated_wrongly_is_corrected(tmp_path: Path, big_endian: bool) -> None:
    layout = rig.Layout(big_endian=big_endian)
    entries = [
        (topic, log, replace(sent, is_bigendian=not big_endian) if topic == "/points" else sent)
        for topic, log, sent in rig.walk(turns=3, columns=12, layout=layout)
    ]
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        assert any("is_bigendian" in finding.text for finding in recording.findings)
        (first, *_) = recording.measurements()
    assert isinstance(first, Measurement)
    np.testing.assert_array_equal(first.scan.points, rig.turn(0, columns=12).points)


def steps_alone(stamp_ns: int) -> Any:
    """A sample of a walk at two steps a second, without gravity."""
    return rig.imu(stamp_ns, accel=(0.3, 0.0, 3.0 * math.sin(4.0e-9 * math.pi * (stamp_ns - rig.START_NS))))


@pytest.mark.parametrize(
    ("felt", "finding"),
    [
        (steps_alone, NO_GRAVITY),
        (lambda stamp_ns: rig.imu(stamp_ns, accel=(0.0, 0.0, 0.0)), NO_GRAVITY),
        (lambda stamp_ns: rig.imu(stamp_ns, accel=(math.nan,) * 3), NO_NUMBERS),
    ],
)
def test_a_recording_whose_imu_feels_no_gravity_is_mapped_by_the_lidar_alone(
    tmp_path: Path, felt: Callable[[int], Any], finding: Finding
) -> None:
    entries = [
        (topic, log, felt(log) if topic == "/imu" else sent) for topic, log, sent in rig.walk(turns=30, columns=4)
    ]
    path = rig.write(tmp_path / "walk", entries)
    with open_recording(path, Params()) as recording:
        assert finding in recording.findings and not recording.imu_topic
        measured = list(recording.measurements())
    assert len(measured) == 30 and all(isinstance(one, Measurement) and not len(one.imu) for one in measured)
    chosen = Params().with_values({"recording.acceleration_unit": "m/s2"})
    if felt is steps_alone:
        with open_recording(path, chosen) as recording:
            assert recording.imu_topic == "/imu", "a unit that the user sets is used"


@pytest.mark.parametrize(("container", "suffix"), [("bare-mcap", ".MCAP"), ("bag", ".BAG"), ("bare-db3", ".Db3")])
def test_a_suffix_in_capitals_is_the_same_suffix(tmp_path: Path, container: str, suffix: str) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=4, ros=1 if container == "bag" else 2), container)
    with open_recording(path.rename(tmp_path / f"other{suffix}"), Params()) as recording:
        assert len(list(recording.measurements())) == 3


@pytest.mark.parametrize("container", ["bare-mcap", "bag", "bare-db3"])
def test_a_topic_cannot_write_to_the_terminal(tmp_path: Path, container: str) -> None:
    entries = rig.walk(turns=3, columns=4, lidar_topic="/\x1b[31mred", ros=1 if container == "bag" else 2)
    path = rig.write(tmp_path / "walk", entries, container)
    with open_recording(path, Params()) as recording:
        assert recording.lidar_topic == "/\\x1b[31mred" and len(list(recording.measurements())) == 3
        assert all(finding.text.isprintable() for finding in recording.findings)
