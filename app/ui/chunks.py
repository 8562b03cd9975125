"""The growing map: one scene node per keyframe.

A keyframe's points are sent once, in its own LiDAR frame; a pose that moves later sends 7 numbers.
When the map outgrows the point budget, keyframes are sent again with fewer points.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from app.server.protocol import Chunk
from app.slam.types import F64, I64, U8
from app.ui.ceiling import below_ceiling
from app.ui.colours import MAP_OF, TABLES, ColourBy, Limits, grown, label_colours, value_colours
from app.ui.geometry import wxyz
from app.ui.thinning import next_to_thin, thinned, voxel_of_level
from app.ui.view import View

_SLACK: Final = 0.97
"""Over budget, the map is thinned to this share of it, so that not every new keyframe thins again."""

MEASURED: Final = (ColourBy.HEIGHT, ColourBy.INTENSITY, ColourBy.RING)
"""Colourings whose limits grow with the map; time's are the recording's duration."""


@dataclass(slots=True)
class _Drawn:
    chunk: Chunk
    T_map_lidar: F64
    shown: I64
    level: int
    handle: viser.PointCloudHandle | None
    """None while no point of it is shown."""
    limits: dict[ColourBy, Limits]
    """Ends of the colour maps with this keyframe and those before it."""

    @property
    def count(self) -> int:
        return len(self.shown)


def chunk_values(chunk: Chunk, T_map_lidar: F64, by: ColourBy, start_ns: int) -> F64:
    """The number that each point of a chunk is coloured by; `by` is not LABEL."""
    if by is ColourBy.HEIGHT:
        return np.asarray(chunk.points @ T_map_lidar[2, :3] + T_map_lidar[2, 3], dtype=np.float64)
    if by is ColourBy.INTENSITY:
        return chunk.intensity.astype(np.float64)
    if by is ColourBy.RING:
        return chunk.ring.astype(np.float64)
    return np.full(len(chunk.points), (chunk.stamp_ns - start_ns) * 1e-9)


def shown_points(chunk: Chunk, T_map_lidar: F64, level: int, ceilings: bool) -> I64:
    """Indices (ascending) of the points that are drawn at a level, with or without the ceiling above them."""
    mask = None if ceilings else below_ceiling(chunk.points, chunk.labels, T_map_lidar[2, :3])
    kept = np.arange(len(chunk.points)) if mask is None else np.flatnonzero(mask)
    return kept if level == 0 else kept[thinned(chunk.points[kept], voxel_of_level(level))]


def _pose(T: F64) -> tuple[F64, F64]:
    return wxyz(T[:3, :3]), T[:3, 3]


class MapChunks:
    """Draws keyframes below the scene node `root`, within a budget of points."""

    def __init__(self, scene: viser.SceneApi, root: str, budget: int) -> None:
        self._scene = scene
        self._root = root
        self._budget = budget
        self._drawn: list[_Drawn] = []
        self._view = View()
        self._limits: dict[ColourBy, Limits] = {}
        self._poses: F64 = np.empty((0, 4, 4))
        self._start_ns = 0

    @property
    def limits(self) -> dict[ColourBy, Limits]:
        """Ends of the colour maps, as drawn."""
        return self._limits

    @property
    def points(self) -> int:
        """Points drawn now."""
        return sum(drawn.count for drawn in self._drawn)

    def clear(self, start_ns: int, duration_s: float) -> None:
        """Take everything away for a new session. Names are used again, so nothing piles up."""
        for drawn in self._drawn:
            if drawn.handle is not None:
                drawn.handle.remove()
        self._drawn.clear()
        self._poses = np.empty((0, 4, 4))
        self._start_ns = start_ns
        self._limits = {ColourBy.TIME: Limits(0.0, max(duration_s, 1.0))}

    def _take_back(self, chunks: tuple[Chunk, ...]) -> None:
        """Take away the keyframes from the first on that is not among `chunks` any more."""
        same = (drawn.chunk is chunk for drawn, chunk in zip(self._drawn, chunks, strict=False))
        kept = next((index for index, is_same in enumerate(same) if not is_same), min(len(chunks), len(self._drawn)))
        if kept == len(self._drawn):
            return
        for drawn in self._drawn[kept:]:
            if drawn.handle is not None:
                drawn.handle.remove()
        del self._drawn[kept:]
        self._poses = self._poses[:kept]
        before = self._drawn[-1].limits if self._drawn else {}
        self._limits = {ColourBy.TIME: self._limits[ColourBy.TIME], **before}

    def draw(self, chunks: tuple[Chunk, ...], poses: F64, sensor: F64, view: View) -> None:
        """Add chunks that are new, take away those that are gone, move and colour anew where needed.

        Args:
            poses: (k, 4, 4) T_map_imu by keyframe index. sensor: (3,) m in the map.
        """
        before, seen = self._limits.get(view.colour_by), self._view
        self._view = view
        self._take_back(chunks)
        new = []
        for chunk in chunks[len(self._drawn) :]:
            T = poses[chunk.index] @ chunk.T_imu_lidar
            self._widen(chunk, T)
            new.append(_Drawn(chunk, T, np.empty(0, np.int64), 0, None, self._limits.copy()))
        recolour = view.colour_by is not seen.colour_by or self._limits.get(view.colour_by) != before
        restyle = (view.point_size, view.map) != (seen.point_size, seen.map)
        now = poses[[drawn.chunk.index for drawn in self._drawn]]
        moved = np.abs(now - self._poses).max(axis=(1, 2), initial=0.0) > 1e-5
        for drawn, has_moved in zip(self._drawn, moved, strict=True):
            if has_moved:
                drawn.T_map_lidar = poses[drawn.chunk.index] @ drawn.chunk.T_imu_lidar
            if view.ceilings != seen.ceilings:
                self._send(drawn, self._show(drawn))
            elif drawn.handle is not None:
                if has_moved:
                    drawn.handle.wxyz, drawn.handle.position = _pose(drawn.T_map_lidar)
                if restyle:
                    drawn.handle.point_size, drawn.handle.visible = view.point_size, view.map
                if recolour or (has_moved and view.colour_by is ColourBy.HEIGHT):
                    drawn.handle.colors = self._colours(drawn)
        for drawn in new:
            self._drawn.append(drawn)
            self._send(drawn, self._show(drawn))
        self._poses = poses[[drawn.chunk.index for drawn in self._drawn]]
        if self.points > self._budget:
            self._thin(sensor)

    def _widen(self, chunk: Chunk, T_map_lidar: F64) -> None:
        for by in MEASURED:
            limits = grown(self._limits.get(by), by, chunk_values(chunk, T_map_lidar, by, self._start_ns))
            if limits is not None:
                self._limits[by] = limits

    def _show(self, drawn: _Drawn) -> I64:
        return shown_points(drawn.chunk, drawn.T_map_lidar, drawn.level, self._view.ceilings)

    def _send(self, drawn: _Drawn, shown: I64) -> None:
        """Send these points of a keyframe in place of those sent before.

        Under the same name instead of through the handle's properties: a page that connects later is
        then not sent what was thinned away.
        """
        drawn.shown = shown
        if not len(shown):  # the page can not draw a cloud of no points
            if drawn.handle is not None:
                drawn.handle.remove()
                drawn.handle = None
            return
        orientation, position = _pose(drawn.T_map_lidar)
        drawn.handle = self._scene.add_point_cloud(
            f"{self._root}/{drawn.chunk.index}",
            drawn.chunk.points[drawn.shown],
            self._colours(drawn),
            point_size=self._view.point_size,
            point_shape="circle",
            point_shading="flat",
            wxyz=orientation,
            position=position,
            visible=self._view.map,
        )

    def _colours(self, drawn: _Drawn) -> U8:
        by, chunk = self._view.colour_by, drawn.chunk
        if by is ColourBy.LABEL:
            return label_colours(chunk.labels[drawn.shown])
        values = chunk_values(chunk, drawn.T_map_lidar, by, self._start_ns)[drawn.shown]
        return value_colours(values, self._limits.get(by, Limits(0.0, 1.0)), TABLES[MAP_OF[by]])

    def _thin(self, sensor: F64) -> None:
        positions = np.array([drawn.T_map_lidar[:3, 3] for drawn in self._drawn])
        levels = [drawn.level for drawn in self._drawn]
        total = self.points
        while total > self._budget * _SLACK and (index := next_to_thin(levels, positions, sensor)) is not None:
            drawn = self._drawn[index]
            levels[index] = drawn.level = drawn.level + 1
            shown = self._show(drawn)
            if len(shown) < drawn.count:
                total -= drawn.count - len(shown)
                self._send(drawn, shown)
