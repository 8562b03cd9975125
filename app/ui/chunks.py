"""The growing map: one scene node per keyframe, named by its index.

A keyframe's points are sent once, in its LiDAR frame; when its pose changes later, 7 numbers are sent.
When the map outgrows the point budget, snapshots hold some keyframes with fewer points: those are sent again.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt
import viser

from app.export.box import Box
from app.server.chunks import voxel_of_level
from app.server.protocol import Chunk
from app.slam.types import F32, F64, NON_GROUND, U8
from app.ui.colours import BY_POSE, INTENSITY, MODES, Limits, PointSet, chosen_ends, colours, grown
from app.ui.geometry import STILL_M
from app.ui.nodes import add_points, place
from app.ui.shading import light
from app.ui.widgets import View

_STILL: Final[F32] = np.array([5e-5, 5e-5, 5e-5, STILL_M], np.float32)
"""Largest change of a pose's rotation and position (m) that is not sent: each loop moves most of the map by less."""
_CONE: Final = float(np.cos(np.radians(35.0)))
_HIGHEST_M: Final = 8.0
_LEAST_SHARE: Final = 0.004
_FLATNESS_M: Final = 0.12
"""Most median deviation of the points overhead from their median height: treetops are rougher."""
_MARGIN_M: Final = 0.25
_SIZE_BY_GAP: Final = 0.5
_SAMPLE: Final = 200
"""Points of each keyframe that say how large the map is."""
Chosen: TypeAlias = npt.NDArray[np.bool_] | slice
"""Which points of a chunk."""


@dataclass(slots=True)
class _Drawn:
    """A keyframe in the scene.

    Attributes:
        limits: ends of the colour maps with this keyframe and those before it. light: (n,) of the chunk's points.
        shown: which of them were sent, `count` of them. handle: None while there are none.
    """

    chunk: Chunk
    limits: dict[str, Limits]
    light: F32
    shown: Chosen = field(default_factory=lambda: slice(None))
    count: int = 0
    handle: viser.PointCloudHandle | None = None


class MapChunks:
    """Draws keyframes below the scene node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._drawn: list[_Drawn] = []
        self._T_map_imu: F64 = np.empty((0, 3, 4))  # of each keyframe, as drawn
        self._view = View()
        self._coloured: tuple[Limits | None, Limits | None] = None, None
        self._fixed: dict[str, Limits] = {}
        self._start_ns = 0

    @property
    def limits(self) -> dict[str, Limits]:
        return self._drawn[-1].limits if self._drawn else self._fixed

    @property
    def points(self) -> int:
        return sum(drawn.count for drawn in self._drawn)

    def clear(self, start_ns: int, duration_s: float) -> None:
        """Remove everything for a new session."""
        self._keep(0)
        self._start_ns = start_ns
        self._fixed = {name: mode.fixed(duration_s) for name, mode in MODES.items() if mode.fixed is not None}

    def draw(self, chunks: tuple[Chunk, ...], poses: F64, view: View) -> None:
        """Show these keyframes: remove, add, thin, move and colour those that differ from what is drawn.

        Args:
            poses: (k, 4, 4) T_map_imu of at least these keyframes.
        """
        same = (_same(drawn.chunk, chunk) for drawn, chunk in zip(self._drawn, chunks, strict=False))
        self._keep(next((n for n, is_same in enumerate(same) if not is_same), min(len(chunks), len(self._drawn))))
        known = len(self._drawn)
        moved = self._move(poses[: len(chunks), :3])
        for chunk, T in zip(chunks[known:], self._T_map_imu[known:], strict=True):
            self._drawn.append(_Drawn(chunk, self._grown(chunk, T), light(chunk.points, T @ chunk.T_imu_lidar)))
        ends = chosen_ends(self.limits, view.colour_by, view.ends)
        seen, limits = self._view, (ends.get(view.colour_by), ends.get(INTENSITY))
        recolour = view.colour_by != seen.colour_by or limits != self._coloured
        cut = (view.ceilings, view.clip) != (seen.ceilings, seen.clip)
        self._view, self._coloured = view, limits
        for index, (drawn, chunk) in enumerate(zip(self._drawn, chunks, strict=True)):
            new = index >= known or chunk is not drawn.chunk
            if new or ((cut or (moved[index] and view.clip is not None)) and self._shows_others(drawn, index)):
                if chunk is not drawn.chunk:
                    drawn.chunk = chunk
                    drawn.light = light(chunk.points, self._T_map_imu[index] @ chunk.T_imu_lidar)
                self._send(drawn, self._T_map_imu[index])
            elif drawn.handle is not None:
                T = self._T_map_imu[index]
                if moved[index]:
                    place(drawn.handle, T @ chunk.T_imu_lidar)
                if view.map_point_size != seen.map_point_size or view.map != seen.map:
                    drawn.handle.point_size, drawn.handle.visible = self._size(chunk), view.map
                if recolour or (moved[index] and view.colour_by in BY_POSE):
                    drawn.handle.colors = self._colours(self._shown(drawn, T))

    def _keep(self, count: int) -> None:
        for drawn in self._drawn[count:]:
            if drawn.handle is not None:
                drawn.handle.remove()
        del self._drawn[count:]

    def _move(self, poses: F64) -> npt.NDArray[np.bool_]:
        """Take the (k, 3, 4) poses; which of the keyframes in the scene are to be drawn elsewhere."""
        now, before = poses.copy(), self._T_map_imu[: len(self._drawn)]
        moved = np.asarray((np.abs(now[: len(before)] - before) > _STILL).any(axis=(1, 2)))
        now[: len(before)][~moved] = before[~moved]
        self._T_map_imu = now
        return moved

    def _grown(self, chunk: Chunk, T_map_imu: F64) -> dict[str, Limits]:
        limits, cloud = self.limits, self._cloud(chunk, T_map_imu)
        for name, mode in MODES.items():
            wider = grown(limits.get(name), mode, mode.values(cloud)) if mode.fixed is None else None
            if wider is not None and wider != limits.get(name):
                limits = {**limits, name: wider}
        return limits

    def shown(self) -> Iterator[tuple[F64, U8]]:
        """(n, 3) points of the map that are shown, whether or not the map is, and their (n, 3) colours."""
        for drawn, T in zip(self._drawn, self._T_map_imu, strict=False):
            cloud = self._shown(drawn, T)
            T_map_lidar = cloud.T_map_lidar
            yield cloud.points @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3], self._colours(cloud)

    def sample(self) -> F64:
        """(m, 3) some points of all keyframes, in the map."""
        every = zip(self._drawn, self._T_map_imu, strict=False)
        some = [(T @ drawn.chunk.T_imu_lidar, drawn.chunk.points[:_SAMPLE]) for drawn, T in every]
        return np.concatenate([np.empty((0, 3)), *(points @ T[:3, :3].T + T[:3, 3] for T, points in some)])

    def _cloud(self, chunk: Chunk, T_map_imu: F64, shown: Chosen = slice(None), light: F32 | None = None) -> PointSet:
        return PointSet(
            chunk.points[shown],
            chunk.labels[shown],
            chunk.intensity[shown],
            chunk.ring[shown],
            T_map_imu @ chunk.T_imu_lidar,
            (chunk.stamp_ns - self._start_ns) * 1e-9,
            light,
        )

    def _shown(self, drawn: _Drawn, T_map_imu: F64) -> PointSet:
        return self._cloud(drawn.chunk, T_map_imu, drawn.shown, drawn.light[drawn.shown])

    def _chosen(self, chunk: Chunk, T_map_imu: F64) -> Chosen:
        return shown_points(chunk, T_map_imu @ chunk.T_imu_lidar, self._view.ceilings, self._view.clip)

    def _shows_others(self, drawn: _Drawn, index: int) -> bool:
        """Whether other points of it are to be shown than those that were sent."""
        now = self._chosen(drawn.chunk, self._T_map_imu[index])
        return not np.array_equal(as_mask(now, len(drawn.light)), as_mask(drawn.shown, len(drawn.light)))

    def _send(self, drawn: _Drawn, T_map_imu: F64) -> None:
        """Send a keyframe's points in place of those sent before.

        Under the same name instead of through the handle's properties: a page that connects later is
        then not sent what was thinned away.
        """
        drawn.shown = self._chosen(drawn.chunk, T_map_imu)
        cloud = self._shown(drawn, T_map_imu)
        drawn.count = len(cloud.points)
        if not drawn.count:  # the page cannot draw a cloud without points
            if drawn.handle is not None:
                drawn.handle.remove()
                drawn.handle = None
            return
        drawn.handle = add_points(
            self._scene,
            f"{self._root}/{drawn.chunk.index}",
            cloud.points,
            self._colours(cloud),
            self._size(drawn.chunk),
            cloud.T_map_lidar,
            visible=self._view.map,
        )

    def _size(self, chunk: Chunk) -> float:
        """m: points that are far apart, because they were thinned, are drawn larger, so that surfaces stay closed."""
        gap = voxel_of_level(chunk.level) if chunk.level else 0.0
        return self._view.map_point_size * max(1.0, _SIZE_BY_GAP * gap / self._view.point_size)

    def _colours(self, cloud: PointSet) -> U8:
        by = self._view.colour_by
        return colours(cloud, by, chosen_ends(self.limits, by, self._view.ends))


def shown_points(chunk: Chunk, T_map_lidar: F64, ceilings: bool, clip: Box | None = None) -> Chosen:
    """The points of a chunk that are drawn: with or without the ceiling above them, and only those in the box."""
    mask = None if ceilings else below_ceiling(chunk.points, chunk.labels, T_map_lidar[2, :3])
    if clip is not None:
        inside = clip.holds(chunk.points @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3])
        mask = inside if mask is None else mask & inside
    return slice(None) if mask is None or not len(mask) else mask


def as_mask(chosen: Chosen, count: int) -> npt.NDArray[np.bool_]:
    """(count,) whether each point is chosen."""
    return np.ones(count, np.bool_) if isinstance(chosen, slice) else chosen


def _same(drawn: Chunk, chunk: Chunk) -> bool:
    """Whether one is the other, or what it has become: thinned, relabelled, or with another keyframe's points added."""
    if drawn is chunk:
        return True
    return (drawn.index, drawn.frame, drawn.stamp_ns) == (chunk.index, chunk.frame, chunk.stamp_ns) and (
        drawn.level + drawn.joined <= chunk.level + chunk.joined
    )


def below_ceiling(points: F32, labels: U8, up: F64) -> npt.NDArray[np.bool_] | None:
    """Which points stay when the ceiling above a keyframe is hidden; None where nothing flat is overhead.

    Points labelled ground always stay: a ceiling mistaken for ground must be visible.

    Args:
        points: (n, 3) m, LiDAR frame. labels: (n,). up: (3,) unit, LiDAR frame.
    """
    height = points @ up.astype(np.float32)
    overhead = height[height > _CONE * np.linalg.norm(points, axis=1)]
    if len(overhead) < max(30.0, _LEAST_SHARE * len(points)):
        return None
    ceiling = float(np.median(overhead))
    if ceiling > _HIGHEST_M or float(np.median(np.abs(overhead - ceiling))) > _FLATNESS_M:
        return None
    return np.asarray((height < ceiling - _MARGIN_M) | (labels != NON_GROUND))
