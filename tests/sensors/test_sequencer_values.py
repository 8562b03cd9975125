"""Values that no IMU can measure are dropped wherever they occur; values of human motion never are.

Tests app/sensors/sequencer.py.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.sensors.sequencer import Sequencer
from app.slam.sections import ImuParams
from app.slam.types import F64, Measurement
from tests.sensors.test_sequencer import MS, push, samples, scan, stamps


def swaying(seed: int, count: int = 200) -> F64:
    """(count, 6) rad/s and m/s^2 at 100 Hz of someone walking fast, with noise and steps of the foot."""
    rng = np.random.default_rng(seed)
    at = np.arange(count)[:, None] / 100
    swing = np.sin(2 * np.pi * rng.uniform(0.5, 4.0, 6) * at + rng.uniform(0, 6, 6)) * [2, 2, 2, 6, 6, 6]
    return np.asarray(swing + rng.normal(size=(count, 6)) * [0.02, 0.02, 0.02, 0.3, 0.3, 0.3])


def given_on(values: F64) -> tuple[list[int], Sequencer]:
    """The samples, by number, that a scan over all of them is given."""
    sequencer = Sequencer(ImuParams())
    for n, row in enumerate(values.tolist()):
        sequencer.add_imu(n * 10 * MS, tuple(row[:3]), tuple(row[3:]))
    sequencer.add_scan(scan(10, 10 * len(values) - 40))
    (only,) = sequencer.ready()
    assert isinstance(only, Measurement)
    return (only.imu.stamps_ns // (10 * MS)).tolist(), sequencer


def test_an_axis_that_freezes_is_stuck_and_one_read_in_coarse_steps_is_not() -> None:
    still = np.random.default_rng(0).normal(size=(600, 6)) * [*[0.002] * 3, *[0.02] * 3] + [0, 0, 0, 0, 0, 9.81]
    step = np.array([0.06] * 3 + [0.3] * 3)
    _, sequencer = given_on(np.vstack([np.rint(swaying(1) / step) * step, np.rint(still / step) * step]))
    assert sequencer.counts.imu_stuck == 0
    still[200:, 2] = still[200, 2]
    _, sequencer = given_on(still)
    assert sequencer.counts.imu_stuck == 1


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_no_sample_of_a_vigorous_walk_is_refused(seed: int) -> None:
    kept, sequencer = given_on(swaying(seed))
    assert kept == list(range(198)) and sequencer.counts.imu_spikes == 0


@given(
    st.integers(0, 1000),
    st.integers(0, 197),
    st.integers(0, 5),
    st.floats(25.0, 1e300) | st.sampled_from([float("nan"), float("inf")]),
    st.sampled_from([-1, 1]),
)
@settings(max_examples=100, deadline=None)
def test_one_bad_sample_is_left_out_wherever_it_is_and_no_other(
    seed: int, place: int, axis: int, size: float, sign: int
) -> None:
    values = swaying(seed)
    values[place, axis] = sign * size
    kept, sequencer = given_on(values)
    counts = sequencer.counts
    assert counts.imu_invalid + counts.imu_out_of_range + counts.imu_spikes >= 1
    assert set(range(198)) - set(kept) <= {place, 0}  # the first may go with its only neighbour
    assert place not in kept


def test_a_bad_sample_is_left_out_also_where_it_arrives_after_the_next() -> None:
    values, sequencer = swaying(5, 60), Sequencer(ImuParams())
    values[30, 4] += 60.0
    for n in (*range(30), 31, 30, *range(32, 60)):
        sequencer.add_imu(n * 10 * MS, tuple(values[n, :3]), tuple(values[n, 3:]))
    sequencer.add_scan(scan(10, 560))
    (only,) = sequencer.ready()
    assert isinstance(only, Measurement)
    assert (only.imu.stamps_ns // MS).tolist() == [at for at in samples(0, 570) if at != 300]
    assert sequencer.counts.imu_spikes == 1


def test_a_shock_that_lasts_is_no_spike() -> None:
    values = swaying(1)
    values[100:104, 3] += [20.0, 60.0, 60.0, 20.0]
    assert given_on(values)[0] == list(range(198))


def test_nan_samples_are_left_out_and_reported() -> None:
    sequencer = Sequencer(ImuParams())
    for at in samples(0, 110):
        push(sequencer, at)
        sequencer.add_imu(at * MS + MS, (float("nan"), 0, 0), (0, 0, 9.81))
    sequencer.add_scan(scan(0))
    (only,) = sequencer.ready()
    assert stamps(only) == samples(0, 100)
    assert sequencer.counts.imu_invalid == 12


def test_a_refused_sample_is_reported_with_the_measurement() -> None:
    sequencer = Sequencer(ImuParams(max_acceleration=20.0))
    for at in samples(0, 200):
        sequencer.add_imu(at * MS, (0.0, 0.0, 0.0), (0.0, 0.0, 25.0 if at == 50 else 9.81))
    sequencer.add_scan(scan(0))
    (only,) = sequencer.ready()
    assert isinstance(only, Measurement) and "beyond what an IMU can measure" in only.notices[0]


def test_samples_without_gravity_are_left_out_and_leave_a_gap() -> None:
    """A driver that has lost its device sends zeros; an IMU with a noisy axis that reads 0 once is none."""
    sequencer = Sequencer(ImuParams())
    for at in samples(0, 500):
        lost = 210 <= at < 410
        sequencer.add_imu(at * MS, (0.0 if lost else at / 1e6, 0.0, 0.0), (0.0, 0.0, 0.0 if lost else 9.81))
    for n in range(4):
        sequencer.add_scan(scan(100 * n, 100))
    out = [entry for entry in sequencer.ready() if isinstance(entry, Measurement)]
    assert [(entry.imu.stamps_ns // MS).tolist() for entry in out[2:]] == [[200, 410], [200, 410]]
    assert sequencer.counts.imu_weightless == 20 and sequencer.counts.imu_gaps == 1
    assert any("not even gravity's" in notice for notice in out[0].notices)
