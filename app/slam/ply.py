"""The map as a binary PLY file, written keyframe by keyframe, so that its size does not matter."""

from pathlib import Path
from typing import Protocol

import numpy as np

from app.slam.map_frame import MapFrame
from app.slam.types import F64, NON_GROUND, Keyframe

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ground", "u1")])


class Keyframes(Protocol):
    """What a store of keyframes must offer to be exported."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Keyframe: ...


def write_map(path: Path, keyframes: Keyframes, frame: MapFrame) -> int:
    """Write all keyframes' points where `frame` has them in the map, and return their number.

    Vertices are x y z (m), intensity (the sensor's scale) and ground (1 = ground). Only one
    keyframe is held at a time; the number of points is written into the header at the end.
    """
    count = 0
    with path.open("wb") as file:
        file.write(_header(0))
        for index in range(len(keyframes)):
            vertices = _vertices(keyframes[index], frame.at(index))
            file.write(vertices.tobytes())
            count += len(vertices)
        file.seek(0)
        file.write(_header(count))
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


def _header(count: int) -> bytes:
    """Of the same length whatever the count."""
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[VERTEX[name].str]} {name}\n" for name in VERTEX.names or ())
    return (
        f"ply\nformat binary_little_endian 1.0\ncomment hemislam map, metres, z up\n"
        f"element vertex {count:012d}\n{properties}end_header\n"
    ).encode("ascii")
