"""Shapes that explain the scan: the seed wedge, the sensor's field of view, and the ground plane.

Pure functions of arrays, in the LiDAR frame and metres unless stated otherwise.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from app.slam.lie import quaternion
from app.slam.types import F32, F64, U16

STILL_M: Final = 1e-3
"""Moves up to this are not redrawn: each loop moves most of the map by hundredths of a millimetre."""
_ARC_POINTS: Final = 17


@dataclass(frozen=True, slots=True)
class Wedge:
    """The region in which the engine looks for seeds.

    Attributes:
        vertices: (v, 3) float32 and faces: (f, 3) uint32 of the translucent sector.
        segments: (s, 2, 3) float32, its edges and the arcs of the scan lines across it.
    """

    vertices: F32
    faces: npt.NDArray[np.uint32]
    segments: F32


def ring_elevations(points: F32, ring: U16) -> F64:
    """Mean elevation (rad) above the sensor's base plane of each scan line; nan where it has no point."""
    if len(points) == 0:
        return np.empty(0)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    counts = np.bincount(ring)
    with np.errstate(invalid="ignore"):
        return np.bincount(ring, weights=elevation) / np.where(counts > 0, counts, np.nan)


def arc(elevation: float, down: F64, alpha: float) -> tuple[float, float] | None:
    """Azimuths (centre, half width; rad) at which a scan line lies within `alpha` (rad) of `down`.

    A point of the line is (cos e cos a, cos e sin a, sin e); its cosine to `down` (unit) is
    cos e · |down_xy| · cos(a - centre) + sin e · down_z.
    """
    centre = float(np.arctan2(down[1], down[0]))
    sideways = float(np.cos(elevation) * np.hypot(down[0], down[1]))
    rest = float(np.cos(alpha) - np.sin(elevation) * down[2])
    if sideways < 1e-9:
        return (centre, np.pi) if rest <= 0.0 else None
    ratio = rest / sideways
    if ratio >= 1.0:
        return None
    return centre, float(np.arccos(max(ratio, -1.0)))


def seed_wedge(elevations: F64, down: F64, alpha: float, reach: float) -> Wedge | None:
    """The sector of the given scan lines within `alpha` (rad) of `down`, `reach` metres long.

    Args:
        elevations: (m,) rad, of the outermost lines. down: (3,) unit.

    Returns:
        None if no scan line comes within `alpha` of `down`.
    """
    arcs = []
    for elevation in np.sort(elevations[np.isfinite(elevations)]):
        found = arc(float(elevation), down, alpha)
        if found is not None:
            azimuth = found[0] + np.linspace(-found[1], found[1], _ARC_POINTS)
            arcs.append(_directions(np.full(_ARC_POINTS, elevation), azimuth))
    if not arcs:
        return None
    rims = np.asarray(arcs, dtype=np.float32) * np.float32(reach)  # (m, _ARC_POINTS, 3)
    m = len(rims)
    vertices = np.concatenate((np.zeros((1, 3), np.float32), rims.reshape(-1, 3)))
    index = 1 + np.arange(m * _ARC_POINTS).reshape(m, _ARC_POINTS)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    cap = np.concatenate((np.stack((a, b, d), -1).reshape(-1, 3), np.stack((a, d, c), -1).reshape(-1, 3)))
    fans = [
        np.column_stack((np.zeros(len(edge) - 1, dtype=index.dtype), edge[:-1], edge[1:]))
        for edge in (index[0], index[-1], index[:, 0], index[:, -1])
    ]
    along = np.stack((rims[:, :-1], rims[:, 1:]), axis=2).reshape(-1, 2, 3)
    corners = rims[[0, 0, -1, -1], [0, -1, 0, -1]]
    spokes = np.stack((np.zeros_like(corners), corners), axis=1)
    return Wedge(vertices, np.concatenate((cap, *fans)).astype(np.uint32), np.concatenate((along, spokes)))


def field_of_view(lowest: float, highest: float, radius: float) -> F32:
    """(s, 2, 3) line segments of the sensor's field of view: a dome between two elevations (rad)."""
    azimuth = np.linspace(0.0, 2 * np.pi, 49)
    parallels = [_directions(np.full_like(azimuth, e), azimuth) for e in np.linspace(lowest, highest, 4)[:3]]
    climb = np.linspace(lowest, highest, 9)
    sides = np.arange(12) * (2 * np.pi / 12)
    lines = parallels + [_directions(climb, np.full_like(climb, side)) for side in sides]
    segments = [np.stack((line[:-1], line[1:]), axis=1) for line in lines]
    return (np.concatenate(segments) * radius).astype(np.float32)


def _directions(elevation: F64, azimuth: F64) -> F64:
    flat = np.cos(elevation)
    return np.column_stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)))


def disc(radius: float, samples: int = 64) -> tuple[F32, npt.NDArray[np.uint32], F32]:
    """Vertices, faces and rim segments of a disc about the origin in its x-y plane."""
    angle = np.linspace(0.0, 2 * np.pi, samples, endpoint=False)
    rim = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(samples))) * radius
    following = np.roll(np.arange(samples), -1)
    faces = np.column_stack((np.zeros(samples), 1 + np.arange(samples), 1 + following)).astype(np.uint32)
    vertices = np.concatenate((np.zeros((1, 3)), rim)).astype(np.float32)
    return vertices, faces, np.stack((rim, rim[following]), axis=1).astype(np.float32)


def foot(centroid: F64, normal: F64, down: F64) -> F64:
    """Where the ray from the sensor along `down` meets the plane, or the plane's nearest point if it never does."""
    along = float(down @ normal)
    height = float(centroid @ normal)
    if along * height <= 1e-6:
        return normal * height
    return down * (height / along)


def rotation_to(normal: F64) -> F64:
    """A rotation (3, 3) that turns +z into the unit vector `normal`."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(normal, x), normal))


def wxyz(rotation: F64) -> F64:
    """Convert a (3, 3) rotation to a quaternion in the scene's order: w, x, y, z."""
    return quaternion(rotation)[[3, 0, 1, 2]]
