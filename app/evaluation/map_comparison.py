"""Compare a session's map with another map, or with itself on the true trajectory, in a process of its own."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from app.child import Link
from app.evaluation.cloud_distance import REACH_M, THIN_M, Comparison, compare
from app.evaluation.truth import read_truth
from app.evaluation.truth_match import match
from app.export.map_file import MapFile
from app.export.points import Choice, blocks
from app.export.read_points import read_points
from app.georeference.reference import GeoReference
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.map_frame import MapFrame
from app.slam.metrics import interpolate, umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F32, F64

_OF_A_GRID_M: Final = 20_000.0
"""Coordinates beyond this are grid coordinates on Earth, since no walk reaches that far."""
_ABOVE_M: Final = 100.0
_READ: Final = 0.3
"""Share of the progress for reading the other map."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePoints:
    """A keyframe's points: (n, 3) m, LiDAR frame. stamp_ns: of its pose T_map_imu; both poses are (4, 4)."""

    points: F32
    stamp_ns: int
    T_map_imu: F64
    T_imu_lidar: F64


@dataclass(frozen=True, slots=True, eq=False)
class MapsToCompare:
    """The map of the scans, and what to compare it with.

    Attributes:
        other: a map (PLY, LAS, LAZ), or, if `by_truth`, the file of the true trajectory.
        where: the map's georeference, for other maps in grid coordinates. fit, reach: as in `compare`.
    """

    scans: tuple[KeyframePoints, ...]
    other: Path
    by_truth: bool = False
    where: GeoReference | None = None
    fit: bool = False
    reach: float = REACH_M


def find(owner: Link, wanted: MapsToCompare) -> None:
    """Send the growing share that is done, then a `Comparison`. Raises HemislamError if no comparison is possible."""
    poses = np.array([scan.T_map_imu for scan in wanted.scans])
    points, sensors = placed(wanted.scans, poses)
    if wanted.by_truth:
        known, true_poses = _true(wanted, poses)
        other, _ = placed([scan for scan, is_known in zip(wanted.scans, known, strict=True) if is_known], true_poses)
    else:
        other = read_points(wanted.other, THIN_M, lambda share: owner.send(_READ * share))
        other = in_frame_of(points, wanted.where, other, None)
    found = compare(
        points, sensors, other, reach=wanted.reach, fit=wanted.fit,
        progress=lambda share: owner.send(_READ + (1 - _READ) * share),
    )  # fmt: skip
    owner.send(found)


def placed(scans: "tuple[KeyframePoints, ...] | list[KeyframePoints]", poses: F64) -> tuple[F64, F64]:
    """(n, 3) m, the points in the map by (k, 4, 4) poses T_map_imu, and the position from which each was seen."""
    points, sensors = [np.empty((0, 3))], [np.empty((0, 3))]
    for scan, T_map_imu in zip(scans, poses, strict=True):
        T = T_map_imu @ scan.T_imu_lidar
        points.append(lie.moved(T, scan.points))
        sensors.append(np.broadcast_to(T[:3, 3], scan.points.shape))
    return np.concatenate(points), np.concatenate(sensors)


def read_map(path: Path) -> tuple[F64, F64]:
    """(n, 3) m, the thinned points of a results folder or a file, and the positions from which they were seen.

    Points of a file count as seen from above.

    Raises:
        HemislamError: it holds no map.
    """
    if not path.is_dir():
        read = read_points(path, THIN_M)
        return read, read + np.array([0.0, 0.0, _ABOVE_M])
    points, sensors = [np.empty((0, 3))], [np.empty((0, 3))]
    for block in blocks(MapFile(path / "map.ply"), MapFrame(), Choice(thin=THIN_M)):
        points.append(block.points)
        sensors.append(np.broadcast_to(block.T_map_lidar[:3, 3], block.points.shape))
    return np.concatenate(points), np.concatenate(sensors)


def in_frame_of(points: F64, where: GeoReference | None, other: F64, others: GeoReference | None) -> F64:
    """The other map in the frame of the first. If just one of them is in grid coordinates, the georeference of the map
    that is not converts: `where` is that of the first map, `others` that of the other.
    """
    on_earth, other_on_earth = (np.abs(np.median(one, axis=0)).max() > _OF_A_GRID_M for one in (points, other))
    if where is not None and other_on_earth and not on_earth:
        return where.from_crs(other)
    if others is not None and on_earth and not other_on_earth:
        return others.to_crs(other)
    return other


def sentences(found: Comparison, name: str) -> list[str]:
    """Results of a comparison with the map `name`, besides distances, in sentences."""
    moved = float(np.linalg.norm(found.T[:3, 3]))
    turned = float(np.degrees(np.linalg.norm(lie.log(found.T[:3, :3]))))
    return [
        f"To {name}.",
        f"{100 * found.changed:.0f} % differ by more than chance.",
        f"{100 * (1 - found.covered):.0f} % have no counterpart within reach.",
        *([f"It was moved by {moved:.2f} m and {turned:.1f}° first."] if moved or turned else []),
    ]


def _true(wanted: MapsToCompare, poses: F64) -> tuple[np.ndarray, F64]:
    """(k,) mask of the scans with a true pose, and these poses in the map, aligned to the estimated poses."""
    stamps_ns = np.array([scan.stamp_ns for scan in wanted.scans], np.int64)
    estimate = Trajectory.from_poses(stamps_ns, poses)
    truth = match(read_truth(str(wanted.other)), estimate).trajectory
    there, known = interpolate(truth, stamps_ns)
    if np.count_nonzero(known) < 3:
        raise HemislamError(f"{wanted.other.name} has fewer than 3 poses within the time of the map.")
    T_map_truth = umeyama(there.positions, estimate.chosen(known).positions)
    return known, np.array([T_map_truth @ T for T in there.poses])
