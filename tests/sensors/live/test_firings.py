"""Points back into the firings that measured them: what packets then say of them is where they were."""

from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.decoder import Decoder
from app.sensors.live.difop import NOMINAL, Calibration, read_difop
from app.sensors.live.feed import DEVICE, packets_of
from app.sensors.live.firings import firings_of, fit_angles
from app.sensors.live.frames import Assembler
from app.sensors.live.msop import PacketWriter
from app.sensors.recording import open_recording
from app.slam.params import Params
from app.slam.types import F64, Measurement, Scan
from tests.sensors.live import sensor

MUSEUM = Path(__file__).resolve().parents[3] / "sample_data" / "museum.mcap"
BLOCK_NS, STEP_M = 55_520, 0.005
COUNT = np.radians(0.01)
"""rad, the packets' unit of azimuth."""


def scan_of(
    step_deg: float, *, blocks: int = 1800, every: int = 6, angles: list[tuple[float, float]] | None = None
) -> Scan:
    """What a head that turns so far from block to block would see of walls at some 10 m."""
    rng = np.random.default_rng(5)
    order = np.argsort([angle for angle, _ in angles] if angles else sensor.ELEVATIONS).argsort()
    fired = [(block, channel) for block in range(0, blocks, every) for channel in range(32)]
    points = [
        sensor.point(
            0.03 + block * step_deg, step_deg, channel, STEP_M * rng.integers(1000, 3000), angles=angles
        )
        for block, channel in fired
    ]  # fmt: skip
    offsets = [block * BLOCK_NS + round(1000 * sensor.OFFSETS_US[channel]) for block, channel in fired]
    rings = [order[channel] for _, channel in fired]
    return Scan(
        stamp_ns=sensor.START_NS,
        points=np.array(points, np.float32),
        offsets_ns=np.array(offsets, np.int32),
        intensity=np.ones(len(points), np.float32),
        ring=np.array(rings, np.uint16),
    )


def as_packets(scan: Scan, calibration: Calibration = NOMINAL) -> Scan:
    firings, writer = firings_of(scan, calibration), PacketWriter()
    packets = writer.add(firings.times_ns, firings.azimuth, firings.counts, firings.intensity) + writer.flush()
    assembler, decoder = Assembler(), Decoder(calibration)
    frames = [frame for _, packet in packets for frame in assembler.add(packet, 0)]
    (found,) = [decoder.decode(frame) for frame in (*frames, *assembler.flush())]
    assert isinstance(found, Scan)
    return found


def beside(scan: Scan, truth: Scan) -> tuple[F64, F64, F64]:
    """How far points are turned from where they were, rad (azimuth, elevation), and where that was, rad."""
    np.testing.assert_array_equal(scan.ring, truth.ring)
    (azimuth, elevation), (there, height) = polar(scan), polar(truth)
    return np.angle(np.exp(1j * (azimuth - there))), elevation - height, np.mod(there, 2 * np.pi)


def polar(scan: Scan) -> tuple[F64, F64]:
    """Azimuth as the head turns, and elevation, rad."""
    x, y, z = scan.points.T.astype(np.float64)
    return np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))


@pytest.mark.parametrize("step_deg", [36000 / 1801 / 100, 0.199872, 0.1995, 0.2004])
def test_however_fast_the_motor_turns_no_point_is_further_off_than_azimuths_are_written(step_deg: float) -> None:
    scan = scan_of(step_deg, blocks=min(1800, int(359.9 / step_deg)))
    again = as_packets(scan)
    azimuth, elevation, _ = beside(again, scan)
    assert np.abs(azimuth).max() < 2.0 * COUNT  # half a count, and another half where the step to the next is told
    assert abs(azimuth.mean()) < 0.1 * COUNT
    assert np.abs(elevation).max() < 1e-6
    np.testing.assert_allclose(
        np.linalg.norm(again.points, axis=1), np.linalg.norm(scan.points, axis=1), atol=1e-4
    )  # they were whole steps


def test_of_a_small_part_of_a_turn_the_speed_is_the_nominal_one() -> None:
    scan = scan_of(0.199872, blocks=100, every=3)
    azimuth, _, _ = beside(as_packets(scan), scan)
    assert np.abs(azimuth).max() < 2.0 * COUNT


def test_a_units_own_angles_are_read_off_its_points() -> None:
    angles = [(round(e - 0.5, 2), round(-0.03 - 0.02 * c, 2)) for c, e in enumerate(sensor.ELEVATIONS)]
    scan = scan_of(0.1999, angles=angles)
    found = fit_angles([scan])
    np.testing.assert_allclose(found.elevations_deg, [e for e, _ in angles], atol=0.011)
    azimuth, elevation, _ = beside(as_packets(scan, found), scan)
    np.testing.assert_allclose(found.horizontal_deg[1:], [h + 0.03 for _, h in angles[1:]], atol=0.011)  # begins at 0
    low = np.array([angles[c][0] < 60.0 for c in np.argsort(found.rings)[scan.ring]])
    assert np.abs(azimuth[low]).max() < 4.0 * COUNT
    assert np.abs(elevation).max() < 1.1 * COUNT


@pytest.mark.parametrize("name", ["museum", "hall_bpearl", "outdoor_bpearl"])
def test_played_out_as_packets_no_recording_is_turned_or_bent(name: str, shared_data: Path) -> None:
    path = MUSEUM if name == "museum" else shared_data / f"{name}.mcap"
    assembler, decoder = Assembler(), Decoder()
    with open_recording(path, Params()) as recording:
        truth = {
            m.scan.end_ns // 1_000_000: m.scan for m in recording.measurements(0, 1.5) if isinstance(m, Measurement)
        }
        sent = list(packets_of(recording, 1.5))
    for one in sent:
        if one.stream == DEVICE:
            said = read_difop(one.data)
            assert said is not None
            decoder.configure(said)
    frames = [frame for one in sent if one.stream == 0 for frame in assembler.add(one.data, 0)]
    azimuths, elevations, places, rings = [], [], [], []
    for frame in frames:
        scan = decoder.decode(frame)
        assert isinstance(scan, Scan)
        there = truth.get(scan.end_ns // 1_000_000)
        if there is None or len(there) != len(scan):
            continue
        azimuth, elevation, place = beside(scan, there)
        far = (np.linalg.norm(there.points, axis=1) > 3.0) & (there.ring < 16)
        azimuths.append(azimuth[far])
        elevations.append(elevation[far])
        places.append(place[far])
        rings.append(scan.ring[far])
    azimuth, elevation, place, ring = (np.concatenate(parts) for parts in (azimuths, elevations, places, rings))
    assert len(azimuth) > 1_000
    assert abs(np.median(azimuth)) < 0.2 * COUNT
    assert abs(np.polyfit(place, azimuth, 1)[0] * 2 * np.pi) < 0.4 * COUNT
    for one in np.flatnonzero(np.bincount(ring) > 300):
        assert abs(np.median(elevation[ring == one])) < 0.15 * COUNT
