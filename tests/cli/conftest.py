"""A small recording with exact truth, and two ways to call the command line."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from app.__main__ import cli
from app.mapping.opening import open_session
from app.sensors.ros import RecordingWriter
from app.slam.loops.service import InlineLoops
from app.slam.trajectory import Trajectory, write_tum
from app.slam.types import Scan

ROOT = Path(__file__).resolve().parents[2]
START_NS = 1_700_000_000_000_000_000
STILL_S, DURATION_S = 1.5, 4.0
ROOM = np.array([[-4.0, -3.0, -1.2], [5.0, 3.5, 1.6]])
LOOKING_FORWARD = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""R_world_lidar: the sensor's axis points along the world's x, the world's up is the sensor's x."""


def positions(seconds: np.ndarray) -> np.ndarray:
    """Where the sensor is: at rest, then on a smooth curve. (n, 3) m."""
    u = np.clip(seconds - STILL_S, 0, None)[:, None]
    return np.hstack([0.5 * (1 - np.cos(0.8 * u)), 0.3 * (1 - np.cos(1.1 * u)), 0.1 * (1 - np.cos(1.7 * u))])


def accelerations(seconds: np.ndarray) -> np.ndarray:
    u = np.clip(seconds - STILL_S, 0, None)[:, None]
    moving = (seconds[:, None] > STILL_S).astype(float)
    second = [0.5 * 0.8**2 * np.cos(0.8 * u), 0.3 * 1.1**2 * np.cos(1.1 * u), 0.1 * 1.7**2 * np.cos(1.7 * u)]
    return moving * np.hstack(second)


def sweep(start_s: float, seed: int) -> Scan:
    """One revolution in a box-shaped room, every ray from where the sensor is at its own time."""
    azimuth, elevation = np.meshgrid(np.arange(0, 360, 2.0), np.linspace(2.3, 89.5, 32), indexing="ij")
    seconds = start_s + azimuth.ravel() / 360 * 0.1
    a, e = np.radians(azimuth.ravel()), np.radians(elevation.ravel())
    rays = np.stack([np.cos(e) * np.cos(a), -np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    directions, origins = rays @ LOOKING_FORWARD.T, positions(seconds)
    with np.errstate(divide="ignore"):
        to_walls = np.maximum((ROOM[0] - origins) / directions, (ROOM[1] - origins) / directions)
    hit = to_walls.argmin(axis=1)
    ranges = to_walls.min(axis=1) + np.random.default_rng(seed).normal(scale=0.005, size=len(rays))
    stamps = np.rint(seconds * 1e9).astype(np.int64)
    return Scan(
        stamp_ns=START_NS + int(stamps.min()),
        offsets_ns=(stamps - stamps.min()).astype(np.int32),
        points=(rays * ranges[:, None]).astype(np.float32),
        intensity=np.full(len(rays), 50, dtype=np.float32),
        ring=np.tile(np.arange(32, dtype=np.uint16), 180),
        truth_ground=((hit == 2) & (directions[:, 2] < 0)).astype(np.uint8),
    )


def write_walk(path: Path, *, duration_s: float = DURATION_S, imu_until_s: float = DURATION_S) -> None:
    """A recording of the walk, and its truth beside it."""
    imu_s = np.arange(0, imu_until_s, 0.005)
    rng = np.random.default_rng(7)
    accel = (accelerations(imu_s) + np.array([0, 0, 9.81])) @ LOOKING_FORWARD + rng.normal(
        scale=0.02, size=(len(imu_s), 3)
    )
    gyro = rng.normal(scale=0.001, size=(len(imu_s), 3))
    ends: list[int] = []
    with path.open("wb") as file:
        recording, sample = RecordingWriter(file), 0

        def add_imu_until(end_ns: float) -> None:
            nonlocal sample
            while sample < len(imu_s) and START_NS + imu_s[sample] * 1e9 <= end_ns:
                stamp = START_NS + round(imu_s[sample] * 1e9)
                recording.add_imu(stamp, gyro[sample], accel[sample], stamp)
                sample += 1

        for index in range(round(duration_s * 10) - 1):
            scan = sweep(0.05 + index / 10, index)
            ends.append(scan.end_ns)
            add_imu_until(scan.end_ns)
            recording.add_scan(scan, scan.end_ns + 4_000_000)
        add_imu_until(np.inf)
        recording.finish()
    stamps = np.array(ends)
    turned = np.tile(Rotation.from_matrix(LOOKING_FORWARD).as_quat(), (len(ends), 1))
    truth = Trajectory(stamps, positions((stamps - START_NS) * 1e-9), turned)
    write_tum(path.with_name(f"{path.stem}_truth.tum"), truth)


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 39 scans in a room, with truth beside it."""
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


@pytest.fixture(scope="session")
def walk_without(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], Path]:
    """The same walk, but its IMU falls silent after so many seconds."""

    def make(imu_until_s: float) -> Path:
        path = tmp_path_factory.mktemp("recording") / "silent.mcap"
        write_walk(path, imu_until_s=imu_until_s)
        return path

    return make


@dataclass(frozen=True, slots=True)
class Outcome:
    code: int
    out: str
    err: str

    def refused(self) -> str:
        """The sentence of a refusal: exit code 2, one line on stderr, no traceback."""
        assert self.code == 2, self.err
        assert "Traceback" not in self.err
        assert len(self.err.splitlines()) == 1, self.err
        assert self.err.startswith("hemislam: ")
        return self.err.strip()


Call = Callable[..., Outcome]


@pytest.fixture(scope="module", autouse=True)
def _loops_in_this_process() -> Iterator[None]:
    """Each run in this process would start an interpreter for its loops, which takes longer than the run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.mapping.opening.open_session", partial(open_session, loops=InlineLoops))
        yield


@pytest.fixture(scope="session")
def hemislam() -> Call:
    """Calls the command line in this process, where libraries and kernels are loaded already."""

    def call(*arguments: object, folder: Path = ROOT) -> Outcome:
        with contextlib.chdir(folder):
            done = CliRunner().invoke(cli, [str(argument) for argument in arguments], prog_name="hemislam")
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return Outcome(done.exit_code, done.stdout, done.stderr)

    return call


@pytest.fixture(scope="session")
def hemislam_alone() -> Call:
    """Calls it in a process of its own, as a user does."""

    def call(*arguments: object, folder: Path = ROOT) -> Outcome:
        command = [sys.executable, "-m", "app", *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return call
