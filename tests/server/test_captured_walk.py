"""The packets of a walk as a capture file: the same walk, up to the resolution of the packets."""

from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.feed import packets_of
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.params import Params
from app.slam.types import F64, I64, Measurement
from tests.sensors.live import captures

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "cloister.mcap"
PORTS = (6699, 7788, 6700)


def walked(path: Path, params: Params, length_s: float | None) -> tuple[I64, F64]:
    """Ends of scans (n,), ns, and where odometry has the IMU then (n, 3), m."""
    engine = Engine(params)
    with open_recording(path, params) as recording:
        results = [
            engine.step(m.scan, m.imu) for m in recording.measurements(0, length_s) if isinstance(m, Measurement)
        ]
    engine.close()
    return np.array([r.stamp_ns for r in results]), np.array([r.state.p_odom_imu for r in results])


@pytest.mark.parametrize(("name", "length_s"), [("cloister", 8.0), ("hall_bpearl", 5.0), ("outdoor_bpearl", 5.0)])
def test_from_its_packets_a_walk_is_within_their_steps_at_every_frame(
    name: str, length_s: float, shared_data: Path, tmp_path: Path
) -> None:
    """The sample as far as its black passage, where only the IMU says how far one has gone."""
    path = SAMPLE if name == "cloister" else shared_data / f"{name}.mcap"
    params = resolve_params(path, "h2lid-mount", None, [])
    with open_recording(path, params) as recording:
        sent = [(one.time_ns, PORTS[one.stream], one.data) for one in packets_of(recording, length_s)]
    capture = tmp_path / f"{name}.pcap"
    capture.write_bytes(captures.pcap(sent))
    (ends, positions), (again, there) = walked(path, params, length_s), walked(capture, params, None)
    assert len(again) == len(ends)
    assert np.abs(again - ends).max() < 2_000
    assert np.linalg.norm(there - positions, axis=1).max() < 0.005
