"""A capture of the sensor's packets works like any other recording."""

import functools
import random
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np
import pytest

from app.sensors.doctor import examine
from app.sensors.live.capture import CaptureStream
from app.sensors.live.frames import sensor_of
from app.sensors.live.imu_udp import ImuSample, write_airy_imu
from app.sensors.recording import open_recording
from app.sensors.robosense import BPEARL, BPV4
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors.live import captures, sensor

TURNS = 5
TURN_NS = 1801 * 55_520


def imu(number: int, stamp_ns: int) -> bytes:
    return struct.pack("<4sIq6d", b"HIMU", number, stamp_ns, 0.01 * number, 0, 0, 0, 0, 9.81)


@functools.lru_cache
def walk(*, host_ns: int = 0, imu_ns: int = 0) -> list[captures.Entry]:
    """What a network card sees of five turns. host_ns: its clock is ahead of the LiDAR's; imu_ns: the IMU's is."""
    entries = [(sensor.START_NS - 1_000, 7788, sensor.difop())]
    block = 12 * 55_520
    entries += [(sensor.START_NS + (k + 1) * block, 6699, packet) for k, packet in enumerate(sensor.turns(TURNS))]
    for number in range(-2, TURNS * 20 + 4):
        stamp = sensor.START_NS + number * 5_000_000
        entries.append((stamp + 300_000, 6700, imu(number + 2, stamp + imu_ns)))
    entries.append((sensor.START_NS + 5_000, 53, b"something else"))
    return sorted((time + host_ns, port, payload) for time, port, payload in entries)


def measurements(path: Path, start_s: float = 0.0) -> list[Measurement]:
    with open_recording(path, Params()) as recording:
        return [m for m in recording.measurements(start_s) if isinstance(m, Measurement)]


@pytest.mark.parametrize("shape", ["plain", "vlan", "double-vlan", "fragments", "ipv6", "raw", "cooked", "loopback"])
@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_every_shape_of_capture_gives_the_same_scans(tmp_path: Path, kind: str, shape: str) -> None:
    path = tmp_path / f"walk.{kind}"
    path.write_bytes((captures.pcap if kind == "pcap" else captures.pcapng)(walk(), shape))
    found = measurements(path)
    assert [round((m.scan.stamp_ns - sensor.START_NS) / TURN_NS) for m in found] == list(range(TURNS))
    for turn, m in enumerate(found):
        assert len(m.scan) == pytest.approx(1801 * 32, abs=13 * 32)
        assert m.scan.stamp_ns == pytest.approx(sensor.START_NS + turn * TURN_NS, abs=1_000)
        assert np.median(np.linalg.norm(m.scan.points - [0, 0, 0.094], axis=1)) == pytest.approx(
            5.0105 + 0.005 * turn, abs=0.002
        )
        stamps = m.imu.stamps_ns
        np.testing.assert_allclose(m.imu.gyro[:, 0], 0.01 * ((stamps - sensor.START_NS) / 5e6 + 2), atol=1e-9)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["ns", "us", "pcapng"])
def test_capture_times_are_read_in_every_unit_and_byte_order(tmp_path: Path, order: str, kind: str) -> None:
    path = tmp_path / "walk.pcap"
    entries = walk()
    if kind == "pcapng":
        path = tmp_path / "walk.pcapng"
        path.write_bytes(captures.pcapng(entries, order=order, exponent=6))
    else:
        path.write_bytes(captures.pcap(entries, order=order, nanoseconds=kind == "ns"))
    stream = CaptureStream(path)
    assert stream.start_ns == pytest.approx(entries[0][0] if entries[0][1] == 6700 else entries[1][0], abs=1_000)
    assert stream.end_ns == pytest.approx(entries[-1][0], abs=1_000)


@pytest.mark.parametrize("shape", ["plain", "fragments"])
def test_reading_begins_anywhere_as_if_it_had_gone_on(tmp_path: Path, shape: str) -> None:
    path = tmp_path / "walk.pcapng"
    path.write_bytes(captures.pcapng(walk(), shape))
    stream = CaptureStream(path)
    everything = list(stream.messages(("/rslidar_points", "/imu/data"), 0, 2**62))
    assert len(everything) == TURNS + TURNS * 20 + 6
    for at in range(0, len(everything), 7):
        start = everything[at][1]
        rest = list(stream.messages(("/rslidar_points", "/imu/data"), start, 2**62))
        expected = [entry for entry in everything if entry[1] >= start]
        assert [entry[:2] for entry in rest] == [entry[:2] for entry in expected]
        for one, other in zip(rest, expected, strict=True):
            assert one[2].header.stamp == other[2].header.stamp
            if one[0] == "/rslidar_points":
                np.testing.assert_array_equal(one[2].data, other[2].data)


def test_a_recordings_place_is_taken_up_again(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(walk(), "vlan"))
    with open_recording(path, Params()) as recording:
        reading = recording.measurements()
        for _ in range(3):
            next(reading)
        place = reading.place()
        rest = list(reading)
        again = list(recording.measurements(after=place))
    assert len(rest) == len(again) == TURNS - 3
    for one, other in zip(rest, again, strict=True):
        assert isinstance(one, Measurement) and isinstance(other, Measurement)
        np.testing.assert_array_equal(one.scan.points, other.scan.points)
        np.testing.assert_array_equal(one.imu.stamps_ns, other.imu.stamps_ns)


def test_sensors_whose_clocks_disagree_are_put_on_the_captures(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(walk(host_ns=40 * 10**9, imu_ns=40 * 10**9)))
    found = measurements(path)
    assert len(found) >= TURNS - 1
    for m in found:
        turn = round((m.scan.stamp_ns - 40e9 - sensor.START_NS) / TURN_NS)
        assert m.scan.stamp_ns == pytest.approx(sensor.START_NS + 40 * 10**9 + turn * TURN_NS, abs=5e6)
    text = next(f.text for f in examine(path, Params()) if f.subject == "sensor clocks")
    assert "40.00" in text and "ahead of" in text


def test_of_two_imus_only_the_one_beside_the_sensor_is_read(tmp_path: Path) -> None:
    """An Airy sends samples of its own; merged with those of another IMU they would be the motion of neither."""
    sample = ImuSample(0, sensor.START_NS, (9.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    own = [
        (time - 400_000, 6688, write_airy_imu(replace(sample, number=k, stamp_ns=time - 400_000)))
        for k, (time, port, _) in enumerate(walk())
        if port == 6700
    ]
    found = {}
    for name, entries in (("one", walk()), ("two", sorted([*own, *walk()]))):
        (tmp_path / f"{name}.pcap").write_bytes(captures.pcap(entries))
        found[name] = measurements(tmp_path / f"{name}.pcap")
    for one, two in zip(found["one"], found["two"], strict=True):
        np.testing.assert_array_equal(one.imu.stamps_ns, two.imu.stamps_ns)
        np.testing.assert_array_equal(one.imu.gyro, two.imu.gyro)
    findings = {f.subject: f.text for f in CaptureStream(tmp_path / "two.pcap").findings}
    assert "own IMU are left out" in findings["IMU"] and f"{len(own)} imu foreign" in findings["packets"]
    assert "IMU" not in {f.subject for f in CaptureStream(tmp_path / "one.pcap").findings}


@pytest.mark.parametrize("shape", ["plain", "fragments", "ipv6"])
def test_of_two_lidars_only_one_is_read_with_its_own_imu_and_the_other_is_reported(tmp_path: Path, shape: str) -> None:
    """The other sees 10 m where this one sees 5 m and has other angles; it is the first to send, but sends less."""
    sample = ImuSample(0, sensor.START_NS, (9.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    block = 12 * 55_520
    others: list[captures.Entry] = [(0, 7788, sensor.difop(angles=[(e - 0.5, 0.0) for e in sensor.ELEVATIONS]))]
    others += [(1, 6699, sensor.turns(TURNS, distance=2000)[0])]
    others += [
        (sensor.START_NS + (k + 1) * block + 40_000, 6699, packet)
        for k, packet in enumerate(sensor.turns(TURNS, distance=2000, start_ns=sensor.START_NS + 40_000))
        if k % 10
    ]
    others += [
        (time - 400_000, 6688, write_airy_imu(replace(sample, number=k, stamp_ns=time - 400_000)))
        for k, (time, port, _) in enumerate(walk())
        if port == 6700
    ]
    found = {}
    for name, second in (("one", []), ("two", others)):
        (tmp_path / f"{name}.pcap").write_bytes(captures.pcap(walk(), shape, others=second))
        found[name] = measurements(tmp_path / f"{name}.pcap")
    assert len(found["one"]) == len(found["two"]) == TURNS
    for one, two in zip(found["one"], found["two"], strict=True):
        np.testing.assert_array_equal(one.scan.points, two.scan.points)
        np.testing.assert_array_equal(one.imu.stamps_ns, two.imu.stamps_ns)
        np.testing.assert_array_equal(one.imu.gyro, two.imu.gyro)
    findings = {f.subject: f for f in examine(tmp_path / "two.pcap", Params())}
    used, other = ("::c8", "::c9") if shape == "ipv6" else ("192.168.1.200", "192.168.1.201")
    assert findings["LiDARs"].verdict == "needs you"
    for words in (f"only {used} is read", f"{other} left out", f"not src host {used}"):
        assert words in findings["LiDARs"].text
    assert f"{len(others) + 1} foreign" in findings["packets"].text  # and one of `walk`
    assert "LiDARs" not in {f.subject for f in examine(tmp_path / "one.pcap", Params())}


def test_an_imu_beside_the_lidar_may_send_from_another_address(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcap"
    lidar = [entry for entry in walk() if entry[1] != 6700]
    path.write_bytes(captures.pcap(lidar, others=[entry for entry in walk() if entry[1] == 6700]))
    assert len(measurements(path)) == TURNS
    assert "LiDARs" not in {f.subject for f in CaptureStream(path).findings}


def test_a_clock_set_on_the_way_does_not_end_the_recording(tmp_path: Path) -> None:
    half = TURNS // 2 * TURN_NS
    entries = walk()
    shifted = []
    for time, port, payload in entries:
        if time > sensor.START_NS + half and port == 6700:
            number, stamp = struct.unpack_from("<Iq", payload, 4)
            payload = imu(number, stamp - 3600 * 10**9)
        shifted.append((time, port, payload))
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(shifted))
    assert len(measurements(path)) == TURNS


def test_a_lidar_that_finds_its_time_server_on_the_way_belongs_to_its_imu_before_and_after(tmp_path: Path) -> None:
    block_ns, boot_ns = 12 * 55_520, sensor.START_NS - 26 * 365 * 86_400 * 10**9
    packets = [*sensor.turns(2, start_ns=boot_ns), *sensor.turns(4, start_ns=sensor.START_NS + 2 * TURN_NS)]
    entries = [(sensor.START_NS + (k + 1) * block_ns, 6699, packet) for k, packet in enumerate(packets)]
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(sorted([*entries, *(entry for entry in walk() if entry[1] == 6700)])))
    found = measurements(path)
    assert len(found) >= 4
    for m in found:
        turn = round((m.scan.stamp_ns - sensor.START_NS) / TURN_NS)
        assert m.scan.stamp_ns == pytest.approx(sensor.START_NS + turn * TURN_NS, abs=5e6)


@pytest.mark.parametrize("imu_goes_on", [True, False])
def test_a_silence_within_a_revolution_is_no_clock_that_was_set(tmp_path: Path, imu_goes_on: bool) -> None:
    """As when a cable comes off. What is left of the revolution is not logged when the next one comes."""
    begins_ns = [sensor.START_NS, sensor.START_NS + 4_000_000_000]
    lidar = [sensor.turns(20, start_ns=begin_ns) for begin_ns in begins_ns]
    per_turn, block_ns = len(lidar[0]) / 20, 12 * 55_520
    lidar[0] = lidar[0][: round(12.5 * per_turn)]
    entries = [
        (begin_ns + (k + 1) * block_ns, 6699, packet)
        for begin_ns, packets in zip(begins_ns, lidar, strict=True)
        for k, packet in enumerate(packets)
    ]
    for number in range(1200):
        stamp = sensor.START_NS + number * 5_000_000
        if imu_goes_on or not len(lidar[0]) * block_ns < stamp - sensor.START_NS < 4_000_000_000:
            entries.append((stamp + 300_000, 6700, imu(number, stamp)))
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(sorted(entries)))
    with open_recording(path, Params()) as recording:
        assert not {"sensor clocks", "clock leap"} & {finding.subject for finding in recording.findings}
        stamps = [m.scan.stamp_ns for m in recording.measurements() if isinstance(m, Measurement)]
    expected = [begins_ns[0] + k * TURN_NS for k in range(13)] + [begins_ns[1] + k * TURN_NS for k in range(20)]
    np.testing.assert_allclose(np.array(stamps) - sensor.START_NS, np.array(expected) - sensor.START_NS, atol=1_000)


@pytest.mark.parametrize("at", [0, 1, 500, -1])
@pytest.mark.parametrize("wild_ns", [1_000_000_000, 2_208_988_800_000_000_000])
def test_a_single_wild_log_time_spoils_no_other(tmp_path: Path, at: int, wild_ns: int) -> None:
    """1970, as of a recorder without a clock, or 2040."""
    entries = sorted(walk())
    (tmp_path / "whole.pcap").write_bytes(captures.pcap(entries))
    entries[at] = (wild_ns, *entries[at][1:])
    (tmp_path / "wild.pcap").write_bytes(captures.pcap(entries))
    topics = ("/rslidar_points", "/imu/data")
    whole, wild = (list(CaptureStream(tmp_path / f"{n}.pcap").messages(topics, 0, 2**62)) for n in ("whole", "wild"))
    assert len(whole) == len(wild)
    assert max(abs(one[1] - other[1]) for one, other in zip(whole, wild, strict=True)) < 10_000_000
    stream = CaptureStream(tmp_path / "wild.pcap")
    assert stream.end_ns - stream.start_ns == pytest.approx(whole[-1][1] - whole[0][1], abs=10_000_000)
    start = wild[len(wild) // 2][1]
    rest = [entry[:2] for entry in stream.messages(topics, start, 2**62)]
    assert rest == [entry[:2] for entry in wild if entry[1] >= start]


def test_a_clock_that_leaps_over_all_of_time_leaves_stamps_that_integers_hold(tmp_path: Path) -> None:
    """Both leaps fall into one moment of the capture, so that all of their samples get the shift of the last."""
    at = sensor.START_NS + 3 * TURN_NS + 1_000_000
    last = 2 + (at - sensor.START_NS) // 5_000_000
    entries = [entry for entry in walk() if entry[1] != 6700 or entry[0] < at]
    leaps = [2**62 - 2, 2**62 - 1, 2 - 2**62, 3 - 2**62]
    entries += [(at, 6700, imu(last + 1 + k, stamp)) for k, stamp in enumerate(leaps)]
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(sorted(entries)))
    assert len(measurements(path)) >= 2


def test_a_file_cut_off_is_used_up_to_there(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcap"
    whole = captures.pcap(walk())
    path.write_bytes(whole[: len(whole) // 2])
    assert 2 <= len(measurements(path)) < TURNS - 1
    findings = examine(path, Params())
    assert any("cut off" in finding.text for finding in findings)


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
@pytest.mark.parametrize("most", [96, 200])
def test_packets_that_are_not_captured_whole_are_named(tmp_path: Path, kind: str, most: int) -> None:
    """200 bytes hold the IMU's."""
    path = tmp_path / f"walk.{kind}"
    path.write_bytes((captures.pcap if kind == "pcap" else captures.pcapng)(walk(), most=most))
    with pytest.raises(HemislamError, match="only the beginning of each packet; capture them whole"):
        open_recording(path, Params())


def test_other_files_are_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "x.pcap"
    for content, words in (
        (b"hello", "is not a network capture"),
        (captures.pcap([(1, 53, b"dns")]), "holds no packets"),
    ):
        path.write_bytes(content)
        with pytest.raises(HemislamError, match=words):
            open_recording(path, Params())
    path.write_bytes(b"")
    with pytest.raises(HemislamError, match="is empty"):
        open_recording(path, Params())


OTHERS = [
    ("55aa050a5aa550a0", {30: 1, 31: 0, 32: 0}, "an RS-LiDAR-16"),
    ("55aa050a5aa550a0", {30: 2, 31: 0, 32: 0}, "an RS-LiDAR-32"),
    ("55aa050a5aa550a0", {30: 0, 31: 2, 32: 1}, "an RS-LiDAR-32"),
    ("55aa055a00000000", {30: 0, 31: 5, 32: 0}, "another RoboSense, of type 0x05"),
]
"""Sensors with blocks like an RS-Bpearl's: mark, bytes of the header, and name."""


def stating(mark: str, header: dict[int, int], packets: Iterable[bytes]) -> Iterator[bytes]:
    for packet in packets:
        changed = bytearray(bytes.fromhex(mark) + packet[8:])
        for at, value in header.items():
            changed[at] = value
        yield bytes(changed)


@pytest.mark.parametrize(("mark", "header", "name"), OTHERS)
def test_packets_of_another_robosense_are_refused_by_its_name(
    tmp_path: Path, mark: str, header: dict[int, int], name: str
) -> None:
    path = tmp_path / "walk.pcap"
    changed = stating(mark, header, sensor.turns(2))
    entries = [entry for entry in walk() if entry[1] == 6700]
    entries += [(sensor.START_NS + k * 12 * 55_520, 6699, packet) for k, packet in enumerate(changed)]
    path.write_bytes(captures.pcap(entries))
    for opened in (open_recording, examine):
        with pytest.raises(HemislamError, match=f"holds packets of {name}, which are not read; record"):
            opened(path, Params())


@pytest.mark.parametrize("types", [(0, 3, 1), (3, 0, 0), (3, 2, 0), (1, 3, 4), (0, 0, 0), (7, 9, 200)])
def test_an_rs_bpearl_is_read_wherever_it_states_its_type_or_if_it_states_none(types: tuple[int, int, int]) -> None:
    header = dict(zip((30, 31, 32), types, strict=True))
    for packet in stating("55aa050a5aa550a0", header, sensor.turns(1)):
        assert sensor_of(packet) is (BPV4 if types[1:] == (3, 4) else BPEARL)


def test_angles_beside_the_capture_win(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcap"
    path.write_bytes(captures.pcap(walk()))
    (tmp_path / "walk.angles.csv").write_text("".join(f"{e - 0.5:.2f},0\n" for e in sensor.ELEVATIONS))
    text = next(finding.text for finding in examine(path, Params()) if finding.subject == "angles")
    assert "walk.angles.csv" in text
    scan = measurements(path)[0].scan
    lowest = scan.points[scan.ring == 0]
    tilt = np.degrees(np.arctan2(lowest[:, 2] - 0.09427, np.hypot(lowest[:, 0], lowest[:, 1]) - 0.01473))
    assert np.median(tilt) == pytest.approx(2.3125 - 0.5, abs=0.01)


def test_a_capture_of_countless_interfaces_is_read_at_once(tmp_path: Path) -> None:
    path = tmp_path / "walk.pcapng"
    whole = captures.pcapng(walk())
    interface = struct.pack("<IIHHII", 1, 20, 1, 0, 0, 20)
    path.write_bytes(whole + interface * 100_000)
    began = monotonic()
    assert len(measurements(path)) == TURNS
    assert monotonic() - began < 30.0  # a minute and more if each took as long as all before it


def test_a_damaged_capture_is_read_or_refused_but_never_crashes(tmp_path: Path) -> None:
    rng = random.Random(0)
    entries = walk()[::3]
    wholes = [captures.pcap(entries, "fragments"), captures.pcapng(entries, "vlan")]
    for number in range(60):
        data = bytearray(wholes[number % 2])
        for _ in range(rng.randrange(1, 60)):
            data[rng.randrange(len(data) if number % 3 else 2_000)] = rng.randrange(256)
        path = tmp_path / ("x.pcap" if number % 2 == 0 else "x.pcapng")
        path.write_bytes(bytes(data[: rng.randrange(1_000, len(data))]))
        try:
            found = measurements(path)
        except HemislamError:
            continue
        assert all(np.isfinite(m.scan.points).all() for m in found)
