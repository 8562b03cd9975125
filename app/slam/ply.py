"""Binary PLY files: their header, and the map, written keyframe by keyframe so that memory does not grow with it."""

from pathlib import Path
from typing import Protocol

import numpy as np

from app.slam.map_frame import MapFrame
from app.slam.types import F64, NON_GROUND, Keyframe

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ground", "u1")])
_KINDS = {"<f4": "float", "<u2": "ushort", "<i4": "int", "|u1": "uchar"}


class Keyframes(Protocol):
    """Keyframes by index, as an export reads them."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Keyframe: ...


def header(vertex: np.dtype, count: int, *comments: str) -> bytes:
    """The header of `count` vertices of a structured type. Its length does not depend on the count."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines.append(f"element vertex {count:012d}")
    lines += [f"property {_KINDS[vertex[name].str]} {name}" for name in vertex.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def write_map(path: Path, keyframes: Keyframes, frame: MapFrame) -> int:
    """Write the points of all keyframes where `frame` puts them in the map, and return their number.

    Vertices are x y z (m), intensity (the sensor's scale) and ground (1 = ground). Only one keyframe is held at a
    time; the number of points is written into the header at the end.
    """
    count, comment = 0, "hemislam map, metres, z up"
    with path.open("wb") as file:
        file.write(header(VERTEX, 0, comment))
        for index in range(len(keyframes)):
            vertices = _vertices(keyframes[index], frame.at(index))
            file.write(vertices.tobytes())
            count += len(vertices)
        file.seek(0)
        file.write(header(VERTEX, count, comment))
    return count


def _vertices(keyframe: Keyframe, T_map_odom: F64) -> np.ndarray:
    cloud = keyframe.cloud
    T_map_lidar = T_map_odom @ keyframe.T_odom_imu @ keyframe.T_imu_lidar
    points = cloud.points.astype(np.float64) @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3]
    vertices = np.empty(len(cloud), dtype=VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = points.T
    vertices["intensity"] = cloud.intensity
    vertices["ground"] = cloud.labels != NON_GROUND
    return vertices
