"""The page's comparison of maps in a process of its own. Tests app/evaluation/map_comparison.py."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.evaluation.cloud_distance import Comparison
from app.evaluation.map_comparison import KeyframePoints, MapsToCompare, find, read_map, sentences
from app.georeference.reference import GeoReference
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.ply import header
from app.slam.trajectory import Trajectory, write_tum

RANDOM = np.random.default_rng(4)
MOUNTED = lie.transform(lie.exp(np.array([0.0, 0.2, 0.0])), np.array([0.1, 0.0, 0.0]))
AT = [
    lie.transform(lie.exp(np.array([0.0, 0.0, 0.3 * k])), np.array([k, 0.3 * k * k, 1.5]))
    for k in np.linspace(0, 6, 30)
]
START_NS = 1_700_000_000_000_000_000


def surface(n: int = 1_500) -> np.ndarray:
    """(n, 3) of a floor of 8 m by 8 m."""
    points = RANDOM.uniform(-1, 7, (n, 3))
    points[:, 2] = RANDOM.normal(0, 0.002, n)
    return points


def seen_from(T_map_imu: np.ndarray, number: int) -> KeyframePoints:
    points = surface()
    T = lie.inverse(T_map_imu @ MOUNTED)
    local = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return KeyframePoints(local, START_NS + number * 10**9, T_map_imu, MOUNTED)


SCANS = tuple(seen_from(T, number) for number, T in enumerate(AT))


class Owner:
    """Receives what the process would send."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def send(self, message: object) -> None:
        self.told.append(message)


def compared(wanted: MapsToCompare) -> Any:
    owner = Owner()
    find(owner, wanted)  # type: ignore[arg-type]
    *shares, last = owner.told
    assert shares == sorted(shares) and all(0 <= share <= 1 for share in shares)
    return last


def write(path: Path, points: np.ndarray) -> Path:
    kind = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    path.write_bytes(header(kind, len(points)) + points.astype("<f8").tobytes())
    return path


def test_a_map_in_the_coordinates_of_a_grid_is_brought_into_those_of_the_map(tmp_path: Path) -> None:
    where = GeoReference("EPSG:32632", (500_000.0, 5_400_000.0, 300.0), ((0.0, -1, 0), (1, 0, 0), (0, 0, 1)))
    lower = surface(30_000) - [0, 0, 0.1]
    for file in (write(tmp_path / "own.ply", lower), write(tmp_path / "grid.ply", where.to_crs(lower))):
        found = compared(MapsToCompare(SCANS, file, where=where))
        assert isinstance(found, Comparison) and found.median == pytest.approx(0.1, abs=1e-3)
        assert len(found.distance) == sum(len(scan.points) for scan in SCANS)


def truth(path: Path, poses: list[np.ndarray]) -> Path:
    """Of the same walk, in a world of its own."""
    T_world_map = lie.transform(lie.exp(np.array([0.0, 0.0, 1.0])), np.array([40.0, -3.0, 2.0]))
    stamps_ns = START_NS + np.arange(len(poses)) * 10**9
    write_tum(path, Trajectory.from_poses(stamps_ns, [T_world_map @ T for T in poses]))
    return path


def test_a_scan_off_its_true_pose_is_off_its_true_surface(tmp_path: Path) -> None:
    poses = truth(tmp_path / "truth.tum", AT)
    same = compared(MapsToCompare(SCANS, poses, by_truth=True))
    assert isinstance(same, Comparison) and same.typical < 5e-4 and same.covered > 0.99
    raised = lie.transform(np.eye(3), np.array([0.0, 0.0, 0.3])) @ AT[2]
    wrong = (*SCANS[:2], replace(SCANS[2], T_map_imu=raised), *SCANS[3:])
    off = compared(MapsToCompare(wrong, poses, by_truth=True)).distance
    of_scan = np.nanmedian(off.reshape(30, -1), axis=1)
    assert of_scan[2] - np.median(of_scan) == pytest.approx(0.3, abs=0.05)


def test_why_nothing_can_be_compared_is_said(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match="cannot be read"):
        compared(MapsToCompare(SCANS, tmp_path / "gone.laz"))
    with pytest.raises(HemislamError, match="fewer than 3"):
        compared(MapsToCompare(SCANS[:2], truth(tmp_path / "truth.tum", AT), by_truth=True))


def test_a_file_is_seen_from_above_and_what_was_moved_is_said(tmp_path: Path) -> None:
    points, sensors = read_map(write(tmp_path / "own.ply", surface()))
    assert (sensors[:, 2] > points[:, 2] + 10).all()
    T = lie.transform(lie.exp(np.array([0.0, 0.0, np.radians(2.0)])), np.array([0.3, 0.4, 0.0]))
    moved = sentences(Comparison(np.full(3, 0.1, np.float32), np.full(3, 0.01, np.float32), T), "b.ply")
    assert moved[-1] == "It was moved by 0.50 m and 2.0° first." and moved[1] == "100 % differ by more than chance."
