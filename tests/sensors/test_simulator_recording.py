"""The simulator's files: layout, stamps, truth, and agreement with recordings from other sources.

Tests app/sensors/simulator/simulate.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from app.sensors.robosense import BPEARL
from app.sensors.simulator import SCENES, simulate
from app.slam.errors import HemislamError

SECONDS = 3.0


@dataclass
class Content:
    """A recording as plain arrays."""

    clouds: list[np.ndarray[Any, Any]]
    headers_ns: list[int]
    logged_ns: list[int]
    imu_ns: np.ndarray[Any, Any]
    accel: np.ndarray[Any, Any]


def read(path: Path, scans: int = 30) -> Content:
    clouds, headers, logged, imu_ns, accel = [], [], [], [], []
    with AnyReader([path]) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
        assert topics == {"/rslidar_points": "sensor_msgs/msg/PointCloud2", "/imu/data": "sensor_msgs/msg/Imu"}
        for connection, time_ns, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            if connection.topic == "/imu/data":
                imu_ns.append(stamp)
                accel.append([getattr(message.linear_acceleration, axis) for axis in "xyz"])
                continue
            formats = {1: "i1", 2: "u1", 4: "<u2", 7: "<f4", 8: "<f8"}
            layout = {
                "names": [f.name for f in message.fields],
                "formats": [formats[f.datatype] for f in message.fields],
                "offsets": [f.offset for f in message.fields],
                "itemsize": message.point_step,
            }
            clouds.append(np.frombuffer(message.data, np.dtype(layout)))
            headers.append(stamp)
            logged.append(time_ns)
            if len(clouds) == scans:
                break
    return Content(clouds, headers, logged, np.array(imu_ns), np.array(accel))


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "corridor.mcap"
    calls: list[tuple[int, int]] = []
    summary = simulate(
        "corridor",
        out,
        duration_s=SECONDS,
        seed=5,
        every_block=6,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert calls == [(k + 1, 29) for k in range(29)]
    assert (summary.scans, summary.recording) == (29, out)
    assert summary.bytes == out.stat().st_size
    return out


def test_the_same_seed_writes_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    made = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        out = tmp_path / f"{name}.mcap"
        simulate("room", out, duration_s=1.0, seed=seed, every_block=30)
        made.append(out.read_bytes() + (tmp_path / f"{name}_truth.tum").read_bytes())
    assert made[0] == made[1]
    assert made[0] != made[2]


def test_a_cloud_is_stamped_with_its_last_point_and_truth_with_the_cloud(corridor: Path) -> None:
    content = read(corridor)
    truth = (corridor.parent / "corridor_truth.tum").read_text().splitlines()
    stamps = [int(line.split()[0].replace(".", "")) for line in truth]
    assert stamps == content.headers_ns and len(stamps) == 29
    for cloud, header, logged in zip(content.clouds, content.headers_ns, content.logged_ns, strict=True):
        assert abs(cloud["timestamp"].max() - header * 1e-9) < 1e-6
        assert 0.099 < np.ptp(cloud["timestamp"]) < 0.1
        assert header < logged < header + 20_000_000


def test_the_imu_covers_every_scan_at_200_hz(corridor: Path) -> None:
    content = read(corridor, scans=1000)
    assert (np.diff(content.imu_ns) == 5_000_000).all()
    assert content.imu_ns[0] * 1e-9 <= content.clouds[0]["timestamp"].min()
    assert content.imu_ns[-1] >= content.headers_ns[-1]


def test_the_sidecar_says_where_the_lidar_sits(corridor: Path) -> None:
    tree = yaml.safe_load((corridor.parent / "corridor.params.yaml").read_text())
    assert tree["sensor"]["translation"] == [0.0175, 0.0276, -0.1083]


def test_it_agrees_with_an_independent_recording_on_every_convention(corridor: Path, shared_data: Path) -> None:
    for content in (read(corridor), read(shared_data / "hall_bpearl.mcap")):
        cloud = content.clouds[0]
        assert set(cloud.dtype.names or ()) == {"x", "y", "z", "intensity", "ring", "timestamp", "ground"}
        assert 9_000 < len(cloud) <= 301 * 32
        xyz = np.column_stack([cloud[axis] for axis in "xyz"]).astype(np.float64)
        elevation = np.arctan2(xyz[:, 2] - BPEARL.rz, np.hypot(xyz[:, 0], xyz[:, 1]) - BPEARL.rx)
        by_ring = [np.degrees(np.median(elevation[cloud["ring"] == ring])) for ring in range(32)]
        np.testing.assert_allclose(by_ring[:31], 2.3125 + 2.8125 * np.arange(31), atol=0.15)
        ahead = (cloud["timestamp"] - cloud["timestamp"].min()) / 0.1
        azimuth = np.arctan2(-xyz[:, 1], xyz[:, 0]) / (2 * np.pi) % 1
        wide = elevation < np.deg2rad(60)
        assert np.median(np.abs((azimuth - ahead + 0.5) % 1 - 0.5)[wide]) < 0.005
        assert abs(content.headers_ns[0] * 1e-9 - cloud["timestamp"].max()) < 1e-4
        floor = xyz[cloud["ground"] == 1]
        assert 0.15 < len(floor) / len(cloud) < 0.4
        assert abs(np.median(floor[:, 0]) - 1.25) < 0.1, "the floor lies along +x"
        rest = content.accel[:200].mean(axis=0)
        assert abs(rest[0] + 9.81) < 0.15 and np.abs(rest[1:]).max() < 0.8
        assert 0.005 < content.accel[:200].std(axis=0).mean() < 0.03
        assert 20 < np.median(cloud["intensity"]) < 200


def test_twenty_hertz_makes_twice_the_scans(tmp_path: Path) -> None:
    summary = simulate("room", tmp_path / "fast.mcap", duration_s=1.0, rate_hz=20, every_block=30)
    content = read(tmp_path / "fast.mcap")
    assert summary.scans == 19
    assert 0.045 < np.ptp(content.clouds[0]["timestamp"]) < 0.05


def test_coordinates_can_be_rounded(tmp_path: Path) -> None:
    simulate("room", tmp_path / "small.mcap", duration_s=0.5, every_block=30, coordinate_step=1 / 256)
    x = read(tmp_path / "small.mcap").clouds[0]["x"]
    assert (x * 256 == np.rint(x * 256)).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"scene": "moon"}, "no scene `moon`; there are corridor"),
        ({"rate_hz": 15}, "10 or 20 scans a second, not 15"),
        ({"duration_s": 0.0}, "duration_s cannot be 0; choose 0.5"),
        ({"every_block": 0}, "every_block cannot be 0; choose 1 to 90"),
        ({"range_step": float("nan")}, "range_step cannot be nan"),
        ({"out": "walk.bag"}, r"must be named \*\.mcap, not `walk\.bag`"),
        ({"out": "absent/walk.mcap"}, "absent does not exist"),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence(tmp_path: Path, arguments: dict[str, Any], sentence: str) -> None:
    given = {"scene": "room", "out": "walk.mcap", "duration_s": 1.0} | arguments
    out = tmp_path / given.pop("out")
    with pytest.raises(HemislamError, match=sentence):
        simulate(given.pop("scene"), out, **given)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_simulation_leaves_no_recording_and_spares_the_old_one(tmp_path: Path) -> None:
    old = tmp_path / "walk.mcap"
    old.write_bytes(b"old")

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate("room", old, duration_s=1.0, every_block=30, progress=stop)
    assert old.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [old]


def test_every_scene_has_a_description_of_one_line() -> None:
    assert {"corridor", "room", "outdoor", "museum", "cloister"} <= set(SCENES)
    assert all(text.endswith(".") and "\n" not in text for text in SCENES.values())


def test_the_sample_is_what_its_readme_says(tmp_path: Path) -> None:
    sample = Path(__file__).resolve().parents[2] / "sample_data"
    assert sum(f.stat().st_size for f in sample.iterdir()) < 40e6
    words = next(
        line for line in (sample / "README.md").read_text().splitlines() if line.startswith("hemislam simulate")
    )
    assert words.split()[2:] == [
        *("cloister", "--out", "sample_data/cloister.mcap", "--duration", "84", "--seed", "1"),
        *("--every-block", "14", "--coordinate-step", "0.00390625"),
    ]
    simulate("cloister", tmp_path / "again.mcap", duration_s=2.0, seed=1, every_block=14, coordinate_step=0.00390625)
    shipped, again = read(sample / "cloister.mcap", 5), read(tmp_path / "again.mcap", 5)
    for theirs, ours in zip(shipped.clouds, again.clouds, strict=True):
        assert abs(len(theirs) - len(ours)) <= 3  # another processor's ray caster may round another way
        common = np.intersect1d(theirs["timestamp"], ours["timestamp"], return_indices=True)
        same = theirs[common[1]]["x"] == ours[common[2]]["x"]
        assert same.mean() > 0.99
    truth = np.loadtxt(sample / "cloister_truth.tum")
    assert len(truth) == 839
    assert np.linalg.norm(truth[-1, 1:4] - truth[0, 1:4]) < 1.5
