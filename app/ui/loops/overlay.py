"""What is laid into the scene for one loop: two submaps in two colours, and the walk as it would become."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from app.server.protocol import Chunk
from app.slam import lie
from app.slam.types import F32, F64, NON_GROUND
from app.ui.ceiling import below_ceiling
from app.ui.chunks import shown_points
from app.ui.geometry import wxyz
from app.ui.loops.kinds import GHOST, NEWER, OLDER
from app.ui.paths import segments

_REACH: Final = 5
"""Keyframes before and after one whose points the page shows around it."""
_MOST_POINTS: Final = 30_000
_MOVED_M: Final = 0.02
_STICK: Final = (140, 120, 180)


def on_the_way(T_from: F64, T_to: F64, share: float) -> F64:
    """(4, 4) between two poses: the position goes straight, the rotation about one axis. share: 0 to 1."""
    turn = lie.log(T_from[:3, :3].T @ T_to[:3, :3])
    return lie.transform(T_from[:3, :3] @ lie.exp(share * turn), (1 - share) * T_from[:3, 3] + share * T_to[:3, 3])


def upright(T_map_imu: F64) -> F64:
    """(4, 4) T_map_upright: at the keyframe, with the map's axes."""
    return lie.transform(np.eye(3), T_map_imu[:3, 3])


def without_ceiling(points: F32) -> F32:
    """(n, 3) points of a submap, z up and its keyframe at the origin, without the ceiling above that."""
    mask = below_ceiling(points, np.full(len(points), NON_GROUND, np.uint8), np.array([0.0, 0.0, 1.0]))
    return points if mask is None else points[mask]


def surroundings(chunks: tuple[Chunk, ...], poses: F64, index: int, ceilings: bool) -> F32:
    """(n, 3) points around a keyframe in its upright frame, from the keyframes before and after it."""
    near = [chunk for chunk in chunks if abs(chunk.index - index) <= _REACH and chunk.index < len(poses)]
    share = _MOST_POINTS // max(len(near), 1)
    parts = [np.empty((0, 3))]
    for chunk in near:
        T = poses[chunk.index] @ chunk.T_imu_lidar
        points = chunk.points[shown_points(chunk, T, ceilings)][:share]
        parts.append(points @ T[:3, :3].T + T[:3, 3] - poses[index][:3, 3])
    return np.concatenate(parts).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """Two clouds to be laid over each other, each in a frame of its own.

    Attributes:
        older, newer: (n, 3). T_map_older: (4, 4) of the older's frame.
    """

    older: F32
    newer: F32
    T_map_older: F64


class Overlay:
    """The two clouds as nodes; their points are sent once, a moved slider sends a pose."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._nodes: dict[str, viser.PointCloudHandle] = {}
        self._shown: Pairing | None = None

    def draw(self, pairing: Pairing | None, T_map_newer: F64 | None, point_size: float) -> None:
        """Show the clouds with the newer's frame at `T_map_newer` (4, 4); None takes them away."""
        if pairing is None or T_map_newer is None:
            for node in self._nodes.values():
                node.remove()
            self._nodes.clear()
            self._shown = None
            return
        shown = self._shown
        for name, points, before, colour in (
            ("older", pairing.older, shown.older if shown else None, OLDER),
            ("newer", pairing.newer, shown.newer if shown else None, NEWER),
        ):
            if points is not before:
                self._send(name, points, colour, point_size)
        self._shown = pairing
        for name, T in (("older", pairing.T_map_older), ("newer", T_map_newer)):
            if name in self._nodes:
                self._nodes[name].wxyz, self._nodes[name].position = wxyz(T[:3, :3]), T[:3, 3]
                self._nodes[name].point_size = point_size

    def _send(self, name: str, points: F32, colour: tuple[int, int, int], point_size: float) -> None:
        old = self._nodes.pop(name, None)
        if not len(points):  # the page can not draw a cloud of no points
            if old is not None:
                old.remove()
            return
        self._nodes[name] = self._scene.add_point_cloud(
            f"{self._root}/{name}",
            points[:_MOST_POINTS],
            colour,
            point_size=point_size,
            point_shape="circle",
            precision="float32",  # a fit is judged by centimetres, and half a float has two of them at 20 m
        )


class Ghost:
    """The walk as a command would make it, tied by sticks to where it is now."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._nodes: list[viser.LineSegmentsHandle] = []
        self._drawn: tuple[F64 | None, F64 | None] = (None, None)

    def draw(self, tried: F64 | None, present: F64) -> None:
        """Show (k, 4, 4) poses `tried` beside those of the present; None takes them away."""
        if tried is self._drawn[0] and (tried is None or present is self._drawn[1]):
            return
        self._drawn = (tried, present)
        for node in self._nodes:
            node.remove()
        self._nodes.clear()
        if tried is None or len(tried) < 2:
            return
        there = tried[:, :3, 3]
        self._add("path", segments(there), GHOST, 3.0)
        here = present[: len(tried), :3, 3]
        sticks = np.stack((here, there[: len(here)]), axis=1).astype(np.float32)
        sticks = sticks[np.linalg.norm(sticks[:, 1] - sticks[:, 0], axis=1) > _MOVED_M]
        if len(sticks):
            self._add("moves", sticks, _STICK, 1.0)

    def _add(self, name: str, lines: F32, colour: tuple[int, int, int], width: float) -> None:
        self._nodes.append(
            self._scene.add_line_segments(
                f"{self._root}/{name}", lines, colour, thickness=width, thickness_units="screen"
            )
        )


class Gizmo:
    """Arrows and rings by which a person moves the newer cloud; there or not there."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene = scene
        self._root = root
        self._handle: viser.TransformControlsHandle | None = None

    def show(self, T_map: F64) -> None:
        """Put it at a pose (4, 4)."""
        self.hide()
        self._handle = self._scene.add_transform_controls(
            self._root, scale=1.6, depth_test=False, wxyz=wxyz(T_map[:3, :3]), position=T_map[:3, 3]
        )

    def hide(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None

    @property
    def pose(self) -> F64 | None:
        """(4, 4) where it was moved to; None while it is not there."""
        handle = self._handle
        if handle is None:
            return None
        return lie.transform(lie.matrix(np.asarray(handle.wxyz)[[1, 2, 3, 0]]), np.array(handle.position))
