"""The doctor reports the faults of a recording, and nothing else.

Tests app/sensors/clocks.py.
"""

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from app.sensors.doctor import examine
from app.sensors.findings import Finding
from app.sensors.recording import ScanEntry, open_recording
from app.slam.params import Params
from app.slam.types import Scan
from tests.sensors import rig

MOUNTED = Params().merged({"sensor": {"translation": [0.1, 0.0, 0.0]}})


def by_subject(path: Path, params: Params = MOUNTED) -> dict[str, Finding]:
    return {finding.subject: finding for finding in examine(path, params)}


def test_a_good_recording_is_fine_in_every_respect(tmp_path: Path) -> None:
    fractions: list[float] = []
    path = rig.write(tmp_path / "walk", rig.walk(turns=20, columns=12))
    findings = examine(path, MOUNTED, fractions.append)
    assert [finding for finding in findings if finding.verdict != "fine"] == []
    assert {f.subject for f in findings} >= {
        "topics", "fields", "point time", "header stamp", "rotation", "ring order", "IMU units", "gravity", "mount",
        "scan rate", "IMU rate", "clocks", "IMU gaps", "IMU time", "scan time", "pairing", "returns",
    }  # fmt: skip
    assert fractions == sorted(fractions) and fractions[-1] == 1.0


def test_rates_are_those_of_the_sensors(tmp_path: Path) -> None:
    found = by_subject(rig.write(tmp_path / "walk", rig.walk(turns=8, columns=4, imu_period_ns=20_000_000)))
    assert "10.00 Hz, 8 messages" in found["scan rate"].text
    assert "50.00 Hz" in found["IMU rate"].text
    assert found["IMU rate"].verdict == "needs you"


def test_samples_that_are_stamped_when_they_are_read_are_named(tmp_path: Path) -> None:
    entries = rig.walk(turns=20, columns=4, imu_period_ns=5_000_000)
    samples = iter(range(10_000))
    for topic, _, sent in entries:
        if topic == "/imu":
            number = next(samples)
            late_ns = (9 - number % 10) * 4_900_000
            sent.header = rig.header(rig.START_NS - 50_000_000 + number * 5_000_000 + late_ns, 2)
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["IMU rate"].verdict == "needs you"
    assert "20" in found["IMU rate"].text and "Hz on average, but stamped in batches of 10" in found["IMU rate"].text


def test_outages_steps_back_and_missing_scans_are_counted(tmp_path: Path) -> None:
    entries = rig.walk(turns=20, columns=4)
    stamp = {
        id(sent): sent.header.stamp.sec * 10**9 + sent.header.stamp.nanosec - rig.START_NS for _, _, sent in entries
    }
    kept = [
        (topic, log, sent)
        for topic, log, sent in entries
        if not (topic == "/imu" and 500_000_000 < stamp[id(sent)] < 900_000_000)
        and not (topic == "/points" and stamp[id(sent)] in (1_400_000_000, 1_500_000_000))
    ]
    at = next(n for n, (topic, _, sent) in enumerate(kept) if topic == "/imu" and stamp[id(sent)] == 1_200_000_000)
    kept.insert(at + 1, ("/imu", kept[at][1] + 1, rig.imu(rig.START_NS + 1_170_000_000)))
    found = by_subject(rig.write(tmp_path / "walk", kept))
    assert found["IMU gaps"].verdict == "needs you" and "the longest 0.400 s" in found["IMU gaps"].text
    assert found["IMU time"].verdict == "corrected" and "1 steps back" in found["IMU time"].text
    assert "2 missing" in found["scan time"].text and "0.300 s" in found["scan time"].text


def test_a_pause_of_the_recorder_is_told_once_and_is_no_fault_of_the_imu(tmp_path: Path) -> None:
    kept = [
        entry for entry in rig.walk(turns=40, columns=4) if not 1_000_000_000 < entry[1] - rig.START_NS < 3_000_000_000
    ]
    found = by_subject(rig.write(tmp_path / "walk", kept))
    assert found["pauses"].verdict == "needs you" and "1 without scans and IMU samples" in found["pauses"].text
    assert "at 1.0 s" in found["pauses"].text and found["IMU gaps"].verdict == "fine"


def test_samples_that_came_twice_are_no_batches(tmp_path: Path) -> None:
    entries = [
        (topic, log + late, sent)
        for topic, log, sent in rig.walk(turns=20, columns=4, imu_period_ns=5_000_000)
        for late in ((0, 100_000) if topic == "/imu" else (0,))
    ]
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["IMU rate"].verdict == "fine" and "200.00 Hz" in found["IMU rate"].text
    assert found["IMU time"].verdict == "corrected" and "repeated stamps" in found["IMU time"].text


def test_scans_that_came_twice_are_no_second_lidar(tmp_path: Path) -> None:
    entries = [
        (topic, log + late, sent)
        for topic, log, sent in rig.walk(turns=20, columns=4)
        for late in ((0, 100_000) if topic == "/points" else (0,))
    ]
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert "scans" not in found and found["pairing"].verdict == "fine"
    assert found["scan time"].verdict == "corrected" and "20 came twice" in found["scan time"].text


def test_two_lidars_that_turn_in_step_are_still_two(tmp_path: Path) -> None:
    entries = []
    for topic, log, sent in rig.walk(turns=20, columns=4):
        entries.append((topic, log, sent))
        if topic == "/points":
            other = rig.turn((log - rig.START_NS) // rig.PERIOD_NS - 1, columns=4)
            other.points = -other.points
            entries.append((topic, log + 100_000, rig.message(other)))
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert "two LiDARs" in found["scans"].text and found["pairing"].verdict == "needs you"


def test_zeros_in_place_of_imu_samples_are_named_and_are_a_gap(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log, accel=(0.0, 0.0, 0.0)) if topic == "/imu" and 5 < n / 20 < 10 else sent)
        for n, (topic, log, sent) in enumerate(rig.walk(turns=20, columns=4))
    ]
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["IMU values"].verdict == "needs you"
    assert "without acceleration, not even gravity's" in found["IMU values"].text
    assert found["IMU gaps"].verdict == "needs you" and found["pairing"].verdict == "fine"


def test_a_clock_that_is_set_back_loses_a_part_of_the_walk_and_that_is_said(tmp_path: Path) -> None:
    entries = rig.walk(turns=30, columns=4)
    for _, log_ns, sent in entries:
        stamp_ns = sent.header.stamp.sec * 10**9 + sent.header.stamp.nanosec
        if log_ns > rig.START_NS + 1_500_000_000:
            sent.header = rig.header(stamp_ns - 500_000_000, 2)
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["IMU time"].verdict == "needs you"
    assert "samples until the stamps have caught up are left out" in found["IMU time"].text


def test_an_imu_that_stops_for_good_is_a_gap_to_the_end(tmp_path: Path) -> None:
    found = by_subject(rig.write(tmp_path / "walk", rig.walk(turns=20, columns=4, imu_stop_ns=1_000_000_000)))
    assert found["IMU gaps"].verdict == "needs you" and "1 longer than 0.1 s" in found["IMU gaps"].text
    assert found["pairing"].text == "all 20 scans can be used"


def test_the_share_of_nan_is_reported(tmp_path: Path) -> None:
    entries = []
    for topic, log, sent in rig.walk(turns=4, columns=10):
        if topic == "/points":
            made = rig.turn((log - rig.START_NS) // rig.PERIOD_NS - 1, columns=10)
            sent = rig.message(made, lost=range(0, 80, 4))
        entries.append((topic, log, sent))
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert "25.0% are NaN, 75.0% are returns" in found["returns"].text


def test_damage_is_a_finding_and_the_rest_is_still_examined(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=60, columns=40), "small-chunks")
    content = bytearray(path.read_bytes())
    at = len(content) * 2 // 3
    content[at : at + 2000] = bytes(2000)
    path.write_bytes(content)
    found = by_subject(path)
    assert found["file"].verdict == "needs you" and "is damaged" in found["file"].text
    assert "10.00 Hz" in found["scan rate"].text


def test_a_recording_without_clouds_is_reported_and_says_what_is_missing(tmp_path: Path) -> None:
    entries = [entry for entry in rig.walk(turns=20, columns=12) if entry[0] == "/imu"]
    findings = examine(rig.write(tmp_path / "walk", entries), MOUNTED)
    assert findings[0].subject == "use" and findings[0].verdict == "needs you"
    assert "holds no point clouds" in findings[0].text
    assert "topics" in {finding.subject for finding in findings}


def test_a_recording_of_packets_says_that_the_driver_must_make_clouds_of_them(tmp_path: Path) -> None:
    kind = "rslidar_msg/msg/RslidarPacket"
    rig.TYPESTORES[2].register(get_types_from_msg("std_msgs/Header header\nuint8[] data", kind))
    packets = [
        ("/rslidar_packets", at, rig.TYPESTORES[2].types[kind](header=rig.header(at, 2), data=np.zeros(1210, np.uint8)))
        for at in range(rig.START_NS, rig.START_NS + 2 * rig.PERIOD_NS, rig.PERIOD_NS // 10)
    ]
    entries = [entry for entry in rig.walk(turns=20, columns=12) if entry[0] == "/imu"]
    found = examine(rig.write(tmp_path / "walk", packets + entries), MOUNTED)[0]
    assert found.subject == "use" and found.verdict == "needs you"
    assert "only packets as the sensor sends them (/rslidar_packets): run its ROS driver" in found.text


def test_a_recording_without_an_imu_is_reported_and_nothing_is_said_of_one(tmp_path: Path) -> None:
    entries = [entry for entry in rig.walk(turns=20, columns=12) if entry[0] == "/points"]
    found = {finding.subject: finding for finding in examine(rig.write(tmp_path / "walk", entries), MOUNTED)}
    assert "no IMU: motion is estimated from the LiDAR alone" in found["IMU topic"].text
    assert found["pairing"].text == "all 20 scans can be used"
    assert not {"IMU rate", "IMU gaps", "IMU units", "clocks", "mount"} & found.keys()


def test_a_clock_that_was_set_on_the_way_is_named(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log - 500_000 - (400_000_000 if log > rig.START_NS + 6 * 10**9 else 0)))
        if topic == "/imu"
        else (topic, log, sent)
        for topic, log, sent in rig.walk(turns=110, columns=2)
    ]
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["clocks"].verdict == "needs you" and "changes by 0.400 s" in found["clocks"].text


@pytest.mark.parametrize("coarse", ["/imu", "/points"])
def test_stamps_in_whole_seconds_are_named_and_are_no_other_clock(coarse: str, tmp_path: Path) -> None:
    entries = rig.walk(turns=20, layout=rig.Layout(absolute=False, fields=rig.RELATIVE), columns=4)
    for topic, _, sent in entries:
        if topic == coarse:
            sent.header.stamp.nanosec = 0
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert found["stamps"].verdict == "corrected"
    assert f"the headers of {coarse} carry whole seconds only; the log times are used" in found["stamps"].text
    for subject in ("clocks", "IMU rate", "IMU gaps", "IMU time", "scan rate", "scan time", "pairing"):
        assert found[subject].verdict == "fine", found[subject]


def test_the_gravity_finding_follows_the_imu(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log - 500_000, accel=(-9.7, 0.0, 1.0)) if topic == "/imu" else sent)
        for topic, log, sent in rig.walk(turns=4, columns=4)
    ]
    found = by_subject(rig.write(tmp_path / "walk", entries))
    assert "LiDAR's +x axis" in found["gravity"].text
    assert f"down is {np.degrees(np.arctan2(1.0, 9.7)):.0f} deg" in found["gravity"].text


def in_parts(parts: int, layout: rig.Layout, columns: int = 90, seen: float = 1.0) -> list[rig.Entry]:
    """A walk whose driver publishes so many messages a turn. seen: the share of each message that has returns."""
    entries = [entry for entry in rig.walk(turns=6, columns=8) if entry[0] == "/imu"]
    for number in range(6):
        made = rig.turn(number, columns)
        for slots in np.array_split(np.arange(len(made)), parts):
            part = made.only(slots[: round(len(slots) * seen)])
            sent = rig.message(part, layout)
            end_ns = made.begin_ns + int(made.offsets_ns[slots[-1]])
            sent.header = rig.header(end_ns, 2)
            entries.append(("/points", end_ns + 3_000_000, sent))
    return sorted(entries, key=lambda entry: entry[1])


UNTIMED = rig.Layout(fields=[("x", "f4", "x"), ("y", "f4", "y"), ("z", "f4", "z"), ("ring", "u2", "ring")])


@pytest.mark.parametrize(("parts", "degrees"), [(2, 180), (5, 72), (10, 36)])
def test_messages_that_hold_a_part_of_a_turn_are_told_with_what_to_do(parts: int, degrees: int, tmp_path: Path) -> None:
    told = f"each message holds {degrees} degrees of a turn"
    timed = by_subject(rig.write(tmp_path / "timed", in_parts(parts, rig.Layout())))["rotation"]
    assert told in timed.text and "publish whole turns" in timed.text and timed.verdict == "needs you"
    path = rig.write(tmp_path / "untimed", in_parts(parts, UNTIMED))
    untimed = by_subject(path)["point time"]
    assert told in untimed.text and "turns 10 times a second" in untimed.text and untimed.verdict == "needs you"
    assert untimed.option == "--set recording.rotation_rate=10"
    settled = by_subject(path, MOUNTED.with_values({"recording.rotation_rate": 10.0}))["point time"]
    assert told in settled.text and settled.verdict == "corrected"
    with open_recording(path, MOUNTED.with_values({"recording.rotation_rate": 10.0})) as recording:
        scans = [one.scan for one in recording.entries() if isinstance(one, ScanEntry) and isinstance(one.scan, Scan)]
    assert scans[1].offsets_ns.max() == pytest.approx(rig.PERIOD_NS / parts, rel=0.15)


@pytest.mark.parametrize("layout", [rig.Layout(), UNTIMED])
def test_a_whole_turn_of_which_only_a_part_has_returns_is_no_part_of_a_turn(layout: rig.Layout, tmp_path: Path) -> None:
    found = by_subject(rig.write(tmp_path / "walk", in_parts(1, layout, seen=0.3)))
    assert not [finding for finding in found.values() if "each message holds" in finding.text]
