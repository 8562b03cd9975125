"""The growing map: one scene node per keyframe, named by its index.

A keyframe's points are sent once, in its LiDAR frame; when its pose changes later, only 7 numbers are sent.
If a map is larger than the page's budget of points, only a part of each keyframe is sent; it is sent again when that
part changes because a camera moves (`parts`). In the snapshot of a huge map, some keyframes already have fewer points.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
import viser

from app.export.box import Box
from app.export.ceilings import below_ceiling
from app.server.chunks import VOXEL_M, voxel_of_level
from app.server.protocol import Chunk
from app.server.setup import POINT_BUDGET
from app.slam import lie
from app.slam.types import F32, F64, I64, MOVING, U8
from app.ui.colours import BY_POSE, DIMMED, INTENSITY, MODES, Limits, PointSet, chosen_ends, colours, grown
from app.ui.geometry import STILL_M
from app.ui.nodes import add_points, place
from app.ui.shading import light
from app.ui.widgets import View

_STILL: Final[F32] = np.array([5e-5, 5e-5, 5e-5, STILL_M], np.float32)
"""Changes of a pose's rotation and position (m) up to this are not sent; a loop moves most of the map by less."""
_SIZE_BY_GAP: Final = 0.5
_GAP_BY_SHARE: Final = 0.25
"""Exponent by which gaps grow as points are left out: 0.5 for one keyframe, but other keyframes fill half of them."""
_NO_EYES: Final[F64] = np.zeros((0, 3))
_NEAR_M: Final = 3.0
_COARSEST: Final = -12.0
"""Nearer keyframes are drawn as if at `_NEAR_M`; each keeps at least 2^`_COARSEST` of its points."""
_AT_ONCE: Final = 300_000
"""Most points that are added to known keyframes at once; the nearest keyframes come first."""
_SAMPLE: Final = 200
"""Points of each keyframe from which the extent of the map is found."""


def parts(counts: I64, positions: F64, eyes: F64, most: int) -> I64:
    """(k,) how many points of each keyframe to draw: all, if these are at most `most`, otherwise at most that many.

    A keyframe twice as far away gets a quarter of the points, which are then equally dense in the picture. Shares are
    powers of one half, so that few keyframes change as a camera moves.

    Args:
        counts: (k,) points of each keyframe. positions: (k, 3) m. eyes: (e, 3) m, where cameras are.
    """
    if counts.sum() <= most:
        return counts
    away = np.linalg.norm(positions[:, None] - eyes[None], axis=2).min(axis=1, initial=1e6)
    density = -2 * np.log2(np.maximum(away, _NEAR_M))

    def drawn(level: float) -> I64:
        shares = np.exp2(np.clip(np.floor(density + level), _COARSEST, 0.0))
        return np.asarray(counts * shares, np.int64)

    low, high = 0.0, 2 * np.log2(1e6) + 1
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if drawn(middle).sum() <= most else (low, middle)
    return drawn(low)


@dataclass(slots=True)
class _Drawn:
    """A keyframe in the scene.

    Attributes:
        T_map_lidar: where it is drawn. light: (n,) brightness of the chunk's points.
        limits: ends of the colour maps with this keyframe and those before it.
        part: how many of the points may be drawn. shown: (n,) which points were sent.
        handle: None while no points are drawn.
    """

    chunk: Chunk
    T_map_lidar: F64
    limits: dict[str, Limits]
    light: F32
    part: int = 0
    shown: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    handle: viser.PointCloudHandle | None = None


class MapChunks:
    """Draws keyframes below the scene node `root`, with at most `budget` points.

    Attributes:
        settled: whether everything wanted is drawn. partial: whether the map has more points than are drawn.
        limits: ends of the colour maps as drawn, by mode.
    """

    def __init__(self, scene: viser.SceneApi, root: str, budget: int = POINT_BUDGET) -> None:
        self._scene, self._budget = scene, budget
        self.settled, self.partial = True, False
        self._root = root
        self._drawn: list[_Drawn] = []
        self._T_map_imu: F64 = np.empty((0, 3, 4))  # of each keyframe, as drawn
        self._view = View()
        self._look: tuple[object, ...] = ()  # what the colours depend on
        self._fixed: dict[str, Limits] = {}
        self.limits: dict[str, Limits] = {}
        self._start_ns = 0

    def _of_keyframes(self) -> dict[str, Limits]:
        return self._drawn[-1].limits if self._drawn else self._fixed

    @property
    def points(self) -> int:
        return sum(int(np.count_nonzero(drawn.shown)) for drawn in self._drawn)

    @property
    def moving(self) -> int:
        """Number of points on moving objects, shown or not."""
        return sum(int(np.count_nonzero(drawn.chunk.labels == MOVING)) for drawn in self._drawn)

    def clear(self, start_ns: int, duration_s: float) -> None:
        """Remove everything for a new session."""
        self._keep(0)
        self._start_ns = start_ns
        self._fixed = {name: mode.fixed(duration_s) for name, mode in MODES.items() if mode.fixed is not None}
        self.limits = self._fixed

    def draw(self, chunks: tuple[Chunk, ...], poses: F64, view: View, eyes: F64 = _NO_EYES) -> None:
        """Show these keyframes: remove, add, thin, move and colour those that differ from what is drawn.

        Args:
            poses: (k, 4, 4) T_map_imu of at least these keyframes. eyes: (e, 3) m, where cameras are in the map.
        """
        same = [drawn.chunk.stamp_ns == chunk.stamp_ns for drawn, chunk in zip(self._drawn, chunks, strict=False)]
        self._keep([*same, False].index(False))
        known = len(self._drawn)
        moved = self._move(poses[: len(chunks), :3])
        for chunk, T_map_imu in zip(chunks[known:], self._T_map_imu[known:], strict=True):
            T = T_map_imu @ chunk.T_imu_lidar
            self._drawn.append(_Drawn(chunk, T, self._grown(chunk, T), light(chunk.points, T)))
        limits = self._of_keyframes() | ({view.colour_by: view.numbers.limits} if view.numbers is not None else {})
        if limits != self.limits:
            self.limits = limits
        ends = chosen_ends(self.limits, view.colour_by, view.ends)
        look: tuple[object, ...] = (view.colour_by, view.numbers, ends.get(view.colour_by), ends.get(INTENSITY))
        if view.tuning:  # the map is dimmed, in one colour
            look = (view.light,)
        recolour, self._look = look != self._look, look
        seen, self._view = self._view, view
        cut = (view.ceilings, view.moving, view.clip) != (seen.ceilings, seen.moving, seen.clip)
        parts = self._parts(chunks, known, eyes)
        for index, (drawn, chunk) in enumerate(zip(self._drawn, chunks, strict=True)):
            new = index >= known or chunk is not drawn.chunk or parts[index] != drawn.part
            drawn.part, elsewhere = int(parts[index]), index < known and bool(moved[index])
            if elsewhere:
                drawn.T_map_lidar = self._T_map_imu[index] @ chunk.T_imu_lidar
            if chunk is not drawn.chunk:
                drawn.chunk, drawn.light = chunk, light(chunk.points, drawn.T_map_lidar)
            if new or ((cut or (elsewhere and view.clip is not None)) and self._shows_others(drawn)):
                self._send(drawn)
            elif drawn.handle is not None:
                if elsewhere:
                    place(drawn.handle, drawn.T_map_lidar)
                if view.map_point_size != seen.map_point_size or view.map != seen.map:
                    drawn.handle.point_size, drawn.handle.visible = self._size(drawn), view.map
                if recolour or (elsewhere and view.colour_by in BY_POSE and not view.tuning):
                    drawn.handle.colors = self._drawn_colours(self._shown(drawn))

    def _parts(self, chunks: tuple[Chunk, ...], known: int, eyes: F64) -> I64:
        """(k,) how many points of each to draw now. Known keyframes lose points at once and gain them gradually."""
        positions = self._T_map_imu[:, :, 3]
        counts = np.array([len(chunk.points) for chunk in chunks], np.int64)
        self.partial = counts.sum() > self._budget
        wanted = parts(counts, positions, eyes, self._budget)
        before = np.array([drawn.part for drawn in self._drawn[:known]], np.int64)
        growing = np.flatnonzero(wanted[:known] > before)
        growing = growing[np.argsort(-wanted[growing])]  # near keyframes have most
        waiting = growing[1:][np.cumsum(wanted[growing])[1:] > _AT_ONCE]
        wanted[waiting] = before[waiting]
        self.settled = not len(waiting)
        return wanted

    def _keep(self, count: int) -> None:
        for drawn in self._drawn[count:]:
            if drawn.handle is not None:
                drawn.handle.remove()
        del self._drawn[count:]

    def _move(self, poses: F64) -> npt.NDArray[np.bool_]:
        """Store the (k, 3, 4) poses. Returns a mask of the keyframes in the scene that moved."""
        now, before = poses.copy(), self._T_map_imu[: len(self._drawn)]
        moved = np.asarray((np.abs(now[: len(before)] - before) > _STILL).any(axis=(1, 2)))
        now[: len(before)][~moved] = before[~moved]
        self._T_map_imu = now
        return moved

    def _grown(self, chunk: Chunk, T_map_lidar: F64) -> dict[str, Limits]:
        limits, cloud = self._of_keyframes(), self._cloud(chunk, T_map_lidar, np.ones(len(chunk.points), np.bool_))
        for name, mode in MODES.items():
            of_each = mode.fixed is None and not mode.of_map
            wider = grown(limits.get(name), mode, mode.values(cloud)) if of_each else None
            if wider is not None and wider != limits.get(name):
                limits = {**limits, name: wider}
        return limits

    def shown(self) -> Iterator[tuple[F64, U8]]:
        """(n, 3) points chosen for display, even if the map is hidden, and their (n, 3) colours."""
        for drawn in self._drawn:
            cloud = self._shown(drawn)
            yield lie.moved(drawn.T_map_lidar, cloud.points), self._colours(cloud)

    def sample(self) -> F64:
        """(m, 3) some points of all keyframes, in the map."""
        some = [lie.moved(drawn.T_map_lidar, drawn.chunk.points[:_SAMPLE]) for drawn in self._drawn]
        return np.concatenate([np.empty((0, 3)), *some])

    def _cloud(
        self, chunk: Chunk, T_map_lidar: F64, shown: npt.NDArray[np.bool_], light: F32 | None = None
    ) -> PointSet:
        numbers = self._view.numbers.of(chunk)[shown] if self._view.numbers is not None else None
        seconds = (chunk.stamp_ns - self._start_ns) * 1e-9
        return PointSet.of(chunk, shown, T_map_lidar, seconds, light, chunk.index, numbers)

    def _shown(self, drawn: _Drawn) -> PointSet:
        return self._cloud(drawn.chunk, drawn.T_map_lidar, drawn.shown, drawn.light[drawn.shown])

    def _chosen(self, drawn: _Drawn) -> npt.NDArray[np.bool_]:
        view = self._view
        return shown_points(drawn.chunk, drawn.T_map_lidar, view.ceilings, view.clip, drawn.part, moving=view.moving)

    def _shows_others(self, drawn: _Drawn) -> bool:
        return not np.array_equal(self._chosen(drawn), drawn.shown)

    def _send(self, drawn: _Drawn) -> None:
        """Send a keyframe's points in place of those sent before.

        The node is replaced by name instead of through the handle's properties; otherwise a page that connects later
        would also be sent the points that were removed.
        """
        drawn.shown = self._chosen(drawn)
        if not drawn.shown.any():  # the page cannot draw a cloud without points
            if drawn.handle is not None:
                drawn.handle.remove()
                drawn.handle = None
            return
        cloud = self._shown(drawn)
        drawn.handle = add_points(
            self._scene,
            f"{self._root}/{drawn.chunk.index}",
            cloud.points,
            self._drawn_colours(cloud),
            self._size(drawn),
            drawn.T_map_lidar,
            visible=self._view.map,
        )

    def _size(self, drawn: _Drawn) -> float:
        """Size of the points, m. If many are left out, the others are drawn larger, so that surfaces stay closed."""
        chunk = drawn.chunk
        gap = voxel_of_level(chunk.level) if chunk.level else VOXEL_M
        gap *= float((len(chunk.points) / max(drawn.part, 1)) ** _GAP_BY_SHARE)
        return self._view.map_point_size * max(1.0, _SIZE_BY_GAP * gap / self._view.point_size)

    def _drawn_colours(self, cloud: PointSet) -> U8:
        """(n, 3) colours; while the map is dimmed, one colour (3,) for all."""
        return np.array(DIMMED[self._view.light], np.uint8) if self._view.tuning else self._colours(cloud)

    def _colours(self, cloud: PointSet) -> U8:
        by = self._view.colour_by
        return colours(cloud, by, chosen_ends(self.limits, by, self._view.ends))


def shown_points(
    chunk: Chunk,
    T_map_lidar: F64,
    ceilings: bool,
    clip: Box | None = None,
    part: int | None = None,
    *,
    moving: bool = True,
) -> npt.NDArray[np.bool_]:
    """Mask of the points of a chunk that are drawn, with or without its ceiling, and only inside the box.

    Args:
        part: use only this many points, from the first on; None: all. moving: include points on moving objects.
    """
    mask = np.arange(len(chunk.points)) < (len(chunk.points) if part is None else part)
    if not ceilings:
        mask &= below_ceiling(chunk.points, chunk.labels, T_map_lidar[2, :3])
    if not moving:
        mask &= chunk.labels != MOVING
    if clip is not None:
        mask &= clip.holds(lie.moved(T_map_lidar, chunk.points))
    return mask
