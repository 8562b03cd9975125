"""A clock set in the middle of a recording: times continue without a jump, and a finding reports the leap."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from app.sensors.doctor import examine
from app.sensors.recording import open_recording
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig

S = 1_000_000_000
TURNS = 240
LEAPS_AT_NS = rig.START_NS + 12 * S
BOOTED_NS = rig.START_NS - 35 * S
"""Power-on of a scanner, whose clock counts from there at first."""

Clock = Callable[[int], int]
"""What a clock shows at a true time."""


def right(now: int) -> int:
    return now


def since_power_on(now: int) -> int:
    return now if now >= LEAPS_AT_NS else now - BOOTED_NS


def set_by(seconds: float) -> Clock:
    return lambda now: now + (round(seconds * S) if now >= LEAPS_AT_NS else 0)


def recorded(path: Path, lidar: Clock, imu: Clock, log: Clock, container: str = "small-chunks") -> Path:
    """A walk whose messages are stamped and logged by these clocks."""
    layout = rig.Layout(absolute=False, fields=rig.RELATIVE, header="first")
    entries, ros = [], 1 if container == "bag" else 2
    for topic, log_ns, sent in rig.walk(TURNS, layout, columns=4, ros=ros):
        begin_ns = log_ns - (500_000 if topic == "/imu" else rig.PERIOD_NS + 3_000_000)
        sent.header = rig.header(imu(begin_ns) if topic == "/imu" else lidar(begin_ns), ros)
        entries.append((topic, log(log_ns), sent))
    return rig.write(path, entries, container)


@pytest.mark.parametrize(
    ("lidar", "imu", "log", "told", "moved_s"),
    [
        (since_power_on, right, right, f"LiDAR leap by +{BOOTED_NS / S:.3f} s;", 0.0),
        (since_power_on, since_power_on, right, f"LiDAR and IMU leap by +{BOOTED_NS / S:.3f} s;", 0.0),
        (set_by(-2), set_by(-2), right, "LiDAR and IMU leap by -2.000 s;", -2.0),
        (set_by(37), right, right, "LiDAR leap by +37.000 s;", 0.0),
        (right, set_by(-2), right, "IMU leap by -2.000 s;", 0.0),
        (right, set_by(37), set_by(37), "IMU and recorder leap by +37.000 s;", 0.0),
        (set_by(37), set_by(37), set_by(37), "LiDAR and IMU and recorder leap by +37.000 s;", 37.0),
        (set_by(3600), set_by(3600), set_by(3600), "LiDAR and IMU and recorder leap by +3600.000 s;", 3600.0),
        (set_by(-2), set_by(-2), set_by(-2), "LiDAR and IMU leap by -2.000 s;", -2.0),
    ],
)
def test_time_goes_on_where_a_clock_is_set(
    tmp_path: Path, lidar: Clock, imu: Clock, log: Clock, told: str, moved_s: float
) -> None:
    path = recorded(tmp_path / "walk", lidar, imu, log)
    with open_recording(path, Params()) as recording:
        (leap,) = [finding for finding in recording.findings if finding.subject == "clock leap"]
        assert leap.verdict == "corrected" and told in leap.text
        assert recording.duration_s == pytest.approx(TURNS / 10, abs=0.1)
        assert recording.start_ns == pytest.approx(rig.START_NS + moved_s * S, abs=3_000_000)
        every = list(recording.measurements())
        part = list(recording.measurements(10.0, 4.0))
    used = [entry for entry in every if isinstance(entry, Measurement)]
    begins = [entry.scan.stamp_ns - recording.start_ns for entry in used]
    assert begins == pytest.approx([number * rig.PERIOD_NS for number in range(TURNS)], abs=3_000_000)
    assert [entry.notices for entry in used if entry.notices] == [(leap.text,)]
    assert all(9 <= len(entry.imu) <= 13 for entry in used[1:])
    assert [entry.scan.stamp_ns for entry in part if isinstance(entry, Measurement)] == [
        entry.scan.stamp_ns for entry in used[100:140]
    ]
    wrong = [finding for finding in examine(path, Params()) if finding.verdict == "needs you"]
    assert {finding.subject for finding in wrong} == {"mount", "rotation"}  # of so few points


@pytest.mark.parametrize(("silent", "name"), [("/points", "LiDAR"), ("/imu", "IMU")])
def test_a_sensor_that_starts_anew_while_the_other_goes_on_was_silent_meanwhile(
    tmp_path: Path, silent: str, name: str
) -> None:
    """Its clock then begins at zero. What passed meanwhile is known by the recorder."""
    layout = rig.Layout(absolute=False, fields=rig.RELATIVE, header="first")
    back_ns, entries = LEAPS_AT_NS + 3 * S, []
    for topic, log_ns, sent in rig.walk(TURNS, layout, columns=4):
        begin_ns = log_ns - (500_000 if topic == "/imu" else rig.PERIOD_NS + 3_000_000)
        if topic == silent and begin_ns >= LEAPS_AT_NS:
            if begin_ns < back_ns:
                continue
            sent.header = rig.header(begin_ns - back_ns, 2)
        entries.append((topic, log_ns, sent))
    with open_recording(rig.write(tmp_path / "walk", entries, "small-chunks"), Params()) as recording:
        (leap,) = [finding for finding in recording.findings if finding.subject == "clock leap"]
        used = [entry.scan for entry in recording.measurements() if isinstance(entry, Measurement)]
    assert f"the times of the {name} leap by {-back_ns / S:.3f} s;" in leap.text
    begins = [(scan.stamp_ns - used[0].stamp_ns) / rig.PERIOD_NS for scan in used]
    expected = [n for n in range(TURNS) if silent == "/imu" or not 120 <= n < 150]
    assert begins == pytest.approx(expected, abs=0.05)


def test_a_clock_may_be_set_twice(tmp_path: Path) -> None:
    def twice(now: int) -> int:
        return since_power_on(now) - (2 * S if now >= LEAPS_AT_NS + 5 * S else 0)

    with open_recording(recorded(tmp_path / "walk", twice, twice, right), Params()) as recording:
        assert [f.text.split(":")[0] for f in recording.findings if f.subject == "clock leap"] == [
            f"a clock was set {seconds} s after the start" for seconds in ("12.0", "17.0")
        ]
        assert sum(isinstance(entry, Measurement) for entry in recording.measurements()) == TURNS


def test_a_pause_is_no_leap(tmp_path: Path) -> None:
    layout = rig.Layout(absolute=False, fields=rig.RELATIVE, header="first")
    entries = [entry for entry in rig.walk(TURNS, layout, columns=4) if not 8 * S < entry[1] - rig.START_NS < 18 * S]
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        assert "clock leap" not in {finding.subject for finding in recording.findings}
        every = list(recording.measurements())
    assert recording.duration_s == pytest.approx(TURNS / 10, abs=0.1)
    assert not [entry for entry in every if isinstance(entry, DroppedScan)]


@pytest.mark.parametrize("container", ["bag", "bare-db3"])
@pytest.mark.parametrize("seconds", [-2, -7])
@pytest.mark.parametrize("alone", [True, False])
def test_parts_that_are_sorted_into_each_other_are_named(
    tmp_path: Path, container: str, seconds: int, alone: bool
) -> None:
    """As rosbags reads these files, if the recorder's clock is set back, alone or with those of the sensors."""
    clock, of_sensors = set_by(seconds), right if alone else set_by(seconds)
    path = recorded(tmp_path / "walk", of_sensors, of_sensors, clock, container)
    (found,) = [finding for finding in examine(path, Params()) if finding.subject == "log times"]
    assert found.verdict == "needs you" and "clock was set back" in found.text
    said = re.fullmatch(r"--duration ([\d.]+), and --start ([\d.]+)", found.option)
    assert said is not None and [float(one) for one in said.groups()] == pytest.approx([12 + seconds, 12], abs=0.15)
