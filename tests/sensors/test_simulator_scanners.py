"""Recordings of the simulated scanners: recognised, read by the conventions of their drivers, with the true trajectory.

Tests app/sensors/simulator/scanners.py and the presets of these scanners.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from app.sensors.doctor import examine
from app.sensors.presets import resolve_params
from app.sensors.recording import ImuEntry, ScanEntry, open_recording
from app.sensors.ros import Layout, RecordingWriter, points_message, serialised
from app.sensors.simulator import simulate
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import Measurement, Scan

FOLDERS = {"mid360": "livox", "jt128": "hesai"}
"""Of the makers' tables, under ../shared/data/sensors."""

Make = Callable[[str], Path]


@pytest.fixture(scope="module")
def make(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Simulates six seconds in a room with a scanner, its mounting untold."""
    folder = tmp_path_factory.mktemp("scanners")

    @cache
    def made(scanner: str) -> Path:
        out = folder / f"{scanner}.mcap"
        tables = shared_data / "sensors" / FOLDERS.get(scanner, "")
        simulate("room", out, duration_s=6.0, every_block=6, scanner=scanner, tables=tables)
        out.with_name(f"{scanner}.params.yaml").rename(folder / f"{scanner}.mounting")
        return out

    return made


@pytest.mark.parametrize("scanner", ["airy", "jt128", "mid360"])
def test_a_scanner_is_recognised_and_its_preset_alone_maps_the_walk(make: Make, scanner: str) -> None:
    path = make(scanner)
    assert f"--preset {scanner}" in [finding.option for finding in examine(path, Params())]
    params = resolve_params(path, scanner, None, [])
    told = Params().merged_yaml(path.with_suffix(".mounting").read_text(), "mounting")
    assert params.sensor == told.sensor
    engine, stamps, poses, score = Engine(params), [], [], GroundScore()
    with open_recording(path, params) as recording:
        for entry in recording.measurements():
            assert isinstance(entry, Measurement)
            result = engine.step(entry.scan, entry.imu)
            stamps.append(result.stamp_ns)
            poses.append(result.T_map_imu)
            if result.truth_ground is not None:
                score += GroundScore.of(result.cloud.labels, result.truth_ground)
    error = ate(Trajectory.from_poses(stamps, np.array(poses)), read_tum(path.with_name(f"{scanner}_truth.tum")))
    assert len(stamps) >= 58
    assert error.position.max < 0.01  # m
    if scanner != "mid360":  # CustomMsg has no labels
        assert score.f1 > 0.9


def as_point_cloud_2(scan: Scan) -> bytes:
    """As livox_ros_driver2 sends it with xfer_format 0."""
    names = ["x", "y", "z", "intensity", "tag", "line", "timestamp"]
    points = np.zeros(len(scan), list(zip(names, ["<f4"] * 4 + ["u1"] * 2 + ["<f8"], strict=True)))
    points["x"], points["y"], points["z"] = scan.points.T
    points["timestamp"] = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
    return serialised(points_message(points, scan.stamp_ns, "livox_frame"))


def test_a_mid360_is_recognised_by_its_point_cloud_2_too(make: Make, tmp_path: Path) -> None:
    with open_recording(make("mid360"), Params()) as recording, (tmp_path / "walk.mcap").open("wb") as file:
        writer = RecordingWriter(file, Layout("/livox/lidar", "/livox/imu", encode=as_point_cloud_2))
        for entry in recording.entries():
            if isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan):
                writer.add_scan(entry.scan, entry.log_ns)
            elif isinstance(entry, ImuEntry):
                writer.add_imu(entry.stamp_ns, entry.gyro, entry.accel, entry.log_ns)
        writer.finish()
    with open_recording(tmp_path / "walk.mcap", Params()) as recording:
        assert "--preset mid360" in [finding.option for finding in recording.findings]
        assert [f.subject for f in recording.findings if f.verdict == "needs you"] == ["mount"]


def test_a_bpearl_is_not_taken_for_a_scanner_with_an_imu_of_its_own(make: Make) -> None:
    assert not [option for finding in examine(make("bpearl"), Params()) if "--preset" in (option := finding.option)]


def test_a_scanner_without_its_tables_is_refused_by_their_names(tmp_path: Path) -> None:
    for scanner, table in (("mid360", "mid360_pattern.npy"), ("jt128", "jt128_firetimes.csv")):
        for tables in (None, tmp_path):
            with pytest.raises(HemislamError, match=rf"{table}.*--tables"):
                simulate("room", tmp_path / "x.mcap", scanner=scanner, tables=tables)
    with pytest.raises(HemislamError, match=r"no scanner `bpeal`.*bpearl, airy"):
        simulate("room", tmp_path / "x.mcap", scanner="bpeal")
    with pytest.raises(HemislamError, match="10 scans a second, not 20"):
        simulate("room", tmp_path / "x.mcap", scanner="airy", rate_hz=20)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"a,b,c\n1,2,3\n", b"h\n" + b"1,x,3\n" * 128, b"\x93NUMPY", b"\x80\x04N."])
def test_a_file_that_is_no_table_is_refused_by_its_name(tmp_path: Path, content: bytes) -> None:
    for name in ("mid360_pattern.npy", "jt128_firetimes.csv", "jt128_angles.csv"):
        (tmp_path / name).write_bytes(content)
    for scanner, table in (("mid360", "mid360_pattern.npy"), ("jt128", "jt128_firetimes.csv")):
        with pytest.raises(HemislamError, match=f"{table} is not the maker's table"):
            simulate("room", tmp_path / "x.mcap", scanner=scanner, tables=tmp_path)
