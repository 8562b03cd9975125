"""Each scan gets the IMU samples that cover it, as far as they exist; no good data is lost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.sensors.sequencer import MAX_HELD, MAX_WAITING, Sequencer
from app.slam.sections import ImuParams
from app.slam.types import F64, I64, DroppedScan, Measurement, Samples, Scan

MS = 1_000_000
PERIOD, IMU_STEP = 100 * MS, 10 * MS


def scan(begin_ms: int, length_ms: int = 100) -> Scan:
    offsets = np.array([0, length_ms // 2, length_ms], np.int32) * MS
    return Scan(begin_ms * MS, np.ones((3, 3), np.float32), offsets, np.ones(3, np.float32), np.zeros(3, np.uint16))


def samples(begin_ms: int, end_ms: int, step_ms: int = 10) -> list[int]:
    return list(range(begin_ms, end_ms + 1, step_ms))


def feed(
    imu_ms: Sequence[int], scans: Sequence[Scan | DroppedScan]
) -> tuple[list[Measurement | DroppedScan], Sequencer]:
    """Everything in the order of time, and what came out. A sample's gyro carries its own time."""
    arrivals: list[tuple[int, int, int | Scan | DroppedScan]] = [(at, n, at) for n, at in enumerate(imu_ms)]
    arrivals += [(s.stamp_ns // MS + 100, n, s) for n, s in enumerate(scans)]
    sequencer = Sequencer(ImuParams())
    out: list[Measurement | DroppedScan] = []
    for _, _, arrived in sorted(arrivals, key=lambda entry: entry[:2]):
        push(sequencer, arrived)
        out += sequencer.ready()
    return [*out, *sequencer.finish()], sequencer


def push(sequencer: Sequencer, arrived: int | Scan | DroppedScan) -> None:
    if isinstance(arrived, int):
        sequencer.add_imu(arrived * MS, (arrived / 1e6, 0.0, 0.0), (0.0, 0.0, 9.81))
    else:
        sequencer.add_scan(arrived)


def stamps(entry: Measurement | DroppedScan) -> list[int]:
    assert isinstance(entry, Measurement)
    np.testing.assert_array_equal(entry.imu.gyro[:, 0], entry.imu.stamps_ns // MS / 1e6)
    return (entry.imu.stamps_ns // MS).tolist()


def dropped(entries: Sequence[Measurement | DroppedScan]) -> list[tuple[int, str]]:
    return [(entry.stamp_ns // MS, entry.reason) for entry in entries if isinstance(entry, DroppedScan)]


def test_scans_whose_clock_leaps_ahead_of_an_imu_are_no_walk_by_the_lidar_alone() -> None:
    """An hour ahead from the fourth scan on; those are dropped, and a walk of an hour is not made up."""
    leapt = [scan(3_600_000 + at) for at in range(300, 800, 100)]
    out, _ = feed(samples(-35, 900), [scan(0), scan(100), scan(200), *leapt])
    assert sum(isinstance(entry, Measurement) for entry in out) == 3
    assert {reason for _, reason in dropped(out)} == {"its time is far ahead of the scan before it and of the IMU"}


def test_samples_run_from_the_previous_scans_end_to_this_scans_end() -> None:
    out, _ = feed(samples(-35, 335), [scan(0), scan(100), scan(200)])
    assert stamps(out[0]) == samples(-35, 105)  # the first: all there are, and one at or past the end
    assert stamps(out[1]) == samples(95, 205)
    assert stamps(out[2]) == samples(195, 305)


def test_a_sample_exactly_at_a_scans_end_closes_it_and_opens_the_next() -> None:
    out, _ = feed(samples(0, 200), [scan(0), scan(100)])
    assert stamps(out[0]) == samples(0, 100)
    assert stamps(out[1]) == samples(100, 200)


@settings(deadline=None)  # other work on the machine is no failure
@given(
    delays=st.lists(st.integers(0, 250), min_size=12, max_size=12),
    imu_delay=st.integers(0, 400),
    phase=st.integers(0, 9),
)
def test_the_pairs_do_not_depend_on_delays_of_arrival(delays: list[int], imu_delay: int, phase: int) -> None:
    scans = [scan(100 * n) for n in range(12)]
    imu = samples(-20 + phase, 1250 + phase)
    expected, _ = feed(imu, scans)
    arrivals: list[tuple[int, int, int | Scan]] = [(at + imu_delay, n, at) for n, at in enumerate(imu)]
    arrivals += [(100 * n + 100 + delay, n, s) for n, (delay, s) in enumerate(zip(delays, scans, strict=True))]
    sequencer, out = Sequencer(ImuParams()), []
    for _, _, arrived in sorted(arrivals, key=lambda entry: entry[:2]):
        push(sequencer, arrived)
        out += sequencer.ready()
        late = [entry for entry in out if isinstance(entry, DroppedScan)]
    out += sequencer.finish()
    # A scan that arrives after a later one was already paired can only be dropped; none is lost unseen.
    assert sorted(s.stamp_ns for s in scans) == sorted(
        e.stamp_ns if isinstance(e, DroppedScan) else e.scan.stamp_ns for e in out
    )
    if not late:
        assert [stamps(entry) for entry in out] == [stamps(entry) for entry in expected]


@settings(deadline=None)
@given(st.lists(st.integers(0, 3000), min_size=2, max_size=80), st.lists(st.integers(0, 3000), max_size=15))
def test_every_measurement_is_in_order_and_covered_up_to_the_last_sample(imu: list[int], begins: list[int]) -> None:
    out, sequencer = feed(imu, [scan(begin) for begin in begins])
    assert len(out) == len(begins)
    previous_end = None
    for entry in out:
        if isinstance(entry, DroppedScan):
            assert entry.reason
            continue
        times = entry.imu.stamps_ns
        assert (np.diff(times) > 0).all()
        assert times[0] <= max(entry.scan.stamp_ns, previous_end or 0)
        assert times[-1] >= entry.scan.end_ns or times[-1] == sequencer.newest_imu_ns
        assert (times[:-1] < entry.scan.end_ns).all()
        if previous_end is not None:
            assert entry.scan.end_ns > previous_end
            assert times[0] <= previous_end and (times[1:] > previous_end).all()
        previous_end = entry.scan.end_ns


def test_scans_before_a_late_imu_are_dropped_and_the_rest_is_kept() -> None:
    out, _ = feed(samples(250, 620), [scan(100 * n) for n in range(6)])
    assert dropped(out) == [
        (0, "the IMU starts after it"),
        (100, "the IMU starts after it"),
        (200, "the IMU starts after it"),
    ]
    assert stamps(out[3]) == samples(250, 400)


@pytest.mark.parametrize("overlap_us", [1, 3_000, 30_000])
def test_scans_that_overlap_the_one_before_are_used(overlap_us: int) -> None:
    """By a rounded stamp, or as clouds of two LiDARs together do; a sample falls on the end of each scan."""
    scans = [replace(scan(100 * n), stamp_ns=100 * n * MS - (n > 0) * overlap_us * 1000) for n in range(5)]
    out, _ = feed(samples(-10, 520), scans)
    assert not dropped(out)
    assert [stamps(entry)[-1] >= 100 * n for n, entry in enumerate(out)] == [True] * 5


def test_a_scan_sent_again_with_a_slightly_later_stamp_is_dropped() -> None:
    out, _ = feed(samples(-10, 320), [scan(0), scan(100), replace(scan(100), stamp_ns=100 * MS + 1000), scan(200)])
    assert dropped(out) == [(100, "most of it is from the time of the scan before it")]


def told(entries: Sequence[Measurement | DroppedScan]) -> dict[int, tuple[str, ...]]:
    """What is noted, by the start of the scan in ms."""
    used = [entry for entry in entries if isinstance(entry, Measurement)]
    return {entry.scan.stamp_ns // MS: entry.notices for entry in used if entry.notices}


def test_scans_after_the_imu_stopped_are_used_and_it_is_told_once() -> None:
    out, sequencer = feed(samples(0, 350), [scan(100 * n) for n in range(9)])
    assert dropped(out) == []
    assert [stamps(entry) for entry in out[3:]] == [samples(300, 350), *[[350]] * 5]
    assert told(out) == {400: ("the IMU has fallen silent: until it is back, the LiDAR alone shows the motion",)}
    assert (sequencer.counts.imu_gaps, sequencer.counts.longest_imu_gap_s) == (1, 0.55)


def test_scans_are_used_through_a_gap_of_any_length_and_its_length_is_told_at_its_end() -> None:
    out, sequencer = feed([*samples(0, 250), *samples(30_000, 30_400)], [scan(100 * n) for n in range(303)])
    assert len(out) == 303 and dropped(out) == []
    first, second = told(out)
    assert (first, told(out)[second]) == (300, ("no IMU sample for 29.750 s",))
    assert 0 < 30_000 - second <= 100 * (MAX_WAITING + 1), "told by the first scan that knows"
    assert stamps(out[100]) == [250] and stamps(out[299]) == [250, 30_000]
    assert stamps(out[301])[0] == 30_100
    assert sequencer.counts.imu_gaps == 1


def test_one_that_goes_on_from_a_copy_within_a_gap_gives_the_same() -> None:
    sequencer, out = Sequencer(ImuParams()), []
    for at in samples(0, 250):
        push(sequencer, at)
    for n in range(100):
        sequencer.add_scan(scan(100 * n))
        out += sequencer.ready()
    ends = []
    for one in (sequencer.copy(), sequencer):
        for at in samples(10_000, 10_300):
            push(one, at)
        one.add_scan(scan(10_000))
        rest = [*one.ready(), *one.finish()]
        ends.append(([stamps(entry) for entry in rest], told(rest)))
    assert ends[0] == ends[1] and len(out) + len(ends[0][0]) == 101


def test_more_scans_wait_only_as_long_as_they_may() -> None:
    sequencer = Sequencer(ImuParams())
    for arrived in (*samples(0, 110), scan(0), scan(100), scan(200), scan(300)):
        push(sequencer, arrived)
    assert len(list(sequencer.ready())) == 1 and sequencer.waiting == 3
    assert len(list(sequencer.ready(1))) == 2 and sequencer.waiting == 1
    assert len(list(sequencer.ready(0))) == 1 and sequencer.waiting == 0


def test_a_silent_imu_does_not_fill_the_memory() -> None:
    sequencer = Sequencer(ImuParams())
    for at in samples(0, 110):
        push(sequencer, at)
    out: list[Measurement | DroppedScan] = []
    for number in range(3 * MAX_WAITING):
        sequencer.add_scan(scan(100 * number))
        out += sequencer.ready()
    assert len(out) >= 2 * MAX_WAITING - 1
    assert sequencer.waiting == MAX_WAITING and all(isinstance(entry, Measurement) for entry in out)


def test_a_silent_lidar_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.sensors.sequencer.MAX_SAMPLES", 1000)
    sequencer = Sequencer(ImuParams())
    for arrived in (*samples(0, 110), scan(0), *samples(120, 50_000)):
        push(sequencer, arrived)
        list(sequencer.ready())
    push(sequencer, scan(49_800))
    (after,) = sequencer.ready()
    assert isinstance(after, Measurement) and len(after.imu.stamps_ns) <= 1000
    assert stamps(after)[0] == 100 and stamps(after)[-1] == 49_900
    assert any("no IMU sample for" in notice for notice in after.notices), "what was given up is told as a gap"


def test_scans_inside_an_imu_outage_are_used_and_it_is_reported_once() -> None:
    out, sequencer = feed([*samples(0, 210), *samples(480, 800)], [scan(100 * n) for n in range(7)])
    used = {entry.scan.stamp_ns // MS: entry for entry in out if isinstance(entry, Measurement)}
    assert list(used) == [0, 100, 200, 300, 400, 500, 600]
    assert stamps(used[300]) == [210, 480] and stamps(used[400])[:2] == [210, 480]
    assert {begin: entry.notices for begin, entry in used.items() if entry.notices} == {
        200: ("no IMU sample for 0.270 s",)
    }
    assert sequencer.counts.imu_gaps == 1


def test_a_scan_partly_in_a_gap_is_used_and_reported() -> None:
    out, _ = feed([*samples(0, 160), *samples(270, 400)], [scan(0), scan(100), scan(200), scan(300)])
    assert dropped(out) == []
    assert stamps(out[1]) == [*samples(100, 160), 270]
    assert isinstance(out[1], Measurement) and out[1].notices == ("no IMU sample for 0.110 s",)
    assert stamps(out[2])[:2] == [160, 270] and isinstance(out[2], Measurement) and out[2].notices == ()


def test_repeated_and_reversed_samples_are_left_out_and_reported_once() -> None:
    sequencer = Sequencer(ImuParams())
    order = [*samples(0, 50), 50, 20, 30, 40, *samples(60, 210)]
    for at in order:
        push(sequencer, at)
    sequencer.add_scan(scan(0))
    sequencer.add_scan(scan(100))
    first, second = sequencer.ready()
    assert stamps(first) == samples(0, 100) and stamps(second) == samples(100, 200)
    assert isinstance(first, Measurement)
    assert len(first.notices) == 1 and "stepped back by 0.0300 s" in first.notices[0]
    assert (sequencer.counts.imu_duplicates, sequencer.counts.imu_back_steps) == (1, 1)


def test_neighbouring_samples_that_change_places_on_the_way_are_put_back() -> None:
    sequencer, out, order = Sequencer(ImuParams()), [], samples(0, 510)
    for n in range(5, 50, 5):
        order[n : n + 2] = order[n + 1], order[n]
    for at in range(0, 500, 100):
        sequencer.add_scan(scan(at))
    for at in order:
        push(sequencer, at)
        out += sequencer.ready(most_waiting=5)
    assert [stamps(entry) for entry in out] == [samples(at, at + 100) for at in range(0, 500, 100)] and not told(out)


@pytest.mark.parametrize("ahead_ms", [9_000_000, 900, 200])
def test_one_sample_stamped_far_ahead_does_not_silence_the_rest(ahead_ms: int) -> None:
    sequencer = Sequencer(ImuParams())
    for at in [*samples(0, 50), ahead_ms, *samples(60, 210)]:
        push(sequencer, at)
    sequencer.add_scan(scan(0))
    sequencer.add_scan(scan(100))
    first, second = sequencer.ready()
    assert stamps(first) == samples(0, 100) and stamps(second) == samples(100, 200)
    assert isinstance(first, Measurement) and len(first.notices) == 1 and "stamped far from" in first.notices[0]
    assert (sequencer.counts.imu_far_off, sequencer.counts.imu_behind, sequencer.counts.imu_gaps) == (1, 0, 0)


@pytest.mark.parametrize("wrong_ms", [-1_000_000, 60_000])
def test_a_first_sample_with_a_wrong_stamp_does_not_silence_the_rest(wrong_ms: int) -> None:
    sequencer = Sequencer(ImuParams())
    for at in [wrong_ms, *samples(0, 310)]:
        push(sequencer, at)
    sequencer.add_scan(scan(100))
    sequencer.add_scan(scan(200))
    assert [stamps(entry) for entry in sequencer.ready()] == [samples(0, 200), samples(200, 300)]
    assert (sequencer.counts.imu_far_off, sequencer.counts.longest_imu_gap_s) == (1, 0.0)


def test_the_imu_goes_on_after_an_outage_of_many_seconds() -> None:
    out, sequencer = feed([*samples(0, 110), *samples(5000, 5310)], [scan(0), scan(5000), scan(5100), scan(5200)])
    assert stamps(out[1]) == [100, 110, *samples(5000, 5100)]
    assert len(out) == 4 and dropped(out) == []
    assert sequencer.counts.longest_imu_gap_s == 4.89


def test_repeated_and_reversed_scans_are_dropped_and_the_next_is_used() -> None:
    sequencer = Sequencer(ImuParams())
    for at in samples(0, 500):
        push(sequencer, at)
    out: list[Measurement | DroppedScan] = []
    for begin in (0, 100, 100, 50, 200):
        sequencer.add_scan(scan(begin))
        out += sequencer.ready()
    assert [why.split(" ")[0:3] for _, why in dropped(out)] == [["it", "repeats", "the"], ["its", "time", "steps"]]
    assert [e.scan.stamp_ns // MS for e in out if isinstance(e, Measurement)] == [0, 100, 200]


@pytest.mark.parametrize("before", [1, 2, 10])
def test_missing_scans_are_reported_with_the_next(before: int) -> None:
    begins = [*range(0, 100 * before, 100), 100 * before + 300]
    out, _ = feed(samples(0, 1500), [scan(begin) for begin in begins])
    assert isinstance(out[-1], Measurement)
    assert out[-1].notices == ("no usable scan for 0.400 s before this one (3 missing)",)


def test_a_scan_that_could_not_be_read_keeps_its_place() -> None:
    out, _ = feed(samples(0, 320), [scan(0), DroppedScan(100 * MS, "all its points are NaN"), scan(200)])
    assert dropped(out) == [(100, "all its points are NaN")]
    assert isinstance(out[1], DroppedScan) and stamps(out[2])[0] == 100


@dataclass(frozen=True, slots=True)
class GnssFixes(Samples):
    """A sensor that the program does not know: satellite fixes, (k, 3) degrees and m, and (k,) how many satellites."""

    positions: F64
    satellites: I64


def fix(at_ms: int) -> GnssFixes:
    return GnssFixes(np.array([at_ms * MS]), np.array([[48.0, 11.0, float(at_ms)]]), np.array([at_ms // 50]))


def fix_times(entry: Measurement | DroppedScan) -> list[int]:
    """Times of a measurement's fixes, ms, whose rows must have stayed together."""
    assert isinstance(entry, Measurement)
    if GnssFixes not in entry.streams:
        return []
    fixes = entry.streams[GnssFixes]
    assert isinstance(fixes, GnssFixes)
    times = (fixes.stamps_ns // MS).tolist()
    assert fixes.positions[:, 2].tolist() == times and fixes.satellites.tolist() == [at // 50 for at in times]
    assert not fixes.positions.flags.writeable
    return times


def test_samples_of_another_sensor_come_once_with_the_scan_that_they_fall_into() -> None:
    sequencer, out = Sequencer(ImuParams()), []
    for at in samples(0, 500):
        push(sequencer, at)
        if at % 50 == 0:
            sequencer.add(fix(at))
        if at % 100 == 0 and at:
            sequencer.add_scan(scan(at - 100))
            out += sequencer.ready()
    assert [fix_times(entry) for entry in out] == [[0, 50, 100], [150, 200], [250, 300], [350, 400]]


def test_a_late_sample_of_another_sensor_comes_with_the_next_scan_and_covers_nothing() -> None:
    sequencer = Sequencer(ImuParams())
    for at in samples(0, 310):
        push(sequencer, at)
    sequencer.add_scan(scan(0))
    out = list(sequencer.ready())  # a scan does not wait for other sensors
    assert fix_times(out[0]) == [] and out[0].streams == {}  # type: ignore[union-attr]  # fix_times asserts it
    for at in (150, 60, 220):
        sequencer.add(fix(at))
    before = sequencer.copy()
    sequencer.add_scan(scan(100))
    sequencer.add_scan(scan(200))
    assert [fix_times(entry) for entry in sequencer.ready()] == [[60, 150], [220]]
    before.add_scan(scan(100))
    assert [fix_times(entry) for entry in before.ready()] == [[60, 150]]


def test_a_sensor_without_scans_does_not_fill_the_memory() -> None:
    sequencer = Sequencer(ImuParams())
    many = np.arange(2 * MAX_HELD) * MS
    sequencer.add(GnssFixes(many, np.zeros((2 * MAX_HELD, 3)), np.zeros(2 * MAX_HELD, np.int64)))
    for at in samples(0, 110):
        push(sequencer, at)
    sequencer.add_scan(scan(0))
    assert fix_times(next(sequencer.ready())) == []  # the oldest were given up
