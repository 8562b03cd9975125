"""The growing map: one scene node per keyframe.

A keyframe's points are sent once, in its own LiDAR frame; a pose that moves later sends 7 numbers.
When the map outgrows the point budget, snapshots hold some keyframes with fewer points: those are sent again.
What one goes back over is hidden, not taken away: going forth again, over the whole map too, sends no points.
Names of nodes that were taken away are used again, since viser remembers every name until another page connects.
"""

import heapq
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt
import viser

from app.server.protocol import Chunk
from app.slam.types import F32, F64, U8
from app.ui.ceiling import below_ceiling
from app.ui.colours import MAP_OF, TABLES, ColourBy, Limits, grown, label_colours, value_colours
from app.ui.geometry import wxyz
from app.ui.view import STILL_M, View

Chosen: TypeAlias = npt.NDArray[np.bool_] | slice
"""Which points of a chunk."""
_ALL: Final = slice(None)

MEASURED: Final = (ColourBy.HEIGHT, ColourBy.INTENSITY, ColourBy.RING)
"""Colourings whose limits grow with the map; time's are the recording's duration."""
_NO_POINTS: Final = np.empty((0, 3), np.float16)
_NO_COLOURS: Final = np.empty((0, 3), np.uint8)
_NO_POSES: Final[F32] = np.empty((0, 3, 4), np.float32)
_LAST_ROW: Final = np.eye(4)[3]
_STILL: Final[F32] = np.array([5e-5, 5e-5, 5e-5, STILL_M], np.float32)
"""Of a pose's rotation and position (m): no cloud is drawn farther off its keyframe, nor coloured by another height.
Each that is moved is two messages.
"""


@dataclass(slots=True)
class _Drawn:
    chunk: Chunk
    shown: Chosen
    count: int
    """Points that are shown."""
    handle: viser.PointCloudHandle | None
    """None while no point of it is shown."""
    limits: dict[ColourBy, Limits]
    """Ends of the colour maps with this keyframe and those before it; in common with others, never changed."""


@dataclass(frozen=True, slots=True)
class _Hidden:
    """A keyframe that was gone back over. T_map_imu (3, 4), view, limits: with which it was drawn last."""

    drawn: _Drawn
    T_map_imu: F32
    view: View
    limits: Limits | None


def chunk_values(chunk: Chunk, T_map_lidar: F64, by: ColourBy, start_ns: int) -> F64:
    """The number that each point of a chunk is coloured by; `by` is not LABEL."""
    if by is ColourBy.HEIGHT:
        return np.asarray(chunk.points @ T_map_lidar[2, :3] + T_map_lidar[2, 3], dtype=np.float64)
    if by is ColourBy.INTENSITY:
        return chunk.intensity.astype(np.float64)
    if by is ColourBy.RING:
        return chunk.ring.astype(np.float64)
    return np.full(len(chunk.points), (chunk.stamp_ns - start_ns) * 1e-9)


def shown_points(chunk: Chunk, T_map_lidar: F64, ceilings: bool) -> Chosen:
    """The points that are drawn, with or without the ceiling above them."""
    mask = None if ceilings else below_ceiling(chunk.points, chunk.labels, T_map_lidar[2, :3])
    return _ALL if mask is None or not len(mask) else mask


def _same(drawn: Chunk, chunk: Chunk) -> bool:
    """Whether one is the other or what it has become: thinned, or with others' points."""
    if drawn is chunk:
        return True
    return (drawn.index, drawn.frame, drawn.stamp_ns) == (chunk.index, chunk.frame, chunk.stamp_ns) and (
        drawn.level + drawn.joined < chunk.level + chunk.joined
    )


def _forget(handle: viser.PointCloudHandle) -> None:
    """Keep what was sent once: viser has it in the message for pages to come, and again in the handle's properties."""
    handle._impl.props.points, handle._impl.props.colors = _NO_POINTS, _NO_COLOURS


def _pose(T: F64) -> tuple[F64, F64]:
    return wxyz(T[:3, :3]), T[:3, 3]


class MapChunks:
    """Draws keyframes below the scene node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._drawn: list[_Drawn] = []
        self._hidden: deque[_Hidden] = deque()  # those that followed
        self._named = 0
        self._free: list[int] = []  # of these so many names; a heap
        self._view = View()
        self._limits: dict[ColourBy, Limits] = {}
        self._poses = _NO_POSES  # (k, 3, 4) T_map_imu of all keyframes, as they are drawn
        self._lifts = _NO_POSES[:, 2]  # (k, 4), their third rows as they are coloured by height
        self._given: Callable[[], F64 | None] = lambda: None  # those of the last snapshot
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
        """Take everything away for a new session."""
        for drawn in self._drawn:
            self._remove(drawn)
        self._drawn.clear()
        self._drop_hidden()
        self._poses, self._lifts, self._given = _NO_POSES, _NO_POSES[:, 2], lambda: None
        self._start_ns = start_ns
        self._limits = {ColourBy.TIME: Limits(0.0, max(duration_s, 1.0))}

    def _drop_hidden(self) -> None:
        for hidden in self._hidden:
            self._remove(hidden.drawn)
        self._hidden.clear()

    def _remove(self, drawn: _Drawn) -> None:
        if drawn.handle is not None:
            heapq.heappush(self._free, int(drawn.handle.name.rpartition("/")[2]))
            drawn.handle.remove()
            drawn.handle = None

    def _name(self) -> str:
        """For another node."""
        if not self._free:
            self._free.append(self._named)
            self._named += 1
        return f"{self._root}/{heapq.heappop(self._free)}"

    def _take_back(self, chunks: tuple[Chunk, ...], seen: View) -> None:
        """Hide the keyframes from the first on that is not among `chunks` any more, be it thinned or not.

        Args:
            seen: with which they were drawn.
        """
        same = (_same(drawn.chunk, chunk) for drawn, chunk in zip(self._drawn, chunks, strict=False))
        kept = next((index for index, is_same in enumerate(same) if not is_same), min(len(chunks), len(self._drawn)))
        if kept == len(self._drawn):
            return
        limits = self._limits.get(seen.colour_by)
        gone = [_Hidden(drawn, self._poses[drawn.chunk.index].copy(), seen, limits) for drawn in self._drawn[kept:]]
        self._hidden.extendleft(reversed(gone))
        for drawn in self._drawn[kept:]:
            if drawn.handle is not None:
                drawn.handle.visible = False
        del self._drawn[kept:]
        before = self._drawn[-1].limits if self._drawn else {}
        self._limits = {ColourBy.TIME: self._limits[ColourBy.TIME], **before}

    def draw(self, chunks: tuple[Chunk, ...], poses: F64, view: View) -> None:
        """Add chunks that are new, hide those that are gone, thin, move and colour anew where needed.

        Args:
            poses: (k, 4, 4) T_map_imu by keyframe index.
        """
        before, seen = self._limits.get(view.colour_by), self._view
        self._view = view
        self._take_back(chunks, seen)
        moved, lifted = self._move(poses)
        new: list[_Drawn] = []
        again: list[tuple[_Hidden, Chunk]] = []
        for chunk in chunks[len(self._drawn) :]:
            hidden = self._hidden_one(chunk)
            if hidden is None:
                self._widen(chunk)
                new.append(_Drawn(chunk, _ALL, 0, None, self._limits))
            else:
                self._limits = hidden.drawn.limits
                again.append((hidden, chunk))
        recolour = view.colour_by is not seen.colour_by or self._limits.get(view.colour_by) != before
        restyle = (view.point_size, view.map) != (seen.point_size, seen.map)
        for drawn, chunk, has_moved, is_lifted in zip(self._drawn, chunks, moved, lifted, strict=False):
            if view.ceilings != seen.ceilings or chunk is not drawn.chunk:
                drawn.chunk = chunk
                self._send(drawn)
            elif drawn.handle is not None:
                if has_moved:
                    drawn.handle.wxyz, drawn.handle.position = _pose(self._placed(chunk))
                if restyle:
                    drawn.handle.point_size, drawn.handle.visible = view.point_size, view.map
                if recolour or (is_lifted and view.colour_by is ColourBy.HEIGHT):
                    self._colour(drawn, drawn.handle)
        for hidden, chunk in again:
            self._drawn.append(hidden.drawn)
            self._show_again(hidden, chunk)
        for drawn in new:
            self._drawn.append(drawn)
            self._send(drawn)

    def _move(self, poses: F64) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Take the poses of now; which of the keyframes that are drawn have others, and which have their points at
        other heights.
        """
        count = len(self._drawn)
        if self._given() is poses:
            return np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        self._given = weakref.ref(poses)
        now = poses[:, :3].astype(np.float32)
        before, lifts = self._poses[: len(now)], self._lifts[: len(now)]
        moved = np.asarray((np.abs(now[: len(before)] - before) > _STILL).any(axis=(1, 2)))
        now[: len(before)][~moved] = before[~moved]
        lifted = np.asarray((np.abs(now[: len(before), 2] - lifts) > _STILL).any(axis=1))
        self._poses, self._lifts = now, now[:, 2].copy()
        self._lifts[: len(before)][~lifted] = lifts[~lifted]
        return moved[:count], lifted[:count]

    def _placed(self, chunk: Chunk) -> F64:
        """(4, 4) T_map_lidar."""
        return np.asarray(np.vstack((self._poses[chunk.index], _LAST_ROW)) @ chunk.T_imu_lidar)

    def _hidden_one(self, chunk: Chunk) -> _Hidden | None:
        """The next that was hidden, if it is this one; else none of them comes again."""
        if self._hidden and _same(self._hidden[0].drawn.chunk, chunk):
            return self._hidden.popleft()
        self._drop_hidden()
        return None

    def _show_again(self, hidden: _Hidden, chunk: Chunk) -> None:
        drawn, seen, view = hidden.drawn, hidden.view, self._view
        moved = bool((np.abs(self._poses[chunk.index] - hidden.T_map_imu) > _STILL).any())
        if not moved:
            self._poses[chunk.index] = hidden.T_map_imu
        if chunk is not drawn.chunk or view.ceilings != seen.ceilings:
            drawn.chunk = chunk
            self._send(drawn)
        elif drawn.handle is not None:
            if moved:
                drawn.handle.wxyz, drawn.handle.position = _pose(self._placed(chunk))
            if view.point_size != seen.point_size:
                drawn.handle.point_size = view.point_size
            recolour = view.colour_by is not seen.colour_by or self._limits.get(view.colour_by) != hidden.limits
            if recolour or (moved and view.colour_by is ColourBy.HEIGHT):
                self._colour(drawn, drawn.handle)
            drawn.handle.visible = view.map

    def _widen(self, chunk: Chunk) -> None:
        T = self._placed(chunk)
        for by in MEASURED:
            before = self._limits.get(by)
            limits = grown(before, by, chunk_values(chunk, T, by, self._start_ns))
            if limits is not None and limits != before:
                self._limits = {**self._limits, by: limits}

    def _send(self, drawn: _Drawn) -> None:
        """Send the points of a keyframe that are shown now in place of those sent before.

        Under the same name instead of through the handle's properties: a page that connects later is
        then not sent what was thinned away.
        """
        T_map_lidar = self._placed(drawn.chunk)
        drawn.shown = shown_points(drawn.chunk, T_map_lidar, self._view.ceilings)
        points = drawn.chunk.points[drawn.shown]
        drawn.count = len(points)
        if not len(points):  # the page can not draw a cloud of no points
            self._remove(drawn)
            return
        orientation, position = _pose(T_map_lidar)
        drawn.handle = self._scene.add_point_cloud(
            drawn.handle.name if drawn.handle is not None else self._name(),
            points,
            self._colours(drawn),
            point_size=self._view.point_size,
            point_shape="circle",
            point_shading="flat",
            wxyz=orientation,
            position=position,
            visible=self._view.map,
        )
        _forget(drawn.handle)

    def _colour(self, drawn: _Drawn, handle: viser.PointCloudHandle) -> None:
        handle.colors = self._colours(drawn)
        _forget(handle)

    def _colours(self, drawn: _Drawn) -> U8:
        by, chunk = self._view.colour_by, drawn.chunk
        if by is ColourBy.LABEL:
            return label_colours(chunk.labels[drawn.shown])
        values = chunk_values(chunk, self._placed(chunk), by, self._start_ns)[drawn.shown]
        return value_colours(values, self._limits.get(by, Limits(0.0, 1.0)), TABLES[MAP_OF[by]])
