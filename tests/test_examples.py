"""The examples run as a user would run them, and give the right results."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from app.mapping.feed import FileFeed
from app.slam.params import Params
from app.slam.types import Measurement
from tests.rounds import walk_round

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
SAMPLE = ROOT / "sample_data" / "cloister.mcap"
ENV = {**os.environ, "PYTHONPATH": str(ROOT)}


def run(name: str, *arguments: object) -> str:
    """What an example prints."""
    call = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    ended = subprocess.run(call, capture_output=True, text=True, env=ENV, timeout=240)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_there_are_six_examples_of_at_most_60_lines() -> None:
    lines = {path.name: len(path.read_text().splitlines()) for path in EXAMPLES.glob("*.py")}
    assert len(lines) == 6 and max(lines.values()) <= 60, lines


def test_the_engine_on_arrays_finds_the_two_metres() -> None:
    moved = [float(number) for number in re.findall(r"-?\d+\.\d{3}", run("engine_on_arrays.py"))]
    np.testing.assert_allclose(moved[:3], [2, 0, 0], atol=0.005)


def test_a_recording_is_read_frame_by_frame() -> None:
    printed = run("read_frames.py", SAMPLE)
    assert "IMU units" in printed
    assert re.search(r"^frame 19: 1\.9\d\d s, [\d,]+ points, 2\d IMU samples$", printed, re.MULTILINE)


def test_a_feed_of_ones_own_makes_a_map(tmp_path: Path) -> None:
    """Three seconds of the sample at rest, written as plain text."""
    feed = FileFeed(SAMPLE, Params(), 0.0, 3.0)
    entries = [entry for entry in iter(feed.next, None) if isinstance(entry, Measurement)]
    feed.close()
    clouds = [
        np.column_stack(
            [
                entry.scan.stamp_ns + entry.scan.offsets_ns.astype(np.int64),
                entry.scan.points,
                entry.scan.intensity,
                entry.scan.ring,
            ]
        )
        for entry in entries
    ]
    lidar = np.concatenate(clouds)
    imu = np.concatenate([np.column_stack([e.imu.stamps_ns, e.imu.gyro, e.imu.accel]) for e in entries])
    formats = (["%d"] + ["%.4f"] * 5, ["%d"] + ["%.9f"] * 6)
    np.savetxt(tmp_path / "lidar.csv", lidar[np.argsort(lidar[:, 0], kind="stable")], delimiter=",", fmt=formats[0])
    np.savetxt(tmp_path / "imu.csv", imu[np.unique(imu[:, 0], return_index=True)[1]], delimiter=",", fmt=formats[1])
    printed = run("own_feed.py", tmp_path)
    assert "tracking" in printed.splitlines()[-1]
    poses = np.loadtxt(tmp_path / "results" / "trajectory.tum")
    assert len(poses) >= 25 and np.linalg.norm(poses[-1, 1:4]) < 0.02, "it stands still"
    assert (tmp_path / "results" / "map.ply").stat().st_size > 10_000


def test_a_rejected_loop_is_no_longer_accepted(tmp_path: Path) -> None:
    """Another one may be found instead: what the rejected one proved is proved no more."""
    room = walk_round(tmp_path / "room.mcap")
    with room.with_suffix(".params.yaml").open("a") as file:
        file.write("loops:\n  min_time: 4\n")  # so that so short a round counts
    printed = run("loops_headless.py", room)
    rejected = re.search(r"(\d+ - \d+) is no longer among the (\d+) accepted loops", printed)
    assert rejected and int(rejected[2]) > 0
    assert f"{rejected[1]}: accepted" in printed


@pytest.fixture
def workbench(tmp_path: Path) -> Iterator[str]:
    """The address of a workbench with the sample, paused."""
    call = [sys.executable, "-m", "app", "serve", str(SAMPLE), "--paused", "--no-browser", "--port", "0"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, text=True, env=ENV, cwd=tmp_path) as server:
        assert server.stdout is not None
        try:
            found = (re.search(r"http://127\.0\.0\.1:\d+", line) for line in server.stdout)
            yield next(address for address in found if address).group()
        finally:
            server.terminate()


def test_a_script_controls_the_workbench(workbench: str) -> None:
    printed = run("rest_client.py", workbench)
    assert "alpha is now 30.0 degrees" in printed
    assert "the trajectory has 22 poses" in printed
    assert "422 `ground.alpha`" in printed


def test_two_variants_are_evaluated(tmp_path: Path) -> None:
    printed = run("two_variants.py", SAMPLE, tmp_path)
    assert "finer voxels for the filter" in printed
    assert (tmp_path / "report.html").exists()
