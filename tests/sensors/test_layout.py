"""Everything that a driver leaves undefined is inferred correctly from the data, and the decision is explained."""

from dataclasses import replace

import numpy as np
import pytest

from app.sensors.cloud_types import Probe, read_point_cloud_2
from app.sensors.findings import Finding
from app.sensors.layout import settle_cloud
from app.sensors.pointcloud import CloudLayout, decode
from app.sensors.rings import line_findings
from app.slam.errors import HemislamError
from app.slam.sections import RecordingParams, SensorParams
from app.slam.types import Scan
from tests.sensors import rig

XYZ = [("x", "f4", "x"), ("y", "f4", "y"), ("z", "f4", "z")]
RING = ("ring", "u2", "ring")
FIRING_NS = rig.PERIOD_NS // 160


def clouds(layout: rig.Layout, *, log_delay_ns: int = 3_000_000, turns: int = 4, **how: object) -> list[Probe]:
    """Revolutions of 160 firings, logged so long after their end."""
    made = [rig.turn(number, columns=20, **how) for number in range(turns)]
    return [Probe(m.begin_ns + rig.PERIOD_NS + log_delay_ns, read_point_cloud_2(rig.message(m, layout))) for m in made]


def settle(probes: list[Probe], **chosen: object) -> tuple[CloudLayout, dict[str, Finding]]:
    layout, findings = settle_cloud(probes, RecordingParams(**chosen), "/points")
    return layout, {finding.subject: finding for finding in findings}


def time_error_ns(probe: Probe, layout: CloudLayout, number: int = 0, **how: object) -> int:
    """Worst error of a point's time in the decoded cloud."""
    scan = decode(probe.cloud, layout)
    made = rig.turn(number, columns=20, **how)
    return int(np.abs(scan.stamp_ns + scan.offsets_ns.astype(np.int64) - made.begin_ns - made.offsets_ns).max())


def relative(kind: str = "f4", unit_ns: int = 10**9, **how: object) -> rig.Layout:
    return rig.Layout([*XYZ, RING, ("time", kind, "time")], unit_ns, absolute=False, **how)


# --- the points' time --------------------------------------------------------------------------------
def test_times_counted_up_from_the_first_point_start_at_a_header_logged_a_scan_earlier() -> None:
    probes = clouds(relative(header="first"))
    layout, findings = settle(probes)
    assert time_error_ns(probes[0], layout) < 1_000
    assert findings["header stamp"].verdict == "fine"
    assert "first point" in findings["header stamp"].text


def test_a_header_at_the_last_point_is_noticed_because_the_cloud_was_logged_too_soon() -> None:
    probes = clouds(relative(header="last"))
    layout, findings = settle(probes)
    assert time_error_ns(probes[0], layout) < FIRING_NS + 1_000
    assert findings["header stamp"].verdict == "corrected"
    assert findings["header stamp"].option == "--set recording.header_stamp=first"


def test_a_correct_decision_offers_its_option_only_in_case_it_is_wrong() -> None:
    """A user who applies every option of a report must not undo correct decisions."""
    right = Finding("header stamp", "fine", "of the first point", "--set recording.header_stamp=last")
    assert str(right) == "of the first point (if that is wrong: --set recording.header_stamp=last)"
    assert str(replace(right, verdict="needs you")) == "of the first point --set recording.header_stamp=last"
    assert str(replace(right, option="")) == "of the first point"


def test_the_user_overrides_the_header_convention() -> None:
    probes = clouds(relative(header="last"))
    layout, _ = settle(probes, header_stamp="first")
    assert abs(time_error_ns(probes[0], layout) - rig.PERIOD_NS) < 1_000


def test_negative_times_lead_up_to_the_header() -> None:
    probes = clouds(relative(header="last", time_from="last"))
    layout, findings = settle(probes)
    assert time_error_ns(probes[0], layout) < 1_000
    assert "negative" in findings["header stamp"].text


@pytest.mark.parametrize("within", [0.3, 0.5])
def test_times_before_and_after_the_header_count_from_it(within: float) -> None:
    ahead_ns = round((1.0 - within) * rig.PERIOD_NS)
    probes = []
    for number in range(4):
        made = rig.turn(number, columns=20)
        later = replace(made, begin_ns=made.begin_ns - ahead_ns)  # its end is then where the header is to be
        message = rig.message(replace(later, offsets_ns=made.offsets_ns + ahead_ns), relative(time_from="last"))
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS + 3_000_000, read_point_cloud_2(message)))
    layout, findings = settle(probes)
    assert time_error_ns(probes[0], layout) < 1_000
    assert "within the scan" in findings["header stamp"].text


def test_a_log_time_copied_from_the_header_is_no_evidence_about_it() -> None:
    probes = [Probe(p.cloud.stamp_ns, p.cloud) for p in clouds(relative(header="first"))]
    layout, _ = settle(probes)
    assert time_error_ns(probes[0], layout) < 1_000


@pytest.mark.parametrize("header", ["first", "last"])
def test_a_sensor_clock_since_power_on_is_tied_to_the_header(header: str) -> None:
    layout = rig.Layout(header=header, clock_ns=-rig.START_NS + 47 * 10**9)
    probes = clouds(layout)
    settled, findings = settle(probes)
    assert time_error_ns(probes[0], settled) < FIRING_NS + 1_000
    assert findings["time reference"].verdict == "corrected"
    assert "clock of its own" in findings["time reference"].text
    assert f"{header} point" in findings["header stamp"].text


def test_a_simulator_clock_that_starts_at_zero_is_absolute() -> None:
    layout = rig.Layout(clock_ns=-rig.START_NS)
    probes = []
    for number in range(4):
        made = rig.turn(number, columns=20)
        message = rig.message(made, layout)
        message.header = rig.header(made.begin_ns + rig.PERIOD_NS - rig.START_NS, 2)
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS - rig.START_NS, read_point_cloud_2(message)))
    settled, findings = settle(probes)
    scan = decode(probes[2].cloud, settled)
    assert abs(scan.stamp_ns - 2 * rig.PERIOD_NS) < 1_000
    assert "absolute" in findings["time reference"].text


@pytest.mark.parametrize(
    "names", [("timestampSec", "timestampNsec"), ("t_s", "t_ns"), ("sec", "nanosec"), ("time_seconds", "time_nanosecs")]
)
def test_a_time_in_two_fields_is_put_together_also_in_a_scan_that_crosses_a_full_second(names: tuple[str, str]) -> None:
    layout = rig.Layout([*XYZ, RING, (names[1], "u4", "nanoseconds"), (names[0], "u4", "seconds")])
    turns = [rig.turn(number, columns=20) for number in range(4)]
    for number, made in enumerate(turns, -1):
        made.begin_ns = rig.START_NS + number * rig.PERIOD_NS - 30_000_000  # the second one crosses a full second
    probes = [Probe(m.begin_ns + rig.PERIOD_NS, read_point_cloud_2(rig.message(m, layout))) for m in turns]
    settled, findings = settle(probes)
    for probe, made in zip(probes, turns, strict=True):
        scan = decode(probe.cloud, settled)
        np.testing.assert_array_equal(scan.stamp_ns + scan.offsets_ns.astype(np.int64), made.begin_ns + made.offsets_ns)
    assert f"`{names[0]} + {names[1]}` (int64) in ns" in findings["point time"].text
    assert "absolute" in findings["time reference"].text


def test_seconds_and_nanoseconds_that_are_the_same_time_twice_are_not_added() -> None:
    layout = rig.Layout([*XYZ, RING, ("time_s", "f8", "time"), ("time_ns", "f8", "more")])
    turns = [rig.turn(number, columns=20) for number in range(4)]
    for made in turns:
        made.more = made.offsets_ns  # type: ignore[attr-defined]
    settled, _ = settle([Probe(m.begin_ns + rig.PERIOD_NS, read_point_cloud_2(rig.message(m, layout))) for m in turns])
    assert settled.timing.field == "time_s"


def test_absolute_time_in_a_float32_is_refused_and_derived_from_the_azimuth() -> None:
    layout = rig.Layout([*XYZ, RING, ("timestamp", "f4", "time")])
    probes = clouds(layout)
    settled, findings = settle(probes)
    assert settled.timing.field is None
    assert "float32" in findings["point time"].text
    assert time_error_ns(probes[0], settled) < 8 * FIRING_NS  # one column


def test_a_time_field_that_is_all_zero_is_not_believed() -> None:
    probes = clouds(rig.Layout([*XYZ, RING, ("time", "f4", "nothing")]), turns=0)
    for number in range(4):
        made = rig.turn(number, columns=20)
        made.nothing = np.zeros(len(made))  # type: ignore[attr-defined]
        message = rig.message(made, rig.Layout([*XYZ, RING, ("time", "f4", "nothing")]))
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS + 3_000_000, read_point_cloud_2(message)))
    settled, findings = settle(probes)
    assert settled.timing.field is None
    assert "the same for all points" in findings["point time"].text


def test_a_wrong_unit_is_named_with_the_option_that_helps() -> None:
    _, findings = settle(clouds(relative("u4", 1_000, header="first")), time_unit="ns")
    assert findings["point time"].verdict == "needs you"
    assert findings["point time"].option == "--set recording.time_unit=auto"
    assert "every 0.100 s" in findings["point time"].text


def test_a_missing_time_field_is_refused_with_the_fields_of_the_clouds() -> None:
    with pytest.raises(HemislamError, match=r"no field `tof`.*timestamp"):
        settle(clouds(rig.Layout()), time_field="tof")


def test_made_up_times_that_ignore_the_rotation_are_noticed() -> None:
    probes = []
    for number in range(3):
        made = rig.turn(number, columns=20)
        made = made.only(np.random.default_rng(number).permutation(len(made)))
        made.offsets_ns = np.sort(made.offsets_ns)
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS, read_point_cloud_2(rig.message(made))))
    _, findings = settle(probes)
    assert findings["rotation"].verdict == "needs you"
    assert findings["rotation"].option == "--set recording.time_field=none"


# --- no time at all ----------------------------------------------------------------------------------
@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("header", ["first", "last"])
def test_without_times_the_azimuth_gives_them_in_either_sense_of_rotation(clockwise: bool, header: str) -> None:
    probes = clouds(rig.Layout([*XYZ, RING], header=header), clockwise=clockwise)
    layout, findings = settle(probes)
    assert layout.spin is not None and layout.spin.clockwise == clockwise
    assert time_error_ns(probes[1], layout, 1, clockwise=clockwise) < 8 * FIRING_NS  # one column
    assert findings["point time"].verdict == "corrected"
    assert "10 revolutions per second" in findings["point time"].text


def test_a_line_that_sees_nothing_for_most_of_a_turn_still_gets_its_times() -> None:
    layout = rig.Layout([*XYZ, RING])
    made = rig.turn(0, columns=20)
    blind = (made.ring == 3) & (made.offsets_ns > 15_000_000) & (made.offsets_ns < 85_000_000)
    turns = [rig.turn(number, columns=20).only(~blind) for number in range(3)]
    probes = [Probe(t.begin_ns + rig.PERIOD_NS + 3_000_000, read_point_cloud_2(rig.message(t, layout))) for t in turns]
    settled, _ = settle(probes)
    scan = decode(probes[0].cloud, settled)
    truth = made.only(~blind)
    error = np.abs(scan.stamp_ns + scan.offsets_ns.astype(np.int64) - truth.begin_ns - truth.offsets_ns)
    assert error.max() < 8 * FIRING_NS


def test_points_without_times_in_no_order_of_rotation_are_named() -> None:
    probes, rng = [], np.random.default_rng(0)
    for number in range(4):
        made = rig.turn(number, columns=20)
        shuffled = made.only(rng.permutation(len(made)))
        cloud = read_point_cloud_2(rig.message(shuffled, rig.Layout([*XYZ, RING])))
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS + 3_000_000, cloud))
    _, findings = settle(probes)
    assert findings["point time"].verdict == "needs you" and "no rotation" in findings["point time"].text


def test_a_rotation_rate_that_contradicts_the_clouds_is_named() -> None:
    _, findings = settle(clouds(rig.Layout([*XYZ, RING])), rotation_rate=20.0)
    assert findings["point time"].verdict == "needs you"
    assert "every 0.100 s" in findings["point time"].text


# --- rings -------------------------------------------------------------------------------------------
def test_rings_counted_from_the_top_are_turned_round() -> None:
    probes = []
    for number in range(3):
        made = rig.turn(number, columns=20)
        truth, made.ring = made.ring, 7 - made.ring
        probes.append(Probe(made.begin_ns, read_point_cloud_2(rig.message(made))))
    layout, findings = settle(probes)
    np.testing.assert_array_equal(decode(probes[0].cloud, layout).ring, truth)
    assert findings["ring order"].verdict == "corrected"


def test_lines_that_see_only_sky_at_first_are_counted_all_the_same() -> None:
    """Of eight lines counted from the top, the two lowest see nothing yet."""
    probes, made = [], rig.turn(columns=20)
    for number in range(4):
        made = rig.turn(number, columns=20)
        made.ring = 7 - made.ring
        probes.append(Probe(made.begin_ns, read_point_cloud_2(rig.message(made.only(made.ring < 6)))))
    layout, findings = settle(probes)
    assert "8 scan lines from the highest elevation down" in findings["ring order"].text
    np.testing.assert_array_equal(decode(read_point_cloud_2(rig.message(made)), layout).ring, 7 - made.ring)


@pytest.mark.parametrize(("seen", "given", "wrong"), [(6, 8, False), (6, 12, True), (20, 32, False), (32, 20, True)])
def test_corrections_are_for_as_many_lines_as_the_lidar_may_have(seen: int, given: int, wrong: bool) -> None:
    rings = np.arange(seen, dtype=np.uint16)
    scan = Scan(0, np.ones((seen, 3), np.float32), np.zeros(seen, np.int32), np.zeros(seen, np.float32), rings)
    params = SensorParams(elevation_corrections=" ".join(["0.1"] * given))
    assert bool(line_findings([scan], True, params)) is wrong


def test_rings_in_firing_order_are_ranked_by_elevation() -> None:
    shuffled = np.array([4, 7, 1, 0, 6, 2, 5, 3])
    probes = []
    for number in range(3):
        made = rig.turn(number, columns=20)
        truth, made.ring = made.ring, shuffled[made.ring]
        probes.append(Probe(made.begin_ns, read_point_cloud_2(rig.message(made))))
    layout, findings = settle(probes)
    np.testing.assert_array_equal(decode(probes[0].cloud, layout).ring, truth)
    assert "in no order of elevation" in findings["ring order"].text


@pytest.mark.parametrize("rows", [1, 8])
def test_without_a_ring_field_the_rings_are_derived(rows: int) -> None:
    time = ("timestamp", "f8", "time")
    probes = []
    for number in range(3):
        made = rig.turn(number, columns=20)
        if rows == 8:  # one line a row, as some drivers organise
            made = made.only(np.argsort(made.ring, kind="stable"))
        else:  # returns lost here and there, so that the place in the message tells nothing
            made = made.only(np.random.default_rng(number).random(len(made)) > 0.2)
        message = rig.message(made, rig.Layout([*XYZ, time], rows=rows))
        probes.append((Probe(made.begin_ns, read_point_cloud_2(message)), made.ring))
    layout, findings = settle([probe for probe, _ in probes])
    for probe, truth in probes:
        np.testing.assert_array_equal(decode(probe.cloud, layout).ring, truth)
    assert findings["ring order"].verdict == "corrected"
    assert "8 scan lines" in findings["ring order"].text


def test_lines_are_separated_although_the_beams_start_above_the_origin() -> None:
    """As on the RS-Bpearl: near points of a line appear higher than far ones."""
    rng = np.random.default_rng(1)
    elevations = np.radians(2.3125 + 2.8125 * np.arange(32))
    ring = rng.integers(0, 32, 6000)
    azimuth, distance = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(1.0, 20.0, 6000)
    level = distance * np.cos(elevations[ring]) + 0.01473
    height = distance * np.sin(elevations[ring]) + 0.09427
    points = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), height]).astype(np.float32)
    made = rig.Turn(rig.START_NS, points, np.arange(6000) * 16_000, ring, ring, ring)
    layout = rig.Layout([*XYZ, ("timestamp", "f8", "time")])
    probes = [Probe(rig.START_NS + rig.PERIOD_NS, read_point_cloud_2(rig.message(made, layout)))] * 2
    settled, _ = settle(probes)
    decoded = decode(probes[0].cloud, settled).ring
    assert (decoded == ring).mean() > 0.98
