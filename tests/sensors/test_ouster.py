"""Tests app/sensors/ouster.py: packets of an Ouster, decoded as its own library decodes them.

`ouster_sdk.json` holds the output of ouster-sdk 1.0.1 for the captures in ../shared/data/sensors/ouster: for each scan
and return, the number of points, their sum and every fortieth point (index, x, y, z in the sensor's frame, time,
reflectivity, row), and all IMU samples (time, rad/s, m/s²).
"""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.sensors.cloud_types import read_point_cloud_2
from app.sensors.doctor import examine
from app.sensors.live.pcap import Capture
from app.sensors.ouster import IMU_TOPIC, LATE, LIDAR_TOPIC, OusterStream, Turns, metadata_beside
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.ros import stamp_ns
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors.live import captures

SDK: dict[str, Any] = json.loads(Path(__file__).with_name("ouster_sdk.json").read_text())


@pytest.mark.parametrize("name", SDK)
def test_every_point_and_sample_is_that_of_ousters_library(name: str, shared_data: Path) -> None:
    path = shared_data / "sensors" / "ouster" / f"{name}.pcap"
    metadata = metadata_beside(path)
    assert metadata is not None
    stream, wanted = OusterStream(path, metadata), SDK[name]
    messages = list(stream.messages((LIDAR_TOPIC, IMU_TOPIC), 0, 2**62))
    T = np.array(wanted["lidar_to_sensor"]).reshape(4, 4) * [[1, 1, 1, 0.001]] * 1.0
    returns = iter(wanted["returns"])
    for _, _, message in (one for one in messages if one[0] == LIDAR_TOPIC):
        cloud, begin = read_point_cloud_2(message), stamp_ns(message.header.stamp)
        points, at = cloud.xyz().astype(np.float64) @ T[:3, :3].T + T[:3, 3], 0
        while at < len(points):
            part = next(returns)
            mine = points[at : at + part["points"]]
            np.testing.assert_allclose(mine.sum(axis=0), part["sum"], atol=0.5)  # of 100,000 roundings to float32
            for index, x, y, z, time_ns, reflectivity, row in part["picked"]:
                np.testing.assert_allclose(mine[index], (x, y, z), atol=2e-5)
                assert begin + int(cloud.column("t")[at + index]) == time_ns
                assert cloud.column("reflectivity")[at + index] == reflectivity
                assert cloud.column("ring")[at + index] == row
            at += part["points"]
        assert at == len(points)
    assert next(returns, None) is None
    samples = [message for topic, _, message in messages if topic == IMU_TOPIC]
    assert len(samples) == len(wanted["imu"])
    for sample, (time_ns, *values) in zip(samples, wanted["imu"], strict=True):
        assert stamp_ns(sample.header.stamp) == time_ns
        w, a = sample.angular_velocity, sample.linear_acceleration
        np.testing.assert_allclose([w.x, w.y, w.z, a.x, a.y, a.z], values, atol=1e-5)


def test_a_real_capture_is_recognised_and_gives_scans(shared_data: Path) -> None:
    path = shared_data / "sensors" / "ouster" / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
    findings = examine(path, Params())
    assert any("--preset ouster" in finding.option for finding in findings)
    with open_recording(path, resolve_params(path, "ouster", None, [])) as recording:
        found = [one for one in recording.measurements() if isinstance(one, Measurement)]
    assert found and all(len(one.scan) > 100_000 for one in found)
    assert 0.09e9 < found[0].scan.offsets_ns.max() < 0.11e9


ANGLES = [20.0, 0.0, -15.0, -22.0]
AZIMUTHS = [3.0, -1.0, 1.0, -3.0]
PROFILES = {"LEGACY": (0, 16, 4, 0), "RNG19_RFL8_SIG16_NIR16": (32, 12, 0, 32)}


def made(profile: str, folder: Path, **changed: object) -> Path:
    """A capture of four turns of 32 columns by a sensor of four beams; every range is 5 m plus a cm a row."""
    header, column_header, end, footer = PROFILES.get(profile, PROFILES["LEGACY"])
    entries: list[captures.Entry] = []
    for number in range(8):
        packet = struct.pack("<HH", 1, number // 2).ljust(header, b"\0")[:header]
        for column in range(16):
            place = 16 * (number % 2) + column
            time_ns = 10**12 + number * 50_000_000 + column * 3_125_000
            if column_header == 16:
                packet += struct.pack("<QHHI", time_ns, place, number // 2, 0)
            else:
                packet += struct.pack("<QHH", time_ns, place, 1)
            for row in range(4):
                packet += struct.pack("<IBxHHxx", 5000 + 10 * row, 40 + row, 7, 8)
            packet += b"\xff\xff\xff\xff"[:end]
        entries.append((time_ns, 7502, packet + bytes(footer)))
    identity = np.eye(4).ravel().tolist()
    said = {
        "prod_line": "OS-X", "beam_altitude_angles": ANGLES, "beam_azimuth_angles": AZIMUTHS,
        "lidar_origin_to_beam_origin_mm": 20.0, "lidar_to_sensor_transform": identity,
        "imu_to_sensor_transform": identity,
        "lidar_data_format": {"columns_per_packet": 16, "columns_per_frame": 32, "udp_profile_lidar": profile},
    }  # fmt: skip
    (folder / "walk.json").write_text(json.dumps(said | changed))
    path = folder / "walk.pcap"
    path.write_bytes(captures.pcap(entries))
    return path


@pytest.mark.parametrize("profile", PROFILES)
def test_a_pixel_is_where_the_manual_puts_it(profile: str, tmp_path: Path) -> None:
    path = made(profile, tmp_path)
    metadata = metadata_beside(path)
    assert metadata is not None
    stream = OusterStream(path, metadata)
    messages = [message for _, _, message in stream.messages((LIDAR_TOPIC,), 0, 2**62)]
    assert len(messages) == 4
    cloud = read_point_cloud_2(messages[1])
    assert len(cloud) == 32 * 4
    for index in range(0, len(cloud), 7):
        column, row = divmod(index, 4)
        head = 2 * math.pi * (1 - column / 32)
        along, up, away = head - math.radians(AZIMUTHS[row]), math.radians(ANGLES[row]), 4.98 + 0.01 * row
        truth = (
            away * math.cos(up) * math.cos(along) + 0.02 * math.cos(head),
            away * math.cos(up) * math.sin(along) + 0.02 * math.sin(head),
            away * math.sin(up),
        )
        np.testing.assert_allclose(cloud.xyz()[index], truth, atol=1e-5)
        assert cloud.column("reflectivity")[index] == 40 + row
    rest = list(stream.messages((LIDAR_TOPIC,), stream.end_ns - 60_000_000, 2**62))
    assert [message.header.stamp for _, _, message in rest] == [message.header.stamp for message in messages[2:]]


Changed = Callable[[list[bytes]], list[bytes]]


@pytest.mark.parametrize(
    "changed",
    [
        lambda packets: [packet for packet in packets for _ in range(2)],
        lambda packets: [packets[i] for i in (1, 0, 2, 4, 3, 6, 5, 7)],
        lambda packets: [packets[i] for i in (0, 2, 1, 2, 3, 5, 4, 7, 6, 6)],
    ],
    ids=["twice", "swapped", "both"],
)
def test_packets_that_the_network_swaps_or_repeats_change_nothing(changed: Changed, tmp_path: Path) -> None:
    """Every turn has two packets, so each swap here but the first is across the end of one."""
    path = made("LEGACY", tmp_path)
    metadata = metadata_beside(path)
    assert metadata is not None
    before = [bytes(message.data) for *_, message in OusterStream(path, metadata).messages((LIDAR_TOPIC,), 0, 2**62)]
    data = path.read_bytes()
    size = (len(data) - 24) // 8
    packets = [data[at : at + size] for at in range(24, len(data), size)]
    path.write_bytes(data[:24] + b"".join(changed(packets)))
    after = [bytes(message.data) for *_, message in OusterStream(path, metadata).messages((LIDAR_TOPIC,), 0, 2**62)]
    assert len(before) == 4 and after == before


def test_a_hundredth_of_the_packets_lost_costs_a_hundredth_of_the_points_and_moves_none(
    shared_data: Path, tmp_path: Path
) -> None:
    whole = shared_data / "sensors" / "ouster" / "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"
    metadata = metadata_beside(whole)
    assert metadata is not None
    sent = [(one.time_ns, 7502, one.payload) for one in Capture(whole).datagrams()]
    kept = np.random.default_rng(1).random(len(sent)) > 0.01
    lossy = tmp_path / "lossy.pcap"
    lossy.write_bytes(captures.pcap([one for one, keep in zip(sent, kept, strict=True) if keep]))
    clouds = [
        [
            read_point_cloud_2(message).xyz()
            for *_, message in OusterStream(path, metadata).messages((LIDAR_TOPIC,), 0, 2**62)
        ]
        for path in (whole, lossy)
    ]
    assert 0 < len(sent) - np.count_nonzero(kept) < 0.02 * len(sent)
    assert len(clouds[0]) == len(clouds[1]) > 1
    for before, after in zip(*clouds, strict=True):
        assert 0.96 * len(before) < len(after) <= len(before)
        assert {row.tobytes() for row in after} <= {row.tobytes() for row in before}
    assert sum(map(len, clouds[1])) < sum(map(len, clouds[0]))


def numbered(turn: int, column: int) -> bytes:
    return b"%d/%d" % (turn, column)


def gathered(order: list[tuple[int, int]], whole: int = 8) -> list[list[bytes]]:
    turns = Turns(whole)
    over = [one for turn, column in order for one in turns.add(turn % 65536, column, numbered(turn, column))]
    return over + list(turns.rest())


def test_turns_are_whole_around_the_end_of_their_counter_and_after_a_restart() -> None:
    order = [(turn, column) for turn in (65534, 65535, 65536, 65537, 20, 21) for column in range(8)]
    for swapped in (7, 15, 23):
        order[swapped], order[swapped + 1] = order[swapped + 1], order[swapped]
    wanted = [[numbered(turn, column) for column in range(8)] for turn in (65534, 65535, 65536, 65537, 20, 21)]
    assert gathered(order) == wanted


def test_a_packet_that_comes_a_scan_late_is_left_out_and_one_that_is_lost_delays_nothing_for_long() -> None:
    order = [(0, column) for column in range(7)] + [(1, column) for column in range(8)] + [(0, 7), (2, 0)]
    turns = gathered(order)
    assert [len(turn) for turn in turns] == [7, 8, 1]
    first = Turns(8)
    waited = [len(list(first.add(turn, column, numbered(turn, column)))) for turn, column in order]
    assert waited.index(1) == 7 + LATE


def test_a_turn_ends_with_its_last_packet_even_if_the_frame_number_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = made("LEGACY", tmp_path)
    metadata = metadata_beside(path)
    assert metadata is not None
    monkeypatch.setattr(OusterStream, "_frame_of", lambda self, packet: 7)
    assert OusterStream(path, metadata).counts[LIDAR_TOPIC][1] == 4


def test_the_imu_is_where_the_metadata_puts_it_and_missed_if_it_is_silent(tmp_path: Path) -> None:
    T_sensor_imu = np.eye(4)
    T_sensor_imu[:3, 3] = 6.0, -11.0, 7.0  # mm
    path = made("LEGACY", tmp_path, imu_to_sensor_transform=T_sensor_imu.ravel().tolist())
    metadata = metadata_beside(path)
    assert metadata is not None
    findings = {finding.subject: finding for finding in OusterStream(path, metadata).findings}
    assert "sensor.translation=[-0.00600, 0.01100, -0.00700]" in findings["unit's mount"].text
    assert findings["IMU"].verdict == "needs you"


def test_of_two_ousters_only_one_is_read_with_its_imu_and_the_other_is_reported(tmp_path: Path) -> None:
    path = made("LEGACY", tmp_path)
    mine = [(one.time_ns, 7502, one.payload) for one in Capture(path).datagrams()]
    mine = sorted([*mine, *((time_ns + 1_000, 7503, bytes(48)) for time_ns, _, _ in mine)])
    path.write_bytes(captures.pcap(mine))
    metadata = metadata_beside(path)
    assert metadata is not None
    alone = OusterStream(path, metadata)
    topics = (LIDAR_TOPIC, IMU_TOPIC)
    expected = list(alone.messages(topics, 0, 2**62))
    path.write_bytes(captures.pcap(mine, others=[(at + 100, port, packet) for at, port, packet in mine[:-1]]))
    stream = OusterStream(path, metadata)
    assert stream.counts == alone.counts
    found = list(stream.messages(topics, 0, 2**62))
    assert [entry[:2] for entry in found] == [entry[:2] for entry in expected]
    for one, other in zip(found, expected, strict=True):
        if one[0] == LIDAR_TOPIC:
            np.testing.assert_array_equal(one[2].data, other[2].data)
    assert {f.subject for f in stream.findings} - {f.subject for f in alone.findings} == {"LiDARs"}
    finding = next(f for f in stream.findings if f.subject == "LiDARs")
    assert finding.verdict == "needs you" and "only 192.168.1.200 is read" in finding.text


def test_what_cannot_be_read_is_said_in_a_sentence(tmp_path: Path) -> None:
    for columns in (0, -16):
        path = made("LEGACY", tmp_path, columns_per_packet=columns, lidar_data_format={}, columns_per_frame=32)
        with pytest.raises(HemislamError, match="columns a packet"):
            open_recording(path, Params())
    path = made("LEGACY", tmp_path, columns_per_packet=16, lidar_data_format={}, columns_per_frame=10**9)
    with pytest.raises(HemislamError, match="1000000000 a turn, which no sensor sends"):
        open_recording(path, Params())
    path = made("LEGACY", tmp_path, columns_per_packet=math.inf, lidar_data_format={}, columns_per_frame=32)
    with pytest.raises(HemislamError, match="need its metadata"):
        open_recording(path, Params())
    path = made("FUSA_RNG15_RFL8_NIR8_DUAL", tmp_path)
    with pytest.raises(HemislamError, match="of a kind that is not read"):
        open_recording(path, Params())
    (tmp_path / "walk.json").write_text('{"prod_line": "OS-0')
    with pytest.raises(HemislamError, match=r"is there, but is no metadata of an Ouster; copy it from the sensor"):
        open_recording(path, Params())
    (tmp_path / "walk.json").unlink()
    with pytest.raises(HemislamError, match=r"need its metadata beside them, as walk\.json\.$"):
        open_recording(path, Params())
    (tmp_path / "walk.osf").write_bytes(b"osf")
    with pytest.raises(HemislamError, match="ouster-cli source"):
        open_recording(tmp_path / "walk.osf", Params())
