"""CustomMsg of the Livox drivers: messages written by rosbags are read point by point; possible faults are handled.

Tests app/sensors/livox.py, app/sensors/clocks.py.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from app.sensors import ros
from app.sensors.cloud_types import CloudError, read_custom_msg, read_point_cloud_2
from app.sensors.doctor import examine
from app.sensors.livox import DRIVERS
from app.sensors.recording import open_recording
from app.sensors.ros import Deserialiser
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement
from tests.sensors import rig

POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n{}/CustomPoint[] points"
)
for store in rig.TYPESTORES.values():
    for driver in DRIVERS:
        store.register(get_types_from_msg(POINT, f"{driver}/msg/CustomPoint"))
        store.register(get_types_from_msg(MESSAGE.format(driver), f"{driver}/msg/CustomMsg"))


def message(turn: rig.Turn, driver: str = DRIVERS[0], ros: int = 2, **other: Any) -> Any:
    """The turn's points with reflectivity 10, 11, …, tag 16 and line 0 to 3, stamped at the first of them."""
    types = rig.TYPESTORES[ros].types
    tags = other.pop("tags", np.full(len(turn), 16))
    points = [
        types[f"{driver}/msg/CustomPoint"](int(after), *map(float, xyz), 10 + n % 200, int(tag), n % 4)
        for n, (after, xyz, tag) in enumerate(zip(turn.offsets_ns, turn.points, tags, strict=True))
    ]
    content = {"timebase": turn.begin_ns, "point_num": len(points), "lidar_id": 192, "rsvd": np.zeros(3, np.uint8)}
    header = rig.header(turn.begin_ns, ros)
    return types[f"{driver}/msg/CustomMsg"](header=header, points=points, **content | other)


def encoded(made: Any, ros: int = 2, *, little: bool = True) -> tuple[bytes, str, str]:
    """Its bytes, type and encoding."""
    kind, store = made.__msgtype__, rig.TYPESTORES[ros]
    if ros == 1:
        return bytes(store.serialize_ros1(made, kind)), kind, "ros1"
    return bytes(store.serialize_cdr(made, kind, little_endian=little)), kind, "cdr"


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize(("ros", "little"), [(1, True), (2, True), (2, False)])
def test_every_point_is_read_as_it_was_written(driver: str, ros: int, little: bool) -> None:
    turn = rig.turn(columns=30)
    cloud = read_custom_msg(Deserialiser().read(*encoded(message(turn, driver, ros), ros, little=little)))
    assert cloud.stamp_ns == turn.begin_ns and len(cloud) == len(turn)
    np.testing.assert_array_equal(cloud.xyz(), turn.points.astype(np.float32))
    np.testing.assert_array_equal(cloud.column("offset_time"), turn.offsets_ns)
    np.testing.assert_array_equal(cloud.column("reflectivity"), 10 + np.arange(len(turn)) % 200)
    np.testing.assert_array_equal(cloud.column("line"), np.arange(len(turn)) % 4)


@pytest.mark.parametrize("ros", [1, 2])
def test_half_a_message_and_a_count_that_lies_are_refused_with_both_numbers(ros: int) -> None:
    turn = rig.turn(columns=30)
    data, kind, encoding = encoded(message(turn, ros=ros), ros)
    with pytest.raises(CloudError, match=r"states 240 points, but holds 1\d\d"):
        read_custom_msg(Deserialiser().read(data[: len(data) // 2], kind, encoding))
    for stated in (0, 239, 241, 2**32 - 1):
        lying = Deserialiser().read(*encoded(message(turn, ros=ros, point_num=stated), ros))
        with pytest.raises(CloudError, match=f"states {stated} points, but holds 240"):
            read_custom_msg(lying)


def test_returns_of_low_confidence_are_left_out() -> None:
    """As `CustomMsg`, and as PointCloud2 of the same driver. Elsewhere a field `tag` means something else."""
    turn = rig.turn(columns=30)
    tags = np.where(np.arange(len(turn)) % 3, 16, 32)
    own = read_custom_msg(Deserialiser().read(*encoded(message(turn, tags=tags))))
    fields = [*rig.Layout().fields[:4], ("tag", "u1", "ground"), ("line", "u1", "ring"), ("timestamp", "f8", "time")]
    standard = read_point_cloud_2(rig.message(replace(turn, ground=tags), rig.Layout(fields)))
    del fields[5]
    other = read_point_cloud_2(rig.message(replace(turn, ground=tags), rig.Layout(fields)))
    for cloud, kept in ((own, tags == 16), (standard, tags == 16), (other, tags > 0)):
        np.testing.assert_array_equal(np.abs(cloud.xyz()).any(axis=1), kept)


def walk(tmp_path: Path, turns: int = 14, **damage: Any) -> Path:
    """A recording; `damage`: what every second message states otherwise."""
    entries = []
    for topic, log_ns, made in rig.walk(turns=turns, columns=60):
        if topic == "/points":
            number = (log_ns - rig.START_NS) // rig.PERIOD_NS - 1
            made = message(rig.turn(number, 60), **(damage if number % 2 else {}))
        entries.append((topic, log_ns, made))
    return rig.write(tmp_path / "livox", entries, "mcap")


def test_a_recording_is_read_without_an_option(tmp_path: Path) -> None:
    path = walk(tmp_path)
    with open_recording(path, Params()) as recording:
        found = [entry for entry in recording.measurements() if isinstance(entry, Measurement)]
    assert len(found) >= 10
    for number, measurement in enumerate(found):
        turn = rig.turn(number, 60)
        assert measurement.scan.stamp_ns == turn.begin_ns
        np.testing.assert_array_equal(measurement.scan.points, turn.points.astype(np.float32))
        np.testing.assert_array_equal(measurement.scan.offsets_ns, turn.offsets_ns)
    (timing,) = (finding for finding in examine(path, Params()) if finding.subject == "point time")
    assert timing.verdict == "fine" and "`offset_time` (uint32) in ns" in timing.text


def test_a_message_that_lies_is_dropped_and_the_others_stay(tmp_path: Path) -> None:
    with open_recording(walk(tmp_path, point_num=7), Params()) as recording:
        found = list(recording.measurements())
    dropped = [entry.reason for entry in found if isinstance(entry, DroppedScan)]
    assert len(dropped) == 7 and set(dropped) == {"the cloud states 7 points, but holds 480"}
    assert sum(isinstance(entry, Measurement) for entry in found) >= 5


def findings(path: Path, subject: str, *settings: str) -> list[str]:
    """What the doctor says of it, in sentences."""
    found = examine(path, Params().with_assignments(list(settings)))
    return [f"{one.verdict}: {one.text} {one.option}" for one in found if one.subject == subject]


def test_a_recording_of_halves_says_that_points_are_missing(tmp_path: Path) -> None:
    entries = list(rig.walk(turns=14, columns=60))
    path = tmp_path / "halves.mcap"
    with path.open("wb") as file:
        writer = ros.RecordingWriter(file, ros.MID360_LAYOUT)
        for topic, log_ns, made in entries:
            if topic == "/imu":
                writer.add_imu(ros.stamp_ns(made.header.stamp), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), log_ns)
                continue
            data = encoded(message(rig.turn((log_ns - rig.START_NS) // rig.PERIOD_NS - 1, 60)))[0]
            writer._add(writer._lidar, data[: len(data) // 2], log_ns)
        writer.finish()
    (text,) = findings(path, "use")
    assert "usable point" in text and "states 480 points, but holds 2" in text


def test_a_recording_without_one_certain_return_says_so(tmp_path: Path) -> None:
    entries = [
        (topic, log_ns, message(rig.turn(0, 60), tags=np.full(480, 0x20)) if topic == "/points" else made)
        for topic, log_ns, made in rig.walk(turns=14, columns=60)
    ]
    (text,) = findings(rig.write(tmp_path / "doubt", entries, "mcap"), "use")
    assert "needs you" in text and "has a usable point" in text and "NaN or zero" in text


def test_g_that_is_said_to_be_metres_per_second_squared_is_contradicted(tmp_path: Path) -> None:
    entries = []
    for topic, log_ns, made in rig.walk(turns=30, columns=60):
        if topic == "/imu":
            made.linear_acceleration.z /= 9.80665
        entries.append((topic, log_ns, made))
    path = rig.write(tmp_path / "g", entries, "mcap")
    assert findings(path, "IMU units")[0].startswith("corrected: g")
    (text,) = findings(path, "IMU units", "recording.acceleration_unit=m/s2")
    assert text.startswith("needs you") and "not gravity in it" in text and "acceleration_unit=auto" in text


def test_clocks_a_year_apart_are_reported_with_the_offset_that_mends_it(tmp_path: Path) -> None:
    year_ns = 365 * 86_400 * 10**9
    entries = []
    for topic, log_ns, made in rig.walk(turns=30, columns=60):
        if topic == "/imu":
            made.header = rig.header(ros.stamp_ns(made.header.stamp) - year_ns, 2)
        entries.append((topic, log_ns, made))
    path = rig.write(tmp_path / "year", entries, "mcap")
    (text,) = findings(path, "clocks")
    assert text.startswith("needs you") and "behind" in text and "recording.imu_time_offset=3153" in text
    with open_recording(path, Params().with_assignments(["recording.imu_time_offset=31536000"])) as recording:
        assert sum(isinstance(one, Measurement) for one in recording.measurements()) > 25


@pytest.mark.parametrize("late_ns", [0, 40_000_000])
def test_two_lidars_on_one_topic_are_noticed(late_ns: int, tmp_path: Path) -> None:
    entries = list(rig.walk(turns=20, columns=60))
    assert findings(rig.write(tmp_path / "one", entries, "mcap"), "scans") == []
    second = []
    for topic, log_ns, made in entries:
        if topic == "/points":
            stamp = ros.stamp_ns(made.header.stamp) + late_ns
            times = made.data.reshape(made.width, made.point_step)
            second.append((topic, log_ns + late_ns + 1_000_000, later(made, times.copy(), stamp, late_ns)))
    both = sorted(entries + second, key=lambda entry: entry[1])
    (text,) = findings(rig.write(tmp_path / "two", both, "mcap"), "scans")
    assert text.startswith("needs you") and "two LiDARs" in text and "/points" in text


def later(made: Any, points: Any, stamp_ns: int, by_ns: int) -> Any:
    """The same cloud but one point, measured later."""
    field = next(one for one in made.fields if one.name == "timestamp")
    seconds = points[:, field.offset : field.offset + 8].copy().view("<f8")
    points[:, field.offset : field.offset + 8] = (seconds + by_ns * 1e-9).view(np.uint8)
    points = points[1:]
    values = {name: value for name, value in vars(made).items() if not name.startswith("__")}
    return type(made)(
        **values
        | {
            "header": rig.header(stamp_ns, 2),
            "width": len(points),
            "row_step": points.size,
            "data": points.reshape(-1),
        }
    )
