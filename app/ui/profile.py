"""The profile along the walked path in the scene: x is the chainage, y the offset to the left, z the height."""

import contextlib
from collections.abc import Callable, Iterable
from typing import Final

import numpy as np
import viser

from app.export.section import along_path, strides
from app.server.protocol import Snapshot
from app.slam.errors import HemislamError
from app.slam.types import F64, U8
from app.ui.nodes import add_exact_points, clear
from app.ui.widgets import Changes, View

_PERIOD_S: Final = 1.0
"""Least time between two drawings of the profile while the map grows."""


def unrolled(parts: Iterable[tuple[F64, U8]], path: F64, slab: float) -> tuple[F64, U8]:
    """Points of the map beside a path, unrolled along it.

    Args:
        parts: (n, 3) points and their (n, 3) colours. path: (m, 2) m. slab: m, its width.

    Returns:
        (k, 3) chainage, offset to the left and height, m, and (k, 3) colours.
    """
    found, colours = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    for points, own in parts:
        which, along, aside = along_path(points[:, :2], path, slab / 2)
        found.append(np.column_stack([along, aside, points[which, 2]]))
        colours.append(own[which])
    return np.concatenate(found), np.concatenate(colours)


class ProfileNode:
    """Replaces the map and everything in it while a profile is shown.

    root: the node of the map. shown: returns the map's points with their colours.
    """

    def __init__(
        self, scene: viser.SceneApi, root: viser.FrameHandle, shown: Callable[[], Iterable[tuple[F64, U8]]]
    ) -> None:
        self._scene, self._root, self._shown = scene, root, shown
        self._changes = Changes(period_s=_PERIOD_S)
        self._nodes: list[viser.PointCloudHandle] = []

    def draw(self, current: Snapshot, view: View) -> None:
        """Show the profile if the view asks for it and the walked path is long enough."""
        self._root.visible = not view.slab
        if not view.slab:
            clear(self._nodes)
            self._changes()
        elif self._changes(current.chunks, current.keyframe_poses, view):
            clear(self._nodes)
            with contextlib.suppress(HemislamError):  # the path is too short
                path = strides(current.trajectory[:, :2])
                points, colours = unrolled(self._shown(), path, view.slab)
                if len(points):
                    exact = points.astype(np.float32)
                    node = add_exact_points(self._scene, "/profile", exact, colours, view.point_size)
                    node.position = self._root.position
                    self._nodes.append(node)
