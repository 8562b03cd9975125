"""One frame in detail: the numbers of each point, a point's neighbours and their plane, and files of all of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from app.slam.lie import quaternion
from app.slam.ply import header, pcd_header
from app.slam.types import F32, F64, I64, StepResult

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("offset", "<i4"),
        ("label", "u1"), ("distance", "<f4"), ("angle", "<f4"), ("residual", "<f4"), ("residual_away", "<f4"),
    ]
)  # fmt: skip
"""x y z: m, LiDAR frame at the scan's end. offset: ns after the first point. label: 0 not ground, 1 ground,
2 seed. distance: m, signed, above the ground plane; nan without one. angle: degrees to "down". residual: m, signed, to
the map's plane, of the nearest point that the filter looked up; nan where its plane was not accepted or there is no
such point within `MATCH_M`. residual_away: m to that point, nan without one: the filter sees a thinned scan."""

MATCH_M = 0.5
"""A residual counts for the points of the scan within this distance of the point that the filter looked up."""


@dataclass(frozen=True, slots=True)
class PointNumbers:
    """Numbers of n points.

    Attributes:
        range: (n,) m. angle: (n,) rad between the point and "down".
        distance: (n,) m above (+) or below (-) the ground plane; nan where no plane was fitted.
    """

    range: F64
    angle: F64
    distance: F64


def point_numbers(points: F32, result: StepResult) -> PointNumbers:
    """Numbers of (n, 3) points in the LiDAR frame of a result, from its ground plane, accepted or not."""
    exact, ground = points.astype(np.float64), result.ground
    reach = np.linalg.norm(exact, axis=1)
    cosine = exact @ ground.down / np.maximum(reach, 1e-9)
    return PointNumbers(
        range=reach,
        angle=np.arccos(np.clip(cosine, -1.0, 1.0)),
        distance=(exact - ground.centroid) @ ground.normal,
    )


@dataclass(frozen=True, slots=True)
class Patch:
    """A plane through some points.

    Attributes:
        indices: (k,) of the points, nearest first. center: (3,) m. normal: (3,) unit, towards the sensor.
        variances: (3,) m², of the points along the patch's axes, greatest first; the last is across the plane.
        radius: m to the farthest of the points from the first.
    """

    indices: I64
    center: F64
    normal: F64
    variances: F64
    radius: float


def neighbourhood(points: F32, index: int, count: int) -> Patch:
    """The `count` points nearest to point `index` of (n, 3), itself first, and the plane through them."""
    offsets = points.astype(np.float64) - points[index]
    squared = np.einsum("ij,ij->i", offsets, offsets)
    count = min(count, len(points))
    nearest = np.argpartition(squared, count - 1)[:count]
    nearest = nearest[np.argsort(squared[nearest], kind="stable")]
    near = points[nearest].astype(np.float64)
    center = near.mean(axis=0)
    values, vectors = np.linalg.eigh((near - center).T @ (near - center) / count)
    normal = vectors[:, 0] * -(np.sign(vectors[:, 0] @ center) or 1.0)
    return Patch(
        indices=nearest.astype(np.int64),
        center=center,
        normal=normal,
        variances=np.maximum(values[::-1], 0.0),
        radius=float(np.sqrt(squared[nearest[-1]])),
    )


def nearest_match(points: F32, result: StepResult) -> tuple[I64, F64]:
    """The nearest point that the filter looked up, for each of (n, 3) points in the LiDAR frame.

    Returns:
        (n,) its index in the result's matches, -1 without one within `MATCH_M`; (n,) m to it, nan without one.
    """
    matches = result.registration.matches
    if matches is None or not len(matches.points):
        return np.full(len(points), -1), np.full(len(points), np.nan)
    away, nearest = KDTree(matches.points).query(points)  # type: ignore[no-untyped-call]  # no types
    near = away <= MATCH_M
    return np.where(near, nearest, -1).astype(np.int64), np.where(near, away, np.nan)


# --- files ---------------------------------------------------------------------------------------
def vertices(result: StepResult) -> np.ndarray:
    """All points of a frame with all their numbers, as `VERTEX`."""
    cloud = result.cloud
    numbers = point_numbers(cloud.points, result)
    table = np.empty(len(cloud), dtype=VERTEX)
    table["x"], table["y"], table["z"] = cloud.points.T
    table["intensity"], table["ring"], table["offset"] = cloud.intensity, cloud.ring, cloud.offsets_ns
    table["label"], table["distance"], table["angle"] = cloud.labels, numbers.distance, np.degrees(numbers.angle)
    index, table["residual_away"] = nearest_match(cloud.points, result)
    matches = result.registration.matches
    table["residual"] = np.nan
    if matches is not None:
        table["residual"][index >= 0] = matches.residuals[index[index >= 0]]
    return table


_UNITS = (
    "x y z distance residual residual_away in m, offset in ns, angle in degrees; label 0 not ground, 1 ground, 2 seed"
)


def ply(result: StepResult) -> bytes:
    """A frame as a binary PLY file, in the LiDAR frame; a comment holds its pose in the map."""
    table = vertices(result)
    pose = " ".join(f"{value:.9g}" for value in result.T_map_lidar[:3].ravel())
    comments = (f"hemislam frame {result.index}, {result.stamp_ns} ns", _UNITS, f"T_map_lidar, rows: {pose}")
    return header(VERTEX, len(table), *comments) + table.tobytes()


def pcd(result: StepResult) -> bytes:
    """The same as a binary PCD file; its viewpoint is the pose of the LiDAR in the map."""
    table = vertices(result)
    T = result.T_map_lidar
    x, y, z, w = quaternion(T[:3, :3])
    viewpoint = " ".join(f"{value:.9g}" for value in (*T[:3, 3], w, x, y, z))
    comment = f"hemislam frame {result.index}, {result.stamp_ns} ns; {_UNITS}"
    return pcd_header(VERTEX, len(table), comment, viewpoint) + table.tobytes()
