"""The same walk reads the same from every container, from any start, and from recordings of other projects.

Tests app/slam/provenance.py.
"""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from app.sensors.presets import resolve_params
from app.sensors.recording import Measurements, Place, open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.provenance import hash_input
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig

CONTAINERS = [
    "bag", "bag-bz2", "bag-lz4", "sqlite3", "sqlite3-message", "sqlite3-file", "mcap", "mcap-zstd", "bare-mcap",
    "bare-db3", "small-chunks",
]  # fmt: skip


def read(path: Path, params: Params | None = None, **part: float) -> list[Measurement | DroppedScan]:
    with open_recording(path, params or Params()) as recording:
        return list(recording.measurements(**part))


def scans(entries: list[Measurement | DroppedScan]) -> list[int]:
    """Numbers of the revolutions that can be used."""
    return [round((e.scan.stamp_ns - rig.START_NS) / rig.PERIOD_NS) for e in entries if isinstance(e, Measurement)]


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_container_gives_the_same_measurements(tmp_path: Path, container: str) -> None:
    ros = 1 if container.startswith("bag") else 2
    path = rig.write(tmp_path / "walk", rig.walk(turns=4, ros=ros, columns=12), container)
    with open_recording(path, Params()) as recording:
        entries = list(recording.measurements())
        assert recording.scan_count == 4
        assert abs(recording.start_ns - rig.START_NS) < 1_000
        assert recording.duration_s == pytest.approx(0.45, abs=0.02)
    assert scans(entries) == [0, 1, 2, 3]
    for number, entry in enumerate(entries):
        assert isinstance(entry, Measurement)
        truth = rig.turn(number, columns=12)
        np.testing.assert_array_equal(entry.scan.points, truth.points)
        np.testing.assert_array_equal(entry.scan.ring, truth.ring)
        np.testing.assert_allclose(entry.imu.accel, np.tile([0, 0, 9.81], (len(entry.imu), 1)), atol=0.01)
        assert entry.imu.stamps_ns[0] <= entry.scan.stamp_ns <= entry.scan.end_ns <= entry.imu.stamps_ns[-1]


def told(entry: Measurement | DroppedScan) -> tuple[object, ...]:
    """All of an entry, comparable to the bit."""
    if isinstance(entry, DroppedScan):
        return entry.stamp_ns, entry.reason
    scan, imu = entry.scan, entry.imu
    arrays = (scan.points, scan.offsets_ns, scan.intensity, scan.ring, imu.stamps_ns, imu.gyro, imu.accel)
    return scan.stamp_ns, entry.notices, *(array.tobytes() for array in arrays)


@pytest.mark.parametrize("container", [*CONTAINERS, "cut"])
@pytest.mark.parametrize("start_s", [0.0, 0.35])
def test_reading_is_taken_up_anywhere_as_if_it_had_gone_on(tmp_path: Path, container: str, start_s: float) -> None:
    ros = 1 if container.startswith("bag") else 2
    entries = rig.walk(turns=14, ros=ros, columns=12, delay_ns=500_000)  # each logged with a sample of the IMU
    logged = [log_ns for _, log_ns, _ in entries]
    assert len(set(logged)) < len(logged)
    gap = range(rig.START_NS + 700_000_000, rig.START_NS + 930_000_000)
    entries = [entry for entry in entries if not (entry[0] == "/imu" and entry[1] in gap)]
    if container != "cut":
        again = [n for n, (topic, _, _) in enumerate(entries) if topic == "/points"][5]
        entries.insert(again, entries[again])
    path = rig.write(tmp_path / "walk", entries, "small-chunks" if container == "cut" else container)
    if container == "cut":
        path.write_bytes(path.read_bytes()[: 4 * path.stat().st_size // 5])
    with open_recording(path, Params()) as recording:

        def rest(reading: Measurements) -> tuple[list[tuple[object, ...]], list[Place], str]:
            found, places = [], []
            try:
                for entry in reading:
                    found.append(told(entry))
                    places.append(reading.place())
            except HemislamError as error:
                return found, places, str(error)
            return found, places, ""

        whole, places, end = rest(recording.measurements(start_s))
        assert any(len(entry) == 2 for entry in whole) or container == "cut", "the repeated scan is dropped"
        assert any("no IMU sample" in str(entry[1]) for entry in whole), "one lies in a gap of the IMU"
        assert ("the file ends here" in end) is (container == "cut")
        for number, place in enumerate(places, start=1):
            for _ in range(2):  # a place serves more than once
                assert rest(recording.measurements(start_s, after=place))[::2] == (whole[number:], end)


def test_a_folder_without_metadata_reads_its_files(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=12), "mcap")
    (path / "metadata.yaml").unlink()
    with open_recording(path, Params()) as recording:
        assert scans(list(recording.measurements())) == [0, 1, 2]
        assert any("no metadata.yaml" in finding.text for finding in recording.findings)


def test_start_and_duration_choose_scans_by_their_own_time(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=9, columns=12))
    assert scans(read(path, start_s=0.29, duration_s=0.4)) == [3, 4, 5, 6]
    assert scans(read(path, start_s=0.35)) == [4, 5, 6, 7, 8]
    assert scans(read(path, duration_s=0.2)) == [0, 1]
    # Just before a scan begins, too: its first points need the IMU sample before `start_s`.
    assert scans(read(path, start_s=0.2995)) == [3, 4, 5, 6, 7, 8]


def test_reading_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=12))

    def everything() -> list[bytes]:
        return [e.scan.points.tobytes() + e.imu.stamps_ns.tobytes() for e in read(path) if isinstance(e, Measurement)]

    assert everything() == everything() != []


def test_scans_logged_late_and_in_disorder_are_paired_by_their_stamps(tmp_path: Path) -> None:
    entries = [
        (topic, log + (70_000_000 if topic == "/points" and number % 2 else 0), sent)
        for number, (topic, log, sent) in enumerate(rig.walk(turns=6, columns=12))
    ]
    path = rig.write(tmp_path / "walk", sorted(entries, key=lambda entry: entry[1]))
    assert scans(read(path)) == [0, 1, 2, 3, 4, 5]


def test_an_accelerometer_in_g_is_given_in_metres_per_second_squared(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log - 500_000, accel=(0.0, -1.0, 0.0)) if topic == "/imu" else sent)
        for topic, log, sent in rig.walk(turns=3, columns=12)
    ]
    first = read(rig.write(tmp_path / "walk", entries))[0]
    assert isinstance(first, Measurement)
    np.testing.assert_allclose(first.imu.accel[0], [0, -9.80665, 0])


def test_an_imu_clock_that_lags_is_found_and_the_proposed_option_settles_it(tmp_path: Path) -> None:
    entries = [
        (topic, log, rig.imu(log - 500_000 - 37_000_000_000) if topic == "/imu" else sent)
        for topic, log, sent in rig.walk(turns=5, columns=12)
    ]
    path = rig.write(tmp_path / "walk", entries)
    with open_recording(path, Params()) as recording:
        clocks = next(finding for finding in recording.findings if finding.subject == "clocks")
    assert clocks.verdict == "needs you" and "behind the LiDAR's" in clocks.text
    name, _, offset = clocks.option.removeprefix("--set ").partition("=")
    assert name == "recording.imu_time_offset" and abs(float(offset) - 37.0) < 0.01  # the delays of logging remain
    settled = resolve_params(path, None, None, [clocks.option.removeprefix("--set ")])
    assert scans(read(path, settled)) == [0, 1, 2, 3, 4]


def test_headers_without_time_fall_back_on_the_log_times(tmp_path: Path) -> None:
    entries = []
    for topic, log, sent in rig.walk(turns=4, layout=rig.Layout(absolute=False, fields=rig.RELATIVE), columns=12):
        sent.header = rig.header(0, 2)
        entries.append((topic, log, sent))
    path = rig.write(tmp_path / "walk", entries)
    with open_recording(path, Params()) as recording:
        assert sum("log times are used" in finding.text for finding in recording.findings) == 2
        entries_read = list(recording.measurements())
    times = [entry.scan.stamp_ns for entry in entries_read if isinstance(entry, Measurement)]
    begins = [rig.turn(number).begin_ns for number in range(4)]
    # Logged 3 ms after a scan's end; the last firing (of 96) itself is a hundredth of a turn before it.
    np.testing.assert_allclose(np.array(times) - begins, 4_000_000, atol=1_100_000)


def test_of_several_topics_the_busiest_is_used_and_the_others_are_named(tmp_path: Path) -> None:
    few = [
        ("/other_points", log, sent) for _, log, sent in rig.walk(turns=2, columns=4) if sent.__msgtype__.endswith("2")
    ]
    entries = sorted([*rig.walk(turns=4, columns=12), *few], key=lambda entry: entry[1])
    path = rig.write(tmp_path / "walk", entries)
    with open_recording(path, Params()) as recording:
        assert recording.lidar_topic == "/points"
        finding = next(finding for finding in recording.findings if finding.subject == "lidar topic")
    assert finding.verdict == "needs you" and "/other_points" in finding.text
    chosen = Params().with_values({"recording.lidar_topic": "/other_points"})
    with open_recording(path, chosen) as recording:
        assert recording.scan_count == 2


def test_the_scanner_is_preferred_to_a_depth_camera_and_a_whole_imu_to_a_gyroscope(tmp_path: Path) -> None:
    plain = rig.Layout(fields=[("x", "f4", "x"), ("y", "f4", "y"), ("z", "f4", "z")])
    others = [
        ("/camera/points", log + late, rig.message(rig.turn(0, 2), plain))
        for topic, log, _ in rig.walk(turns=4, columns=2)
        for late in (1, 2, 3)
        if topic == "/points"
    ] + [
        ("/camera/gyro", log + late, rig.imu(log, (0, 0, 0), (0.1, 0, 0)))
        for topic, log, _ in rig.walk(turns=4, columns=2)
        for late in (1, 2)
        if topic == "/imu"
    ]
    entries = sorted([*rig.walk(turns=4, columns=12), *others], key=lambda entry: entry[1])
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        assert (recording.lidar_topic, recording.imu_topic) == ("/points", "/imu")
        chosen = {finding.subject: finding for finding in recording.findings if "topic" in finding.subject}
    assert {finding.verdict for finding in chosen.values()} == {"corrected"}
    assert "/camera/points" in chosen["lidar topic"].text and "/camera/gyro" in chosen["IMU topic"].text


def test_the_hash_of_a_file_is_its_sha256_and_that_of_a_folder_covers_all_its_files(tmp_path: Path) -> None:
    folder = rig.write(tmp_path / "walk", rig.walk(turns=2, columns=4))
    file = next(folder.glob("*.mcap"))
    assert hash_input(file) == hashlib.sha256(file.read_bytes()).hexdigest()
    before = hash_input(folder)
    (folder / "metadata.yaml").write_text("changed")
    assert hash_input(folder) != before


@pytest.mark.parametrize(
    ("name", "count", "down"),
    [("hall_bpearl", 598, "+x"), ("outdoor_bpearl", 498, "+x"), ("garage_hdl32e", 45, "−z")],
)
def test_the_recordings_of_others_read_whole(shared_data: Path, name: str, count: int, down: str) -> None:
    with open_recording(shared_data / f"{name}.mcap", Params()) as recording:
        findings = {finding.subject: finding for finding in recording.findings}
        entries = list(recording.measurements(duration_s=4.0))
        assert recording.scan_count == count
    assert len(entries) == 40
    assert all(isinstance(entry, Measurement) and not entry.notices for entry in entries)
    assert f"LiDAR's {down} axis" in findings["gravity"].text
    assert "of the last point" in findings["header stamp"].text
    assert "one turn in 0.100" in findings["rotation"].text
    assert findings["mount"].verdict == "needs you"


@pytest.mark.parametrize(
    ("given", "is_told"), [("0.1 " * 8, False), ("", False), ("0.1 -0.1", True), ("0.1 " * 9, True)]
)
def test_corrections_of_another_lidars_lines_are_told(tmp_path: Path, given: str, is_told: bool) -> None:
    path = rig.write(tmp_path / "walk", rig.walk(turns=3, columns=12))
    params = Params().with_values({"sensor.range_corrections": given})
    with open_recording(path, params) as recording:
        told_of = [finding for finding in recording.findings if finding.subject == "scan lines"]
    assert bool(told_of) == is_told
    if is_told:
        assert f"holds {len(given.split())} numbers, but the LiDAR has 8 scan lines" in told_of[0].text
