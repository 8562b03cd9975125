"""The map as PLY, and as PCD 0.7 for the Point Cloud Library.

After its points, the PLY holds the keyframes, so that it can be exported to other formats later.
"""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from app.export.points import Block
from app.export.results import Results
from app.slam.errors import HemislamError
from app.slam.ply import header, pcd_header
from app.slam.types import GROUND, MOVING, NON_GROUND, Cloud, Keyframe, is_ground

VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ground", "u1"),
        ("moving", "u1"),
        ("ring", "<u2"),
        ("time", "<f8"),
    ]
)
"""Positions in m, in the map; time in s, as in the trajectory."""
KEYFRAME = np.dtype(
    [("points", "<i4"), ("seconds", "<i4"), ("nanoseconds", "<i4")]
    + [(name, "<f8") for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
)
"""Number of the keyframe's points, time of its scan's end, and T_map_lidar."""
PCD_POINT = np.dtype(
    [(name, VERTEX[name]) for name in ("x", "y", "z", "intensity", "ring", "ground", "moving", "time")]
)
COMMENT = "hemislam map, metres, z up"


def write(path: Path, blocks: Iterable[Block]) -> tuple[int, int]:
    """Write points and keyframes; the number of points is put into the header at the end.

    Returns:
        Numbers of all points, and of those on moving objects.
    """
    keyframes, count, moving = [], 0, 0
    with path.open("wb") as file:
        file.write(header(VERTEX, 0, COMMENT, keyframe=KEYFRAME))
        for block in blocks:
            file.write(_vertices_of(block, VERTEX).data)
            T = block.T_map_lidar
            pose = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
            keyframes.append((len(block), *divmod(block.stamp_ns, 1_000_000_000), *pose))
            count += len(block)
            moving += int(np.count_nonzero(block.labels == MOVING))
        file.write(np.array(keyframes, KEYFRAME).tobytes())
        file.seek(0)
        file.write(header(VERTEX, count, COMMENT, keyframe=KEYFRAME, keyframes=len(keyframes)))
    return count, moving


def write_pcd(path: Path, results: Results) -> None:
    """Write only the points; their number is put into the header at the end."""
    count = 0
    with path.open("wb") as file:
        file.write(pcd_header(PCD_POINT, 0, COMMENT))
        for block in results.blocks():
            file.write(_vertices_of(block, PCD_POINT).data)
            count += len(block)
        file.seek(0)
        file.write(pcd_header(PCD_POINT, count, COMMENT))


def _vertices_of(block: Block, layout: np.dtype) -> np.ndarray:
    """(n,) points with the columns of `VERTEX`, in the layout of the file."""
    vertices = np.empty(len(block), layout)
    vertices["x"], vertices["y"], vertices["z"] = block.points.T
    vertices["intensity"], vertices["ring"] = block.intensity, block.ring
    vertices["ground"], vertices["moving"] = is_ground(block.labels), block.labels == MOVING
    vertices["time"] = block.stamps_ns * 1e-9
    return vertices


class MapFile:
    """The keyframes of a map written by `write`. Their odometry poses are their poses in the map.

    Raises:
        HemislamError: the file cannot be read, or is not such a map.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("rb")
            self._read_ends(self._file.read(4096))
        except OSError as error:
            raise HemislamError(f"The map {path} cannot be read: {error.strerror}.") from None
        except (ValueError, IndexError):
            raise HemislamError(
                f"{path} is not a map of this version of hemislam; run hemislam on the recording again."
            ) from None

    def _read_ends(self, head: bytes) -> None:
        counts = [int(line.split()[2]) for line in head.split(b"\n") if line.startswith(b"element ")]
        first, second = counts
        if not head.startswith(begin := header(VERTEX, first, COMMENT, keyframe=KEYFRAME, keyframes=second)):
            raise ValueError
        self._file.seek(len(begin) + first * VERTEX.itemsize)
        self._keyframes = np.frombuffer(self._file.read(second * KEYFRAME.itemsize), KEYFRAME, count=second)
        self._begins = len(begin) + np.cumsum([0, *self._keyframes["points"]], dtype=np.int64) * VERTEX.itemsize

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, index: int, /) -> Keyframe:
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        begin, end = self._begins[index : index + 2].tolist()
        vertices = np.frombuffer(os.pread(self._file.fileno(), end - begin, begin), VERTEX)
        row = self._keyframes[index]
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
        T[:3, 3] = row["x"], row["y"], row["z"]
        stamp_ns = int(row["seconds"]) * 1_000_000_000 + int(row["nanoseconds"])
        offsets_ns = np.rint((vertices["time"] - row["seconds"]) * 1e9 - row["nanoseconds"])
        points = np.stack([vertices["x"], vertices["y"], vertices["z"]], axis=1).astype(np.float64)
        labels = np.where(vertices["moving"] > 0, MOVING, np.where(vertices["ground"] > 0, GROUND, NON_GROUND))
        cloud = Cloud(
            ((points - T[:3, 3]) @ T[:3, :3]).astype(np.float32),
            labels.astype(np.uint8),
            vertices["intensity"],
            vertices["ring"],
            np.minimum(offsets_ns, 0).astype(np.int32),
        )
        return Keyframe(index, index, stamp_ns, T, np.eye(4), np.eye(6), cloud)
