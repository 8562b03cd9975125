"""A new type of point-cloud message is one entry in the table and one function; nothing else changes."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from app.sensors.cloud_types import CLOUD_TYPES, CloudMessage, CloudType
from app.sensors.doctor import examine
from app.sensors.live.foxglove import Channel, FoxgloveReceiver
from app.sensors.live.foxglove_server import FoxgloveServer
from app.sensors.live.intake import Intake
from app.sensors.recording import open_recording
from app.sensors.ros import stamp_ns
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors import rig

KIND, PART = "example_driver/msg/Packet", "example_driver/msg/Echo"
STORE = rig.TYPESTORES[2]
STORE.register(get_types_from_msg("float32 x\nfloat32 y\nfloat32 z\nuint8 line\nuint32 delay", PART))
STORE.register(get_types_from_msg("std_msgs/Header header\nexample_driver/Echo[] echoes", KIND))

ECHO = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("line", "u1"), ("delay", "<u4")])


def read_packet(message: Any) -> CloudMessage:
    """The one function: microseconds after the header's stamp, a line number, points in metres."""
    rows = np.array([(e.x, e.y, e.z, e.line, e.delay) for e in message.echoes], ECHO)
    assert ECHO.fields is not None
    fields = {name: (at, kind) for name, (kind, at, *_) in ECHO.fields.items()}
    stamp, size = stamp_ns(message.header.stamp), ECHO.itemsize
    return CloudMessage(stamp, 1, len(rows), size, rows.nbytes, fields, rows.view(np.uint8))


ENTRY = CloudType(KIND, read_packet, times=("delay",), rings=("line",), intensities=("strength",), time_unit="us")


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CLOUD_TYPES, KIND, ENTRY)


def walk() -> list[rig.Entry]:
    """Revolutions as messages of that type; a driver of it stamps the first point."""
    entries = []
    for topic, log_ns, message in rig.walk(turns=14, columns=30):
        if topic == "/points":
            made = rig.turn((log_ns - rig.START_NS) // rig.PERIOD_NS - 1, 30)
            delays = made.offsets_ns // 1_000
            echoes = [
                STORE.types[PART](*map(float, point), line=int(line), delay=int(delay))
                for point, line, delay in zip(made.points, made.ring, delays, strict=True)
            ]
            message = STORE.types[KIND](header=rig.header(made.begin_ns, 2), echoes=echoes)
        entries.append((topic, log_ns, message))
    return entries


def check(found: list[Measurement]) -> None:
    assert len(found) >= 10
    for turn, measurement in enumerate(found):
        truth, scan = rig.turn(turn, 30), measurement.scan
        np.testing.assert_array_equal(scan.points, truth.points.astype(np.float32))
        np.testing.assert_array_equal(scan.ring, truth.ring)
        assert scan.stamp_ns == truth.begin_ns
        assert np.abs(scan.offsets_ns - truth.offsets_ns).max() < 1_000


@pytest.mark.parametrize("cut", [False, True])
def test_a_recording_of_a_new_type_is_read(known: None, tmp_path: Path, cut: bool) -> None:
    path = rig.write(tmp_path / "new", walk(), "small-chunks")
    if cut:
        path.write_bytes(path.read_bytes()[:-300])
    found = []
    with open_recording(path, Params()) as recording:
        try:
            found.extend(entry for entry in recording.measurements() if isinstance(entry, Measurement))
        except HemislamError as error:
            assert cut and "damaged" in str(error)
    check(found)


def test_the_doctor_reports_the_conventions_of_a_new_type(known: None, tmp_path: Path) -> None:
    findings = {f.subject: f for f in examine(rig.write(tmp_path / "new", walk()), Params())}
    assert "`delay` (uint32) in us" in findings["point time"].text
    assert "`line` counts 8 scan lines" in findings["ring order"].text
    assert "Packet" in findings["topics"].text


def test_a_type_that_is_not_in_the_table_is_named(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"no topic of type sensor_msgs/msg/PointCloud2.*/points \(example_driver"):
        open_recording(rig.write(tmp_path / "new", walk()), Params())


def test_a_bridge_that_offers_a_new_type_is_understood(known: None) -> None:
    class Kept(Intake):
        """Keeps the scans that are put in."""

        def put_scan(self, scan: Any, arrival_ns: int) -> None:
            scans.append(scan)

    scans: list[Any] = []
    stop, params = threading.Event(), Params()
    definition = STORE.generate_msgdef(KIND, ros_version=2)[0]
    with FoxgloveServer("127.0.0.1", 0, [Channel(0, "/points", "cdr", KIND, definition)]) as server:
        receiver = FoxgloveReceiver(Kept(params), "127.0.0.1", server.port, frozenset({"lidar"}))
        thread = threading.Thread(target=receiver, args=(stop,))
        thread.start()
        try:
            assert server.wait_for_subscribers(10.0)
            messages = [(log_ns, message) for topic, log_ns, message in walk() if topic == "/points"]
            for log_ns, message in messages:
                server.publish(0, log_ns, bytes(STORE.serialize_cdr(message, KIND)))
            deadline = threading.Event()
            for _ in range(100):
                if len(scans) == len(messages):
                    break
                deadline.wait(0.05)
        finally:
            stop.set()
            thread.join(10.0)
    assert len(scans) == len(messages)
    for turn, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.points, rig.turn(turn, 30).points.astype(np.float32))
