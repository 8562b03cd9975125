"""Points are converted back into firings; packets made from these firings give the same points."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.decoder import Decoder
from app.sensors.live.difop import NOMINAL, ChannelAngles, Difop, read_difop
from app.sensors.live.feed import DEVICE, packets_of
from app.sensors.live.firings import firings_of, fit_angles
from app.sensors.live.frames import Assembler
from app.sensors.live.msop import PacketWriter
from app.sensors.recording import open_recording
from app.sensors.robosense import BPEARL, BPV4, Model
from app.slam.params import Params
from app.slam.types import F64, Measurement, Scan
from tests.sensors.live import sensor

SAMPLE = Path(__file__).resolve().parents[3] / "sample_data" / "cloister.mcap"
COUNT = np.radians(0.01)
"""rad, the packets' unit of azimuth."""
CORRECTED = [(round(e - 0.5, 2), round(-0.03 - 0.02 * c, 2)) for c, e in enumerate(sensor.ELEVATIONS)]
"""A unit's own angles, in the nominal order."""


def scan_of(
    speed: float = 1.0, *, start_deg: float = 0.03, turn_deg: float = 359.9, every: int = 6, v4: bool = False,
    rate: int = 10, angles: list[tuple[float, float]] | None = None,
    sees: Callable[[float, int], bool] = lambda azimuth, channel: True,
) -> Scan:  # fmt: skip
    """What a head that turns at so many times its nominal speed sees of walls at 5 to 15 m, every so many blocks.

    sees: whether there is a return at an azimuth, deg, for a channel.
    """
    rng = np.random.default_rng(5)
    block_ns, unit = (55_560, 0.0025) if v4 else (55_520, 0.005)
    step = 360.0 * rate * block_ns * 1e-9 * speed
    order = np.argsort([angle for angle, _ in angles] if angles else sensor.ELEVATIONS).argsort()
    fired = [
        (block, channel, start_deg + block * step)
        for block in range(0, int(turn_deg / step), every)
        for channel in range(32)
        if sees((start_deg + block * step) % 360.0, channel)
    ]
    distance = unit * rng.integers(round(5 / unit), round(15 / unit), len(fired))
    points = [
        sensor.point(azimuth, step, channel, far, v4=v4, angles=angles)
        for (_, channel, azimuth), far in zip(fired, distance, strict=True)
    ]
    after = [channel * 1.668 if v4 else sensor.OFFSETS_US[channel] for _, channel, _ in fired]
    times = np.array([block * block_ns for block, *_ in fired]) + np.rint(1000 * np.array(after)).astype(int)
    return Scan(
        stamp_ns=sensor.START_NS + int(times.min()),
        points=np.array(points, np.float32),
        offsets_ns=(times - times.min()).astype(np.int32),
        intensity=np.ones(len(points), np.float32),
        ring=np.array([order[channel] for _, channel, _ in fired], np.uint16),
    )


def as_packets(scan: Scan, calibration: ChannelAngles = NOMINAL, model: Model = BPEARL, rate: int = 10) -> Scan:
    """The same scan, had it come as packets. Its points must all be in one revolution, and of different times."""
    firings, writer = firings_of(scan, calibration, model, rate), PacketWriter(model)
    packets = writer.add(firings) + writer.flush()
    assembler, decoder = Assembler(), Decoder(calibration)
    decoder.configure(Difop(rpm=60 * rate))
    frames = [frame for _, packet in packets for frame in assembler.add(packet, 0)]
    (found,) = [decoder.decode(frame) for frame in (*frames, *assembler.flush())]
    assert isinstance(found, Scan)
    return found


def beside(scan: Scan, truth: Scan) -> tuple[F64, F64, F64]:
    """How far points are turned from where they were, rad (azimuth, elevation), and where that was, rad."""
    np.testing.assert_array_equal(scan.ring, truth.ring)
    times = [one.stamp_ns + one.offsets_ns.astype(np.int64) for one in (scan, truth)]
    assert np.abs(times[0] - times[1]).max() < 12_000  # whole microseconds, and the shortest firing of some
    (azimuth, elevation), (there, height) = polar(scan), polar(truth)
    return np.angle(np.exp(1j * (azimuth - there))), elevation - height, np.mod(there, 2 * np.pi)


def polar(scan: Scan) -> tuple[F64, F64]:
    """Azimuth as the head turns, and elevation, rad."""
    x, y, z = scan.points.T.astype(np.float64)
    return np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))


@pytest.mark.parametrize("speed", [1.0, 100e6 / 1801 / 55_520, 0.995, 1.003])
@pytest.mark.parametrize(("v4", "rate"), [(False, 10), (False, 20), (True, 10)])
def test_however_fast_the_motor_turns_no_point_is_further_off_than_azimuths_are_written(
    speed: float, v4: bool, rate: int
) -> None:
    scan = scan_of(speed, v4=v4, rate=rate)
    again = as_packets(scan, model=BPV4 if v4 else BPEARL, rate=rate)
    azimuth, elevation, _ = beside(again, scan)
    assert np.abs(azimuth).max() < 2.0 * COUNT  # half a count, and another half where the step to the next is told
    assert abs(azimuth.mean()) < 0.1 * COUNT
    assert np.abs(elevation).max() < 1e-6
    ranges = [np.linalg.norm(one.points, axis=1) for one in (again, scan)]
    np.testing.assert_allclose(*ranges, atol=1e-4)  # they were whole steps


def test_of_a_small_part_of_a_turn_the_speed_is_the_nominal_one() -> None:
    azimuth = firings_of(scan_of(1.01, turn_deg=20.0, every=1)).azimuth.astype(int)
    assert len(azimuth) == 99
    assert (azimuth[-1] - azimuth[0]) / 98 == pytest.approx(19.987, abs=0.011)


@pytest.mark.parametrize("start_deg", [-3.0, -0.3, -0.1, 0.1, 0.3, 3.0, 90.0, 180.0])
def test_wherever_a_revolution_is_cut_each_firing_keeps_its_time_and_azimuth(start_deg: float) -> None:
    scan = scan_of(start_deg=start_deg, turn_deg=360.2, every=1)
    firings = firings_of(scan)
    azimuth = firings.azimuth.astype(int)
    assert len(np.unique(azimuth)) == len(azimuth)  # equal ones are two returns of one firing
    falls = np.count_nonzero(np.diff(azimuth) < 0)
    assert falls == (abs(start_deg) > 1.0)  # a few hundredths beyond 0 would be a revolution of its own
    expected = np.mod(start_deg + 0.199872 * np.arange(len(azimuth)), 360.0)
    apart = np.mod(azimuth / 100 - expected + 180.0, 360.0) - 180.0
    assert np.abs(apart[2:-2]).max() < 0.006
    assert np.abs(apart).max() < 0.32


SIGHTS: dict[str, Callable[[float, int], bool]] = {
    "all around": lambda azimuth, channel: True,
    "low on one side, high on the other": lambda azimuth, channel: (azimuth < 180) == (sensor.ELEVATIONS[channel] < 40),
    "nothing at first": lambda azimuth, channel: azimuth > 2.2,
    "half a turn": lambda azimuth, channel: 90 < azimuth < 270,
}


@pytest.mark.parametrize("sight", SIGHTS)
def test_a_units_own_angles_are_read_from_its_points_in_any_scene(sight: str) -> None:
    scans = [scan_of(speed, angles=CORRECTED, sees=SIGHTS[sight]) for speed in (0.999, 1.0, 1.001)]
    found = fit_angles(scans)
    np.testing.assert_allclose(found.elevations_deg, [e for e, _ in CORRECTED], atol=0.011)
    # All corrections and the azimuth of the head are free by a constant. High up the lever is all that they move.
    free = found.horizontal_deg - [h for _, h in CORRECTED]
    low = np.array(sensor.ELEVATIONS) < 85.0
    np.testing.assert_allclose(free[low], free[low].mean(), atol=0.02)
    if sight == "all around":
        np.testing.assert_allclose(free[low], 0.03, atol=0.02)  # no revolution begins before the cut
    azimuth, elevation, _ = beside(as_packets(scans[0], found), scans[0])
    steep = np.array([CORRECTED[c][0] for c in np.argsort(found.rings)[scans[0].ring]]) > 60.0
    assert np.abs(azimuth[~steep]).max() < 4.0 * COUNT
    assert np.abs(elevation).max() < 1.1 * COUNT


@pytest.mark.parametrize("sight", SIGHTS)
def test_a_unit_with_the_nominal_angles_keeps_them_in_any_scene(sight: str) -> None:
    scans = [scan_of(speed, sees=SIGHTS[sight]) for speed in (0.999, 1.0, 1.001)]
    assert fit_angles(scans).same(NOMINAL)


@pytest.mark.parametrize("name", ["cloister", "hall_bpearl", "outdoor_bpearl"])
def test_played_out_as_packets_no_recording_is_turned_or_bent(name: str, shared_data: Path) -> None:
    path = SAMPLE if name == "cloister" else shared_data / f"{name}.mcap"
    assembler, decoder = Assembler(), Decoder()
    with open_recording(path, Params()) as recording:
        truth = [m.scan for m in recording.measurements(0, 1.5) if isinstance(m, Measurement)]
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
        there = min(truth, key=lambda one: abs(one.end_ns - scan.end_ns))
        if abs(there.end_ns - scan.end_ns) > 12_000:
            continue
        azimuth, elevation, place = beside(scan, there)
        far = (np.linalg.norm(there.points, axis=1) > 3.0) & (there.ring < 16)
        azimuths.append(azimuth[far])
        elevations.append(elevation[far])
        places.append(place[far])
        rings.append(scan.ring[far])
    azimuth, elevation, place, ring = (np.concatenate(parts) for parts in (azimuths, elevations, places, rings))
    assert len(azimuths) >= len(truth) - 1 > 10
    assert abs(np.median(azimuth)) < 0.2 * COUNT
    assert abs(np.polyfit(place, azimuth, 1)[0] * 2 * np.pi) < 0.4 * COUNT
    for one in np.flatnonzero(np.bincount(ring) > 300):
        off = elevation[ring == one]
        assert abs(np.median(off)) < (0.15 if len(off) > 1000 else 0.5) * COUNT  # of few returns, to half a unit
