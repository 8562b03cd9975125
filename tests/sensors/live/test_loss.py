"""The effect of a bad network on the map: a capture of a walk with lost, duplicated and reordered packets."""

from pathlib import Path

import numpy as np
import pytest

from app.sensors.live.feed import packets_of
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors.live import captures

SAMPLE = Path(__file__).resolve().parents[3] / "sample_data" / "cloister.mcap"
SECONDS = 8.0
PORTS = (6699, 7788, 6700)


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, [])


@pytest.fixture(scope="module")
def sent(params: Params) -> list[captures.Entry]:
    with open_recording(SAMPLE, params) as recording:
        return [(one.time_ns, PORTS[one.stream], one.data) for one in packets_of(recording, SECONDS)]


def walked(sent: list[captures.Entry], path: Path, params: Params) -> np.ndarray:
    """(n, 3) positions at the ends of scans, of a capture that is written to `path`."""
    path.write_bytes(captures.pcap(sent))
    engine = Engine(params)
    with open_recording(path, params) as recording:
        found = (entry for entry in recording.measurements(0.0, SECONDS) if isinstance(entry, Measurement))
        positions = [engine.step(one.scan, one.imu).T_map_imu[:3, 3] for one in found]
    engine.close()
    return np.array(positions)


@pytest.fixture(scope="module")
def whole(params: Params, sent: list[captures.Entry], tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Of the walk without losses."""
    return walked(sent, tmp_path_factory.mktemp("whole") / "whole.pcap", params)


@pytest.mark.parametrize(("share", "apart_m"), [(0.01, 0.01), (0.1, 0.03)])
def test_the_map_is_right_though_packets_are_lost_doubled_and_overtaken(
    params: Params, sent: list[captures.Entry], whole: np.ndarray, tmp_path: Path, share: float, apart_m: float
) -> None:
    """Of the LiDAR's packets; as many are doubled and swapped with the next one as are lost."""
    rng = np.random.default_rng(3)
    arrived: list[captures.Entry] = []
    for entry, chance in zip(sent, rng.random(len(sent)), strict=True):
        if entry[1] != PORTS[0] or chance >= 3 * share:
            arrived.append(entry)
        elif chance >= 2 * share:
            arrived += [entry, entry]
        elif chance >= share:
            arrived.insert(len(arrived) - 1, entry)
    missing = {packet for _, port, packet in sent if port == PORTS[0]} - {packet for *_, packet in arrived}
    assert 0.8 * share < len(missing) / len(sent) < share
    bad = walked(arrived, tmp_path / "bad.pcap", params)
    assert len(bad) == len(whole) > 70
    assert np.linalg.norm(whole - whole[0], axis=1).max() > 1.0
    away = np.linalg.norm(bad - whole, axis=1).max()
    assert away < apart_m
