"""Packets of a Mid-360 and of an Airy: their meaning by the makers' tables, and a walk sent as such packets.

Tests app/sensors/live/devices.py, app/sensors/live/livox_udp.py, app/sensors/live/cloud_reader.py.
"""

import math
import select
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from app.sensors.cloud_types import read_custom_msg
from app.sensors.live import livox_udp
from app.sensors.live.decoder import Decoder
from app.sensors.live.devices import DEVICES, device_of
from app.sensors.live.difop import read_angles, read_difop
from app.sensors.live.feed import Pace, feed, packets_of
from app.sensors.live.frames import Assembler
from app.sensors.live.imu_udp import ImuSample, read_imu, write_airy_imu
from app.sensors.live.intake import Intake
from app.sensors.live.status import Status
from app.sensors.live.udp import PacketReceiver
from app.sensors.live.urls import open_live, parse_address
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.robosense import AIRY
from app.sensors.simulator import simulate
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F64, I64, Measurement, Scan
from tests.sensors.live import captures, ports

START_NS = 1_772_366_400 * 10**9
GROUPS_US = [0.0, 7.616, 16.184, 24.752, 33.32, 42.84, 52.36, 61.88, 71.4, 79.968, 88.536, 97.104]
SECONDS = 5.0


def utc(stamp_ns: int) -> bytes:
    us = stamp_ns // 1000
    return struct.pack(">HII", us // 10**6 >> 32, us // 10**6 & 0xFFFFFFFF, us % 10**6)


def airy_msop(stamp_ns: int, azimuths: list[int], distance: int) -> bytes:
    """A packet by the manual's table 9 and 10; the flag bits are set, the intensity is the channel."""
    head = bytes.fromhex("55aa055a") + bytes(8) + struct.pack(">I", 7) + bytes(4) + utc(stamp_ns)
    body = b""
    for azimuth in azimuths:
        for half in (0, 48):
            body += b"\xff\xee" + struct.pack(">H", azimuth)
            body += b"".join(struct.pack(">HB", 0xC000 | distance, half + channel) for channel in range(48))
    packet = head + b"\0\x31\x02" + bytes(9) + body + bytes(22)
    assert len(packet) == 1248
    return packet


def airy_difop(elevations: F64, aside: F64, pose: tuple[float, ...]) -> bytes:
    packet = bytearray(1248)
    packet[:10] = bytes.fromhex("a5ff005a11115555") + struct.pack(">H", 600)
    for channel, pair in enumerate(zip(elevations, aside, strict=True)):
        for at, angle in zip((468, 756), pair, strict=True):
            struct.pack_into(">BH", packet, at + 3 * channel, bool(angle < 0), round(abs(angle) * 100))
    struct.pack_into(">7f", packet, 1092, *pose)
    return bytes(packet)


def livox(kind: int, count: int, body: bytes, stamp_ns: int, duration: int = 4800) -> bytes:
    """A datagram by the struct of Livox-SDK2."""
    head = struct.pack("<BHHHHBBB12x", 0, 36 + len(body), duration, count, 5, 0, kind, 0)
    tail = struct.pack("<Q", stamp_ns) + body
    return head + struct.pack("<I", zlib.crc32(tail)) + tail


def test_an_airys_firing_is_where_its_driver_puts_it() -> None:
    elevations, aside = np.round(np.linspace(-0.07, 89.5, 96), 2), np.round(np.linspace(-1.7, 1.2, 96), 2)
    device = airy_difop(elevations, aside, (-0.70629, 0.707913, -0.0037, 0.00063, 0.00425, 0.00418, -0.00446))
    decoder, assembler = Decoder(model=AIRY), Assembler()
    said = read_difop(device, AIRY)
    assert said is not None and said.rpm == 600
    decoder.configure(said)
    packets = [airy_msop(START_NS + k * 444_320, [160 * k + 40 * n for n in range(4)], 1000) for k in range(20)]
    frames = [frame for packet in packets for frame in assembler.add(packet, 0)] + list(assembler.flush())
    (scan,) = [decoder.decode(frame) for frame in frames]
    assert isinstance(scan, Scan) and len(scan) == 20 * 4 * 96
    assert scan.stamp_ns == START_NS
    for index in range(0, len(scan), 37):
        block, channel = divmod(index, 96)
        us = GROUPS_US[channel // 8]
        turned = 0.4 * (block + us / 111.08)
        e, a, lens = map(math.radians, (elevations[channel], turned + aside[channel], turned))
        flat, lever = 5.0 * math.cos(e), math.hypot(0.0108, 0.00375)
        truth = (
            flat * math.cos(a) + lever * math.cos(lens),
            -flat * math.sin(a) - lever * math.sin(lens),
            5.0 * math.sin(e) + 0.06056,
        )
        np.testing.assert_allclose(scan.points[index], truth, atol=2e-4)
        assert scan.offsets_ns[index] == pytest.approx(block * 111_080 + us * 1000, abs=1_001)
        assert scan.intensity[index] == channel and scan.ring[index] == channel


def test_an_airy_states_where_its_lidar_is_on_its_imu() -> None:
    pose = (-0.70629, 0.707913, -0.0037, 0.00063, 0.00425, 0.00418, -0.00446)
    said = read_difop(airy_difop(np.arange(96.0) * 0.9, np.zeros(96), pose), AIRY)
    assert said is not None and said.T_imu_lidar is not None
    of_imu = Rotation.from_quat(pose[:4])
    np.testing.assert_allclose(said.T_imu_lidar[:3, :3], of_imu.inv().as_matrix(), atol=1e-6)
    np.testing.assert_allclose(said.T_imu_lidar[:3, 3], -of_imu.inv().apply(pose[4:]), atol=1e-7)
    for nonsense in ((0.0,) * 7, (math.nan,) * 7, (0.0, 0.0, 0.0, 1.0, 50.0, 0.0, 0.0)):
        found = read_difop(airy_difop(np.arange(96.0) * 0.9, np.zeros(96), nonsense), AIRY)
        assert found is not None and found.T_imu_lidar is None


def test_an_airys_imu_counts_are_of_its_ranges() -> None:
    body = struct.pack(">6i", 0, -16_384, 8192, 32_768, 0, -100) + bytes(4) + bytes([3, 1, 2])
    (sample,) = read_imu(bytes.fromhex("aa555a05") + utc(START_NS) + body + struct.pack(">I", 9) + b"\xf0\x0f")
    assert (sample.number, sample.stamp_ns) == (9, START_NS)
    np.testing.assert_allclose(sample.accel, [0.0, -2 * 9.80665, 9.80665], rtol=1e-12)
    np.testing.assert_allclose(sample.gyro, np.radians([1000.0, 0.0, -100 / 32_768 * 1000]), rtol=1e-12)


@pytest.mark.parametrize(("kind", "layout", "unit"), [(1, "<3iBB", 1000), (2, "<3hBB", 100)])
def test_a_mid360s_points_are_metres_at_even_times(kind: int, layout: str, unit: int) -> None:
    places = [(1.5, -2.0, 0.25), (0.0, 0.0, 0.0), (3.0, 4.0, 5.0), (6.0, 7.0, 8.0)]
    tags = [0x10, 0x10, 0x30, 0x00]
    body = b"".join(
        struct.pack(layout, *(round(x * unit) for x in place), 40 + k, tag)
        for k, (place, tag) in enumerate(zip(places, tags, strict=True))
    )
    packet = livox(kind, 4, body, START_NS, duration=200)
    assembler = Assembler()
    assembler.add(packet, 0)
    (frame,) = assembler.flush()
    message = livox_udp.read_points(frame.packets)
    points = read_custom_msg(message).xyz()
    np.testing.assert_allclose(points[[0, 3]], np.array(places)[[0, 3]], rtol=1e-6)
    assert not points[[1, 2]].any()  # nothing came back; a doubtful return
    assert message.points["offset_time"].tolist() == [0, 5_000, 10_000, 15_000]
    assert message.points["reflectivity"].tolist() == [40, 41, 42, 43]


def test_a_mid360s_imu_is_in_g_and_rad_per_second() -> None:
    (sample,) = read_imu(livox(0, 1, struct.pack("<6f", 0.1, -0.2, 0.3, 0.0, 0.0, 1.0), START_NS))
    assert sample.stamp_ns == START_NS
    np.testing.assert_allclose(sample.gyro, [0.1, -0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(sample.accel, [0.0, 0.0, 9.80665], rtol=1e-6)
    assert read_imu(livox(0, 1, struct.pack("<6f", math.nan, *[0.0] * 5), START_NS)) == []


def test_a_datagram_whose_lengths_disagree_is_no_livox() -> None:
    good = livox(1, 2, bytes(28), START_NS)
    assert device_of([b"else", good]) is DEVICES["mid360"]
    for bad in (good[:-1], good + b"\0", livox(1, 3, bytes(28), START_NS), livox(7, 2, bytes(28), START_NS), good[:20]):
        assert device_of([bad]) is None


def test_a_scan_of_a_mid360_ends_with_each_tenth_of_a_second() -> None:
    assembler = Assembler()
    body = struct.pack("<3iBB", 1000, 0, 0, 1, 16) * 96
    packets = [livox(1, 96, body, START_NS + 50_000_000 + k * 480_000) for k in range(700)]
    frames = [frame for packet in packets for frame in assembler.add(packet, 0)]
    starts = [int(frame.stamps_ns[0]) - START_NS for frame in frames]
    assert [start // 100_000_000 for start in starts] == [0, 1, 2]
    assert all(start % 100_000_000 < 480_000 for start in starts[1:])
    assert assembler.counters.lost == assembler.counters.late == 0


def received(scheme: str, packets: list[bytes], wanted: Callable[[Intake], bool]) -> Intake:
    """What a receiver makes of packets that come by UDP, once it has what is wanted, or after ten seconds."""
    (port,), intake, stop = ports.free(1), Intake(Params()), threading.Event()
    receiver = PacketReceiver(intake, DEVICES[scheme], "127.0.0.1", (port,), own_imu=True)
    thread = threading.Thread(target=receiver, args=(stop,))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet in packets:
            sender.sendto(packet, ("127.0.0.1", port))
    thread.start()
    until = time.monotonic() + 10.0
    while time.monotonic() < until and not wanted(intake):
        time.sleep(0.02)
    stop.set()
    thread.join()
    return intake


def airy_stating(kind: int, model: int) -> bytes:
    packet = airy_msop(START_NS, [0, 40, 80, 120], 1000)
    return packet[:31] + bytes([kind, model]) + packet[33:]


@pytest.mark.parametrize(("model", "channels"), [(1, 48), (3, 192)])
def test_an_airy_of_other_than_96_channels_is_left_out_and_reported_once(model: int, channels: int) -> None:
    packets = [airy_stating(0x31, model)] * 3
    intake = received("airy", packets, lambda intake: intake.counters.foreign == 3)
    told = [entry.text for entry in intake.take(0.0, scan=False)[0] if isinstance(entry, Status)]
    assert told == [
        f"127.0.0.1 is an Airy of {channels} channels, whose packets are not read; take its clouds from ROS, by foxglove://"
    ]
    assert intake.counters.foreign == 3 and not intake.counters.truncated and not intake.counters.packets


def test_an_airy_is_known_by_its_blocks_if_not_by_its_type() -> None:
    for kind, model in ((0x31, 2), (0x31, 0), (0, 0), (0x32, 2)):
        assert device_of([airy_stating(kind, model)]) is DEVICES["airy"]
    damaged = bytearray(airy_stating(0x31, 2))
    damaged[190] = 0
    assert device_of([bytes(damaged)]) is DEVICES["airy"]


def test_a_mid360_that_sees_nothing_is_reported() -> None:
    packets = [livox(1, 96, bytes(96 * 14), START_NS + k * 100_000_000) for k in range(103)]
    intake = received("mid360", packets, lambda intake: intake.counters.unreadable > 0)
    told = [entry.text for entry in intake.take(0.0, scan=False)[0] if isinstance(entry, Status)]
    assert any("has a usable point; check the LiDAR" in text for text in told)


def test_imu_samples_behind_a_lost_one_do_not_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[int] = []
    monkeypatch.setattr(Intake, "put_imu", lambda self, stamp_ns, *rest: heard.append(stamp_ns))
    packets = [write_airy_imu(ImuSample(k, START_NS + k * 5_000_000, (0, 0, 0), (0, 0, 9.8))) for k in (0, 1, 3, 4)]
    received("airy", packets, lambda intake: len(heard) == 4)
    assert heard == [START_NS + k * 5_000_000 for k in (0, 1, 3, 4)]


def test_the_last_points_before_a_silence_are_given_while_the_imu_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.sensors.live.udp._REST_NS", 100_000_000)
    really = select.select
    monkeypatch.setattr(select, "select", lambda of, *_: (really(of, [], [], 0.01)[0] or [of[1]], [], []))  # the IMU
    numbers, intake, stop = ports.free(2), Intake(Params()), threading.Event()
    receiver = PacketReceiver(intake, DEVICES["mid360"], "127.0.0.1", tuple(numbers), own_imu=True)
    thread = threading.Thread(target=receiver, args=(stop,))
    thread.start()
    body = struct.pack("<3iBB", 1000, 0, 0, 1, 16) * 96
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(5):
            sender.sendto(livox(1, 96, body, START_NS + k * 480_000), ("127.0.0.1", numbers[0]))
    until = time.monotonic() + 2.0
    while time.monotonic() < until and not intake.counters.frames:
        time.sleep(0.02)
    stop.set()
    thread.join()
    assert intake.counters.packets == 5 and intake.counters.frames == 1


def test_angles_of_another_sensor_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "angles.csv"
    path.write_text("".join(f"{0.9 * k},0\n" for k in range(96)))
    with pytest.raises(HemislamError, match="96 channels, but an RS-Bpearl has 32"):
        Decoder(read_angles(path))


@pytest.fixture(scope="module")
def walks(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Params]]:
    """By the scheme of its packets: a recording, and its parameters."""
    hall = shared_data / "hall_mid360.mcap"
    room = tmp_path_factory.mktemp("airy") / "room.mcap"
    simulate("room", room, duration_s=SECONDS, every_block=6, scanner="airy")
    return {
        "mid360": (hall, resolve_params(hall, "mid360", None, [])),
        "airy": (room, resolve_params(room, None, None, [])),
    }


def sent(path: Path, params: Params, scheme: str) -> list[captures.Entry]:
    pose = np.eye(4)
    with open_recording(path, params) as recording:
        sending = packets_of(recording, SECONDS, DEVICES[scheme].model, pose=pose)
        return [
            (one.time_ns, DEVICES[scheme].ports[-1 if one.stream == 2 else one.stream], one.data) for one in sending
        ]


def walked(found: list[Measurement], params: Params) -> tuple[I64, F64]:
    """Ends of scans (n,), ns, and positions of the IMU (n, 3), m."""
    engine = Engine(params)
    results = [engine.step(one.scan, one.imu) for one in found]
    engine.close()
    return np.array([r.stamp_ns for r in results]), np.array([r.state.p_odom_imu for r in results])


def read(path: Path, params: Params) -> list[Measurement]:
    with open_recording(path, params) as recording:
        return [one for one in recording.measurements(0.0, SECONDS) if isinstance(one, Measurement)]


def apart(one: tuple[I64, F64], other: tuple[I64, F64]) -> float:
    """m, the largest distance at the times of one, between those of the other."""
    begin = other[0][0]
    spline = CubicSpline((other[0] - begin) * 1e-9, other[1])
    inside = (one[0] > other[0][0]) & (one[0] < other[0][-1])
    assert np.count_nonzero(inside) > 8 * SECONDS - 10
    return float(np.linalg.norm(one[1][inside] - spline((one[0][inside] - begin) * 1e-9), axis=1).max())


@pytest.mark.parametrize("scheme", ["mid360", "airy"])
def test_a_capture_gives_the_recordings_trajectory_even_if_a_hundredth_is_lost(
    scheme: str, walks: dict[str, tuple[Path, Params]], tmp_path: Path
) -> None:
    path, params = walks[scheme]
    entries = sent(path, params, scheme)
    truth = walked(read(path, params), params)
    assert np.ptp(truth[1], axis=0).max() > 0.5
    kept = np.random.default_rng(0).random(len(entries)) > 0.01
    for name, share in (("whole", entries), ("lossy", [e for e, keep in zip(entries, kept, strict=True) if keep])):
        capture = tmp_path / f"{name}.pcap"
        capture.write_bytes(captures.pcap(share))
        found = read(capture, params)
        assert apart(walked(found, params), truth) < (0.003 if name == "whole" else 0.01)
    with open_recording(tmp_path / "whole.pcap", Params()) as recording:
        assert any(f"--preset {scheme}" in finding.option for finding in recording.findings)
        assert (scheme == "airy") == any(finding.subject == "unit's mount" for finding in recording.findings)


@pytest.mark.parametrize("scheme", ["mid360", "airy"])
def test_live_packets_give_the_recordings_trajectory(scheme: str, walks: dict[str, tuple[Path, Params]]) -> None:
    path, params = walks[scheme]
    url = f"{scheme}://127.0.0.1:{','.join(map(str, ports.free(len(DEVICES[scheme].ports))))}"
    stop = threading.Event()
    player = threading.Thread(
        target=feed, args=(path, params, parse_address(url)), kwargs={"pace": Pace(1.0, stop), "duration_s": SECONDS}
    )
    wanted = int(10 * SECONDS) - 3
    with open_live(url, params) as source:
        player.start()
        try:
            events = ports.collect(source, lambda e: len(ports.measurements(e)) >= wanted, 60.0)
        finally:
            stop.set()
            player.join()
        counters = source.state().counters
    assert counters.imu > 0 and counters.foreign == 0
    assert apart(walked(ports.measurements(events), params), walked(read(path, params), params)) < 0.003
