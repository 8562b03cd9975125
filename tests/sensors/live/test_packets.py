"""The sensor's packets are decoded as in the vendor's tables, in every mode of the sensor.

Tests app/sensors/live/difop.py, app/sensors/live/msop.py.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.sensors.live.decoder import Decoder
from app.sensors.live.difop import NOMINAL, ChannelAngles, Difop, read_angles, read_difop, write_difop
from app.sensors.live.frames import Assembler, Revolution
from app.sensors.live.msop import Firings, PacketWriter, stamp_of, write_packet
from app.sensors.robosense import BPEARL, BPV4
from app.slam.errors import HemislamError
from app.slam.types import Scan
from tests.sensors.live import sensor

ANGLES = [(round(e - 0.5 + 0.01 * c, 2), round(-0.03 - 1.7 * c, 2)) for c, e in enumerate(sensor.ELEVATIONS)]


def scans(packets: list[bytes], decoder: Decoder | None = None) -> list[Scan]:
    assembler, decoder = Assembler(), decoder or Decoder()
    frames = [frame for packet in packets for frame in assembler.add(packet, 0)]
    found = [decoder.decode(frame) for frame in (*frames, *assembler.flush())]
    assert all(isinstance(scan, Scan) for scan in found)
    return [scan for scan in found if isinstance(scan, Scan)]


def configured(**settings: object) -> Decoder:
    decoder = Decoder()
    said = read_difop(sensor.difop(**settings))  # type: ignore[arg-type]
    assert said is not None
    decoder.configure(said)
    return decoder


@pytest.mark.parametrize("v4", [False, True])
@pytest.mark.parametrize("rate", [10, 20])
def test_every_firing_is_where_and_when_the_tables_say(v4: bool, rate: int) -> None:
    decoder = configured(rpm=60 * rate, angles=ANGLES)
    found = scans(sensor.turns(3, rate=rate, v4=v4), decoder)
    assert len(found) == 3
    scan = found[1]
    block_ns, step = (55_560, 0.0025) if v4 else (55_520, 0.005)
    per_turn = 10**9 // rate // block_ns
    assert len(scan) == per_turn * 32
    assert scan.stamp_ns == pytest.approx(sensor.START_NS + per_turn * block_ns, abs=1_000)
    rng = np.random.default_rng(0)
    for index in rng.integers(0, len(scan), 200):
        number, channel = divmod(int(index), 32)
        if number % 12 in (10, 11):  # the step to the next packet's block is taken from the one before
            continue
        azimuths = [(number + k) * 36000 // per_turn for k in (0, 1)]
        truth = sensor.point(
            azimuths[0] / 100, (azimuths[1] - azimuths[0]) / 100, channel, 1001 * step, v4=v4, angles=ANGLES
        )
        np.testing.assert_allclose(scan.points[index], truth, atol=2e-4)
        firing = channel * 1.668 if v4 else sensor.OFFSETS_US[channel]
        assert scan.offsets_ns[index] == pytest.approx(number * block_ns + firing * 1000, abs=1_001)
        assert scan.intensity[index] == channel
    order = sorted(range(32), key=lambda c: ANGLES[c][0])
    assert [order.index(c) for c in range(32)] == scan.ring[:32].tolist()


def test_a_reversed_sensor_sees_the_mirror_image() -> None:
    (plain,) = scans(sensor.turns(1))
    (mirrored,) = scans(sensor.turns(1), configured(reverse=True))
    np.testing.assert_allclose(mirrored.points, plain.points * [1, -1, 1], atol=1e-5)


def test_two_returns_of_one_firing_are_two_points_of_one_time_unless_they_are_one() -> None:
    scan = scans(sensor.turns(2, dual=True), configured(mode=0))[0]
    assert len(scan) == 1801 * (32 + 31)
    first, second = scan.points[1:32], scan.points[32:63]
    np.testing.assert_allclose(np.linalg.norm(second - first, axis=1), 7 * 0.005, atol=1e-5)
    np.testing.assert_array_equal(scan.offsets_ns[1:32], scan.offsets_ns[32:63])
    assert scan.end_ns - scan.stamp_ns == pytest.approx(0.1e9, abs=1e5)


@pytest.mark.parametrize("fov", [(9_000, 27_000), (10_000, 26_000), (0, 9_000), (30_000, 36_000)])
def test_a_limited_field_of_view_gives_one_scan_a_turn_and_its_blind_gap_takes_time(fov: tuple[int, int]) -> None:
    found = scans(sensor.turns(4, fov=fov))
    assert len(found) == 4
    for turn, scan in enumerate(found[:3]):
        width = (fov[1] - fov[0]) / 36_000 * 0.1e9
        assert scan.end_ns - scan.stamp_ns == pytest.approx(width, abs=2e5)
        begin = sensor.START_NS + (turn + fov[0] / 36_000) * 1801 * 55_520
        assert scan.stamp_ns == pytest.approx(begin, abs=5e4)
        distances = np.unique(np.rint(np.linalg.norm(scan.points - [0, 0, 0.09427], axis=1) / 0.005 / 10))
        assert len(distances) <= 2  # all of one revolution


def test_what_is_too_near_too_far_or_nothing_is_no_return() -> None:
    channels = [(0, 9), (19, 9), (20, 9), (30_000, 9), (30_001, 9)] + [(0, 0)] * 27
    blocks = [(20 * k, channels) for k in range(12)]
    (scan,) = scans([sensor.msop(sensor.START_NS, blocks)])
    assert len(scan) == 24
    near, far = np.linalg.norm(scan.points[:2], axis=1)
    assert near == pytest.approx(0.1, abs=0.12)
    assert far == pytest.approx(150.0, abs=0.12)


def test_angles_come_from_a_file_the_device_or_the_data_sheet(tmp_path: Path) -> None:
    file = tmp_path / "angles.csv"
    file.write_text("".join(f"{e:.2f},{h:.2f}\n" for e, h in ANGLES))
    said = read_difop(sensor.difop(angles=ANGLES))
    assert said is not None and said.calibration is not None
    np.testing.assert_allclose(said.calibration.elevations_deg, read_angles(file).elevations_deg, atol=0.0051)
    np.testing.assert_allclose(said.calibration.horizontal_deg, read_angles(file).horizontal_deg, atol=0.0051)
    plain = read_difop(sensor.difop())
    assert plain is not None and plain.calibration is None
    decoder = Decoder(read_angles(file))
    decoder.configure(plain)
    assert decoder.calibration.elevations_deg[3] == pytest.approx(ANGLES[3][0], abs=0.0051)
    for text in ("", "1,2\n", "a,b\n" * 32, "200,0\n" * 32, "1" * 200_000):
        file.write_text(text)
        with pytest.raises(HemislamError, match=r"angles\.csv is not a calibration"):
            read_angles(file)
    with pytest.raises(HemislamError, match="cannot be read"):
        read_angles(tmp_path / "none.csv")


def test_a_real_units_angles_survive_its_packet(shared_data: Path) -> None:
    real = read_angles(shared_data / "bpearl" / "angles.csv")
    said = read_difop(write_difop(Difop(calibration=real, rpm=1200, reverse=True), sensor.START_NS))
    assert said is not None and said.calibration is not None
    assert said.calibration.same(real) or np.allclose(said.calibration.horizontal_deg, real.horizontal_deg)
    assert (said.rpm, said.reverse) == (1200, True)
    assert real.rings[0] == 0 and real.rings[-1] == 31 and real.rings[1] > real.rings[2]


@pytest.mark.parametrize("model", [BPEARL, BPV4])
def test_written_packets_are_the_tables_packets(model: object) -> None:
    v4 = model is BPV4
    rng = np.random.default_rng(1)
    counts, intensity = rng.integers(0, 65536, (12, 32)), rng.integers(0, 256, (12, 32))
    azimuth = np.arange(12) * 20
    blocks = [
        (int(a), list(zip(c.tolist(), i.tolist(), strict=True)))
        for a, c, i in zip(azimuth, counts, intensity, strict=True)
    ]
    stamp = sensor.START_NS + 123_456_789_000
    truth = sensor.msop(stamp, blocks, v4=v4, index=77)
    made = write_packet(
        stamp,
        azimuth.astype(np.uint16),
        counts.astype(np.uint16),
        intensity.astype(np.uint8),
        BPV4 if v4 else BPEARL,
        77,
    )
    assert made == truth
    assert stamp_of(truth, BPV4 if v4 else BPEARL) == stamp


def test_an_invalid_date_is_recognised() -> None:
    packet = bytearray(sensor.turns(1)[0])
    packet[20:26] = bytes(6)
    assert stamp_of(bytes(packet), BPEARL) is None


def test_packets_run_on_over_the_end_of_a_revolution_but_not_over_a_pause() -> None:
    writer = PacketWriter()
    times = sensor.START_NS + 55_520 * np.arange(30)
    empty = np.zeros((30, 32))
    counts, intensity = empty.astype(np.uint16), empty.astype(np.uint8)
    made = writer.add(Firings(times, (np.arange(30) * 20).astype(np.uint16), counts, intensity))
    assert len(made) == 2
    later = writer.add(Firings(times[:6] + 10**9, np.zeros(6, np.uint16), counts[:6], intensity[:6]))
    assert [stamp_of(packet, BPEARL) for _, packet in later] == [sensor.START_NS + 24 * 55_520 // 1000 * 1000]
    assert len(writer.flush()) == 1


def test_nominal_angles_are_the_data_sheets() -> None:
    np.testing.assert_allclose(NOMINAL.elevations_deg, sensor.ELEVATIONS)
    assert isinstance(NOMINAL, ChannelAngles)


def test_no_bytes_of_a_device_packet_stop_the_decoder() -> None:
    rng = np.random.default_rng(3)
    packets = sensor.turns(1)
    for number in range(300):
        broken = bytearray(sensor.difop(angles=ANGLES))
        for at in rng.integers(8, 1248, 1 + number):
            broken[at] = rng.integers(256)
        said = read_difop(bytes(broken))
        assert said is not None
        decoder = Decoder()
        decoder.configure(said)
        (scan,) = scans(packets[:20], decoder)
        assert np.isfinite(scan.points).all()
        assert sorted(set(scan.ring.tolist())) == list(range(32))


def test_a_real_frame_comes_out_where_another_driver_put_its_points(shared_data: Path) -> None:
    """A real BPv4, decoded by another driver: its azimuths and ranges as packets give the points it computed."""
    raw = (shared_data / "bpearl" / "frame_0.pcd").read_bytes()
    fields = [(name, "<f4") for name in ("x", "y", "z", "intensity")] + [("ring", "<u2")]
    fields += [(name, "<f4") for name in ("azimuth", "elevation", "range")]
    truth = np.frombuffer(raw, np.dtype(fields), offset=raw.index(b"DATA binary\n") + 12)
    angles = read_angles(shared_data / "bpearl" / "angles.csv")
    channel = np.argsort(angles.rings)[truth["ring"]]
    np.testing.assert_allclose(truth["elevation"], angles.elevations_deg[channel], atol=0.001)
    within = 36_000 / 60 * 600 * 55.56e-6 * (channel * 1.668 / 55.56) / 100  # deg that the head turns on in the block
    head = np.rint((truth["azimuth"] - angles.horizontal_deg[channel] - within) * 100).astype(int) % 36_000
    packets, times = [], []
    for number, azimuth in enumerate(np.unique(head)):
        blocks: list[sensor.Block] = [(int(azimuth), [(0, 0)] * 32) for _ in range(12)]
        for at in np.flatnonzero(head == azimuth):
            blocks[0][1][channel[at]] = (round(truth["range"][at] / 0.0025), int(truth["intensity"][at]))
        packets.append(np.frombuffer(sensor.msop(sensor.START_NS, blocks, v4=True), np.uint8))
        times.append(sensor.START_NS + 10_000 * number)
    frame = Revolution(BPV4, np.array(packets), np.array(times), 0, 12, 0)
    scan = Decoder(angles).decode(frame)
    assert isinstance(scan, Scan)
    assert len(scan) > 0.999 * len(truth)
    theirs = np.column_stack([truth["x"], truth["y"], truth["z"]])
    distance, nearest = cKDTree(theirs).query(scan.points)
    assert np.all(distance < 1e-4 + 2e-4 * np.linalg.norm(scan.points, axis=1))  # 0.01 deg, as it rounded
    np.testing.assert_array_equal(scan.ring, truth["ring"][nearest])
