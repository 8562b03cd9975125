"""A live session on disk: read again as it was, and nearly all of it after a crash."""

import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from app.sensors.live import recorder as recorder_module
from app.sensors.live.intake import Intake
from app.sensors.live.recorder import MAX_SCANS, Recorder
from app.sensors.live.source import LiveSource
from app.sensors.recording import ImuEntry, ScanEntry, open_recording
from app.sensors.ros import IMU_TOPIC, LIDAR_TOPIC, stamp_ns
from app.sensors.source import Source
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement, Scan
from tests.sensors.live import sensor

TURN_NS = 100_000_000


def scan(turn: int) -> Scan:
    rng = np.random.default_rng(turn)
    angle = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    ring = np.arange(900, dtype=np.uint16) % 8
    height = np.tan(np.radians(5 + 10 * ring))
    points = np.column_stack([np.cos(angle), -np.sin(angle), height]) * (3 + rng.random((900, 1)))
    offsets = np.linspace(0, 99_000_000, 900).astype(np.int32)
    begin = sensor.START_NS + turn * TURN_NS
    return Scan(begin, points.astype(np.float32), offsets, rng.integers(0, 256, 900).astype(np.float32), ring)


def record_samples(recorder: Recorder, turns: range) -> None:
    for turn in turns:
        for k in range(20):
            stamp = sensor.START_NS + turn * TURN_NS + k * 5_000_000
            recorder.add(ImuEntry(stamp + 1_000_000, stamp, (0.1, 0.2, 0.001 * k), (0.0, 0.0, 9.81)))


def record(recorder: Recorder, turns: range) -> None:
    for turn in turns:
        record_samples(recorder, range(turn, turn + 1))
        recorder.add(ScanEntry(sensor.START_NS + (turn + 1) * TURN_NS + 3_000_000, None, scan(turn)))


def scans(path: Path) -> list[Scan]:
    with open_recording(path, Params()) as recording:
        return [m.scan for m in recording.measurements() if isinstance(m, Measurement)]


def test_a_session_reads_again_as_it_was(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "folder" / "session.mcap")
    record(recorder, range(12))
    recorder.close()
    assert recorder.bytes_written == recorder.path.stat().st_size
    found = scans(recorder.path)
    assert len(found) == 12
    for turn, again in enumerate(found):
        truth = scan(turn)
        np.testing.assert_array_equal(again.points, truth.points)
        np.testing.assert_array_equal(again.intensity, truth.intensity)
        np.testing.assert_array_equal(again.ring, truth.ring)
        assert again.truth_ground is None
        assert abs(again.stamp_ns - truth.stamp_ns) < 300
    # What `ros2 bag` needs: profile, message types with their definitions, an index.
    with AnyReader([recorder.path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        assert types == {"/rslidar_points": "sensor_msgs/msg/PointCloud2", "/imu/data": "sensor_msgs/msg/Imu"}
        assert reader.message_count == 12 * 21


def test_a_scan_that_waited_for_its_rest_leaves_log_times_in_order(tmp_path: Path) -> None:
    """The last one before the LiDAR falls silent is given a second late, with the time at which its packets came."""
    recorder = Recorder(tmp_path / "session.mcap")
    record(recorder, range(12))
    record_samples(recorder, range(12, 23))
    recorder.add(ScanEntry(sensor.START_NS + 13 * TURN_NS, None, scan(12)))
    record_samples(recorder, range(23, 40))
    record(recorder, range(40, 50))
    recorder.close()
    with recorder.path.open("rb") as file:
        logged = [record.log_time for record in StreamReader(file).records if isinstance(record, Message)]
    assert logged == sorted(logged) and len(scans(recorder.path)) == 23


@pytest.mark.parametrize("imu_from", [None, 13])
def test_scans_that_no_sample_covers_are_recorded_too(tmp_path: Path, imu_from: int | None) -> None:
    recorder = Recorder(tmp_path / "session.mcap")
    intake = Intake(Params())
    intake.recorder = recorder
    with LiveSource([], intake):
        for turn in range(150):
            if imu_from is not None and turn >= imu_from * 10:
                put_samples(intake, turn, 9.81)
            intake.put_scan(scan(turn), sensor.START_NS + (turn + 1) * TURN_NS)
    with Source(recorder.path) as source:
        found = [message for _, _, message in source.messages((LIDAR_TOPIC,))]
        samples = sum(1 for _ in source.messages((IMU_TOPIC,)))
    assert [stamp_ns(message.header.stamp) for message in found] == [scan(turn).end_ns for turn in range(150)]
    assert samples == (400 if imu_from else 0)


def test_samples_of_an_imu_that_waits_long_for_the_lidar_are_recorded_in_one_unit(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "session.mcap")
    intake = Intake(Params())
    intake.recorder = recorder
    with LiveSource([], intake):
        for turn in range(150):
            put_samples(intake, turn, 1.0)
            if turn >= 130:
                intake.put_scan(scan(turn), sensor.START_NS + (turn + 1) * TURN_NS)
    with Source(recorder.path) as source:
        found = [message.linear_acceleration.z for _, _, message in source.messages((IMU_TOPIC,))]
    assert len(found) == 3000
    assert found == pytest.approx([9.80665] * 3000)


def put_samples(intake: Intake, turn: int, up: float) -> None:
    for k in range(20):
        stamp = sensor.START_NS + turn * TURN_NS + k * 5_000_000
        intake.put_imu(stamp, (0.0, 0.0, 0.001 * k), (0.0, 0.0, up), stamp)


def test_the_index_of_the_chunks_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the file itself has them, read from its beginning on."""
    monkeypatch.setattr(recorder_module, "FLUSH_S", 0.02)
    recorder = Recorder(tmp_path / "session.mcap")
    for turn in range(12):
        record(recorder, range(turn, turn + 1))
        time.sleep(0.05)
    recorder.close()
    with recorder.path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        file.seek(0)
        chunks = [one for one in StreamReader(file, emit_chunks=True).records if isinstance(one, Chunk)]
        assert len(chunks) > 3
        assert len(summary.chunk_indexes) == len(chunks)
        for index, chunk in zip(summary.chunk_indexes, chunks, strict=True):
            assert index.message_start_time == chunk.message_start_time
            assert index.message_end_time == chunk.message_end_time
            assert (index.compression, index.compressed_size) == (chunk.compression, len(chunk.data))
            for channel, at in index.message_index_offsets.items():
                file.seek(at)
                entry = next(StreamReader(file, skip_magic=True).records)
                assert isinstance(entry, MessageIndex)
                assert entry.channel_id == channel
        file.seek(0)
        assert sum(1 for _ in make_reader(file).iter_messages()) == 12 * 21


def test_a_killed_process_loses_less_than_its_last_second(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    script = f"""
        import sys, time
        from pathlib import Path
        from app.sensors.live.recorder import MAX_SCANS, Recorder
        from tests.sensors.live.test_recorder import record
        recorder = Recorder(Path({str(path)!r}))
        for turn in range(1000):
            record(recorder, range(turn, turn + 1))
            print(turn, flush=True)
            time.sleep(0.1)
    """
    root = Path(__file__).resolve().parents[3]
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script)], cwd=root, stdout=subprocess.PIPE, text=True
    )
    turn = 0
    try:
        assert process.stdout is not None
        deadline = time.monotonic() + 30.0
        while turn < 25 and time.monotonic() < deadline:
            turn = int(process.stdout.readline())
    finally:
        process.kill()
        process.wait(5.0)
        process.stdout.close()
    found = scans_before_the_end(path)
    assert turn - 11 <= len(found) <= turn + 1
    np.testing.assert_array_equal(found[-1].points, scan(len(found) - 1).points)


def scans_before_the_end(path: Path) -> list[Scan]:
    found = []
    with open_recording(path, Params()) as recording:
        assert any("cut off" in finding.text for finding in recording.findings)
        try:
            found += [m.scan for m in recording.measurements() if isinstance(m, Measurement)]
        except HemislamError:
            reading = recording.measurements()
            while len(found) < 10_000:
                try:
                    entry = next(reading)
                except (HemislamError, StopIteration):
                    break
                if isinstance(entry, Measurement):
                    found.append(entry.scan)
    return found


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "session.mcap")
    recorder._file.close()  # what comes next cannot be written
    record(recorder, range(3))
    recorder.close()
    assert "cannot be written any more" in recorder.failure


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(HemislamError, match="cannot be written"):
        Recorder(tmp_path / "file" / "session.mcap")


@pytest.mark.parametrize("name", ["walk.bag", "walk", "walk.mcap.zst"])
def test_a_name_that_could_not_be_opened_again_is_refused_before_anything_is_lost(tmp_path: Path, name: str) -> None:
    with pytest.raises(HemislamError, match=r"\.mcap"):
        Recorder(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_time_that_ros_has_no_number_for_is_left_out(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "session.mcap")
    record(recorder, range(3))
    recorder.add(ImuEntry(sensor.START_NS, 1 << 61, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
    recorder.close()
    assert (recorder.failure, recorder.left_out) == ("", 1)
    assert len(scans(recorder.path)) == 3


def test_a_disk_that_is_too_slow_costs_scans_of_the_recording_and_no_memory(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "session.mcap")
    recorder._write = lambda message: time.sleep(0.01)  # type: ignore[method-assign]
    one = scan(0)
    for number in range(MAX_SCANS + 50):
        recorder.add(ScanEntry(sensor.START_NS + number, None, one))
    assert recorder.left_out >= 1
    assert len(recorder._waiting) <= MAX_SCANS
    recorder._write = lambda message: None  # type: ignore[method-assign]
    recorder.close()


def test_scans_left_out_of_a_full_queue_do_not_count_as_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.sensors.live.recorder.MAX_SAMPLES", 50)
    recorder, stalled = Recorder(tmp_path / "session.mcap"), threading.Event()
    recorder._write = lambda message: stalled.wait(20.0)  # type: ignore[assignment,method-assign]
    for number in range(60):
        recorder.add(ImuEntry(number, number, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    for number in range(MAX_SCANS + 50):
        recorder.add(ScanEntry(sensor.START_NS + number, None, scan(0)))
    stalled.set()
    while recorder._waiting:
        time.sleep(0.01)
    before = recorder.left_out
    recorder.add(ScanEntry(sensor.START_NS, None, scan(0)))
    recorder.close()
    assert recorder.left_out == before, "the disk keeps up again"
