"""Complete revolutions are assembled whatever a network does to packets, and no packet stops the rest.

Tests app/sensors/live/decoder.py, app/sensors/live/status.py.
"""

import random

import numpy as np
import pytest

from app.sensors.live.decoder import Decoder
from app.sensors.live.frames import Assembler, Revolution
from app.sensors.live.status import Counters
from app.slam.types import Scan
from tests.sensors.live import sensor

TURNS = 6


def frames_of(packets: list[bytes], counters: Counters | None = None) -> list[Revolution]:
    assembler = Assembler(counters)
    found = [frame for packet in packets for frame in assembler.add(packet, 0)]
    return [*found, *assembler.flush()]


def scans_of(frames: list[Revolution]) -> list[Scan]:
    decoder = Decoder()
    return [scan for frame in frames if isinstance(scan := decoder.decode(frame), Scan)]


def same(one: Scan, other: Scan) -> bool:
    return one.stamp_ns == other.stamp_ns and np.array_equal(one.points, other.points)


PACKETS = sensor.turns(TURNS)
WHOLE = scans_of(frames_of(PACKETS))


def test_a_revolution_ends_where_the_azimuth_passes_zero() -> None:
    assert [len(scan) for scan in WHOLE[:-1]] == [1801 * 32] * (TURNS - 1)
    for turn, scan in enumerate(WHOLE):
        distance = np.linalg.norm(scan.points - [0, 0, 0.09427], axis=1)
        assert np.median(distance) == pytest.approx((1000 + turn) * 0.005, abs=0.02)


def test_packets_overtaken_by_up_to_three_others_come_back_into_place() -> None:
    rng = random.Random(0)
    order = sorted(range(len(PACKETS)), key=lambda k: k + rng.uniform(0, 3.0))
    assert order != sorted(order)
    counters = Counters()
    found = scans_of(frames_of([PACKETS[0], *[PACKETS[k] for k in order if k]], counters))
    assert all(same(*pair) for pair in zip(found, WHOLE, strict=True))
    assert counters.reordered > 100
    assert (counters.late, counters.lost) == (0, 0)


def test_what_comes_twice_counts_once() -> None:
    counters = Counters()
    found = scans_of(frames_of([packet for packet in PACKETS for _ in range(2)], counters))
    assert all(same(*pair) for pair in zip(found, WHOLE, strict=True))
    assert counters.packets == len(PACKETS)
    assert counters.duplicates + counters.late == len(PACKETS)


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_what_is_lost_is_counted_and_costs_no_more_than_itself(share: float) -> None:
    rng = random.Random(1)
    kept = [packet for k, packet in enumerate(PACKETS) if rng.random() > share or k in (0, len(PACKETS) - 1)]
    counters = Counters()
    found = scans_of(frames_of(kept, counters))
    assert counters.lost == len(PACKETS) - len(kept)
    assert len(found) == len(WHOLE)
    assert sum(map(len, found)) == len(kept) * 12 * 32
    for scan, whole in zip(found, WHOLE, strict=True):  # every point that is left is one of the whole scan, at its time
        times = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
        assert np.isin(times, whole.stamp_ns + whole.offsets_ns.astype(np.int64)).all()


def test_a_whole_revolution_lost_does_not_merge_its_neighbours() -> None:
    counters = Counters()
    found = frames_of(PACKETS[:200] + PACKETS[355:], counters)
    assert counters.lost == 155
    spans = [int(frame.stamps_ns[-1] - frame.stamps_ns[0]) for frame in found]
    assert max(spans) < 0.101e9
    assert len(found) == TURNS


@pytest.mark.parametrize("jump_s", [-3600, 86_400, -5, 2])
def test_a_clock_that_is_set_ends_one_revolution_early_and_loses_nothing(jump_s: int) -> None:
    later = sensor.turns(TURNS, start_ns=sensor.START_NS + (TURNS + 10 * jump_s) * 10**8)
    counters = Counters()
    found = frames_of(PACKETS[:500] + later[500:], counters)
    assert counters.packets == len(PACKETS)
    assert counters.strays == 0
    assert len(found) == TURNS + 1
    assert all(frame.stamps_ns[-1] - frame.stamps_ns[0] < 0.11e9 for frame in found)


def test_one_packet_with_a_wild_time_is_left_out() -> None:
    stray = bytearray(PACKETS[300])
    stray[22] = (stray[22] + 3) % 28 + 1  # another day
    counters = Counters()
    found = scans_of(frames_of([*PACKETS[:300], bytes(stray), *PACKETS[301:]], counters))
    assert counters.strays == 1
    assert len(found) == TURNS
    assert sum(map(len, found)) == sum(map(len, WHOLE)) - 12 * 32


def test_a_hundred_thousand_broken_packets_are_counted_and_the_sensor_is_still_understood() -> None:
    rng = random.Random(2)
    assembler, decoder, counters = Assembler(Counters()), Decoder(), Counters()
    assembler.counters = counters
    made = 0
    for number in range(100_000):
        packet = bytearray(PACKETS[number % len(PACKETS)])
        kind = rng.randrange(6)
        if kind == 0:
            packet = bytearray(rng.randbytes(rng.randrange(0, 1500)))
        elif kind == 1:
            del packet[rng.randrange(len(packet)) :]
        elif kind == 2:
            for _ in range(rng.randrange(1, 20)):
                packet[rng.randrange(len(packet))] = rng.randrange(256)
        elif kind == 3:
            packet[8:] = rng.randbytes(len(packet) - 8)
        elif kind == 4:
            packet[20:33] = rng.randbytes(13)
        for frame in assembler.add(bytes(packet), number):
            made += 1
            assert len(frame.packets) <= 1025
            scan = decoder.decode(frame)
            if isinstance(scan, Scan):
                assert np.isfinite(scan.points).all() and scan.offsets_ns.min() == 0
    told = counters.packets + counters.truncated + counters.foreign + counters.strays + counters.late
    assert told + counters.duplicates >= 99_000
    assert counters.truncated > 10_000 and counters.foreign > 10_000 and made > 10
    later = sensor.turns(3, start_ns=sensor.START_NS + 10**12)
    found = scans_of([frame for packet in later for frame in assembler.add(packet, 0)] + list(assembler.flush()))
    assert [len(scan) for scan in found[-3:-1]] == [1801 * 32] * 2
