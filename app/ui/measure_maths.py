"""Measures in the map: the point under a click, coordinates, distances, heights, angles; as words and as CSV."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from app.export.box import Box
from app.georeference.reference import GeoReference
from app.mapping.kept import Measure, Spot
from app.server.protocol import Chunk
from app.slam import lie
from app.slam.kernels.cells import in_cone
from app.slam.text_files import csv_text
from app.slam.types import F32, F64, is_ground
from app.ui.chunks import shown_points

_GAP_M: Final = 0.2
"""Points under a click belong to one surface as long as each is at most this far behind the one before."""
_AROUND_M: Final = (0.3, 1.0)
"""Ground below a point is searched within the first of these horizontal distances, then within the second."""
_FLOOR_M: Final = 0.3
"""Ground points at most this far below the highest one belong to the same floor."""
_KEYFRAMES: Final = 20
"""Ground is searched in the points of this many nearest keyframes."""
COLUMNS: Final = (
    "name", "x_m", "y_m", "z_m", "height_m", "distance_m", "horizontal_m", "vertical_m", "angle_deg",
)  # fmt: skip
ON_EARTH: Final = ("east_m", "north_m", "grid_height_m")
"""Further columns if the map is georeferenced."""


@dataclass(frozen=True, slots=True)
class Numbers:
    """The results of a measure; NaN if they do not apply. height: above the ground below, m. angle: degrees."""

    height: float = np.nan
    distance: float = np.nan
    horizontal: float = np.nan
    vertical: float = np.nan
    angle: float = np.nan


def load() -> None:
    """Load the kernel of `meet` in advance, so that it does not delay the first click."""
    points, nothing = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    points.setflags(write=False)  # as those of chunks are
    in_cone(points, np.zeros(3), np.zeros(3), 0.0, np.empty(0, np.int32), nothing, nothing)


def meet(
    chunks: tuple[Chunk, ...],
    poses: F64,
    origin: F64,
    direction: F64,
    width: float,
    *,
    ceilings: bool,
    moving: bool = True,
    clip: Box | None = None,
) -> Spot | None:
    """The visible point under a click: of the points on the front surface, the nearest to the ray; None if none.

    Args:
        poses: (k, 4, 4) T_map_imu of the chunks' keyframes. origin, direction: (3,) of the ray, in the map.
        width: rad, largest angle between a point and the ray. ceilings, moving: whether such points are shown.
        clip: points outside this box are hidden.
    """
    most = max((len(chunk.points) for chunk in chunks), default=0)
    hits, along, off = np.empty(most, np.int32), np.empty(most, np.float32), np.empty(most, np.float32)
    found: list[tuple[F32, F32, Chunk, F32]] = []
    for chunk, T_map_imu in zip(chunks, poses, strict=False):
        T = T_map_imu @ chunk.T_imu_lidar
        eye, ahead = T[:3, :3].T @ (origin - T[:3, 3]), T[:3, :3].T @ direction / np.linalg.norm(direction)
        count = in_cone(chunk.points, eye, ahead, width, hits, along, off)
        if count:
            seen = shown_points(chunk, T, ceilings, clip, moving=moving)[hits[:count]]
            found.append((along[:count][seen], off[:count][seen], chunk, chunk.points[hits[:count][seen]]))
    every = np.sort(np.concatenate([np.empty(0), *(along for along, *_ in found)]))
    if not len(every):
        return None
    front = every[np.argmax(np.append(np.diff(every), np.inf) > _GAP_M)]  # includes all of a wall along the ray
    best = [np.where(along <= front, off, np.inf) for along, off, *_ in found]
    which = int(np.argmin([one.min(initial=np.inf) for one in best]))
    chunk, points = found[which][2:]
    x, y, z = lie.moved(chunk.T_imu_lidar, points[np.argmin(best[which])]).tolist()
    return Spot(chunk.index, (x, y, z), chunk.frame)


def places(measure: Measure, poses: F64, frames: Mapping[int, int] = MappingProxyType({})) -> F64 | None:
    """(1 to 3, 3) m, the spots in the map. None: a spot's keyframe does not exist, after going back or with other
    settings.

    Args:
        poses: (k, 4, 4) T_map_imu of the keyframes. frames: the frame of each known keyframe, by its index.
    """
    for spot in measure.spots:
        other = spot.frame not in (-1, frames.get(spot.keyframe, spot.frame))
        if other or not 0 <= spot.keyframe < len(poses):
            return None
    return np.array([lie.moved(poses[spot.keyframe], spot.at) for spot in measure.spots])


def numbers(at: F64, chunks: tuple[Chunk, ...], poses: F64) -> Numbers:
    """The results for one to three (n, 3) places in the map."""
    if len(at) == 1:
        return Numbers(height=height(at[0], chunks, poses))
    a, b = at[0] - at[1], at[-1] - at[1]
    if len(at) == 2:
        up = float(at[1, 2] - at[0, 2])
        return Numbers(distance=float(np.linalg.norm(a)), horizontal=float(np.hypot(a[0], a[1])), vertical=up)
    cross = float(np.linalg.norm(np.cross(a, b)))
    return Numbers(angle=float(np.degrees(np.arctan2(cross, a @ b))))


def height(place: F64, chunks: tuple[Chunk, ...], poses: F64) -> float:
    """Height (m) of a (3,) place above the highest floor labelled ground below it; NaN if there is none."""
    near = poses[[chunk.index for chunk in chunks], :2, 3] - place[:2]
    ground = [_ground(chunks[k], poses[chunks[k].index]) for k in np.argsort(np.linalg.norm(near, axis=1))[:_KEYFRAMES]]
    points = np.concatenate([np.empty((0, 3)), *ground]) - place
    points = points[points[:, 2] <= _FLOOR_M / 6]  # the place may lie on the ground itself, which is rough
    for around in _AROUND_M:
        z = points[np.hypot(points[:, 0], points[:, 1]) < around, 2]
        if len(z):
            return round(-float(np.median(z[z > z.max() - _FLOOR_M])), 3) + 0.0  # never a negative zero
    return np.nan


def _ground(chunk: Chunk, T_map_imu: F64) -> npt.NDArray[np.floating]:
    T = T_map_imu @ chunk.T_imu_lidar
    return np.asarray(lie.moved(T, chunk.points[is_ground(chunk.labels)]))


def around(chunks: tuple[Chunk, ...], poses: F64, place: F64, radius: float) -> F64:
    """(n, 3) points of the map within a radius (m) of a place."""
    found = [np.empty((0, 3))]
    for chunk in chunks:
        T = poses[chunk.index] @ chunk.T_imu_lidar
        own = (place - T[:3, 3]) @ T[:3, :3]
        near = np.linalg.norm(chunk.points - own, axis=1) < radius
        found.append(lie.moved(T, chunk.points[near]))
    return np.concatenate(found)


def words(at: F64, found: Numbers, where: GeoReference | None = None) -> str:
    """A measure in words, in metres and degrees. where: the map's georeference, if known."""
    if len(at) == 1:
        above = f", {round(found.height, 2) + 0.0:.2f} m above the ground" if np.isfinite(found.height) else ""
        own = f"x {at[0, 0]:.3f}, y {at[0, 1]:.3f}, z {at[0, 2]:.3f} m{above}"
        if where is None:
            return own
        ((east, north, up),) = where.to_crs(at).tolist()
        return f"{own}; E {east:.3f}, N {north:.3f}, H {up:.3f} m ({where.crs}, {where.height})"
    if len(at) == 2:
        return f"{found.distance:.3f} m: {found.horizontal:.3f} m horizontal, {found.vertical:+.3f} m vertical"
    return f"{found.angle:.1f}°"


def as_csv(measured: list[tuple[Measure, F64, Numbers]], where: GeoReference | None = None) -> str:
    """A row per spot, in the map and, if georeferenced, on Earth; the first row of a measure also has its results."""
    rows: list[tuple[object, ...]] = [(*COLUMNS, *(ON_EARTH if where is not None else ()))]
    for measure, at, found in measured:
        cells = [f"{value:.4f}" if np.isfinite(value) else "" for value in astuple(found)]
        for row, place in enumerate(at):
            there = where.to_crs(place)[0].tolist() if where is not None else []
            own, grid = ([f"{value:.4f}" for value in values] for values in (place, there))
            rows.append((measure.name, *own, *(cells if row == 0 else [""] * len(cells)), *grid))
    return csv_text(*rows)
