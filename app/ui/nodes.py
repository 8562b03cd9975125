"""Scene nodes of the page: points, lines and translucent surfaces placed by a pose, and long paths."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser

from app.slam.types import F32, F64, U8
from app.ui.colours import Rgb
from app.ui.geometry import STILL_M, wxyz

PATH_COLOUR: Final = (255, 92, 141)
TRUTH_COLOUR: Final = (120, 150, 255)
BLOCK: Final = 256
"""Segments per node, so that a new frame resends only the newest node, not the path of an hour."""
_MOST_TRUTH_POINTS: Final = 4000
_LABEL_TEXT: Final = 32
"""Most letters of a user's text in a label in the scene."""

NO_POINTS: Final = np.zeros((1, 3), np.float32)
NO_COLOURS: Final = np.zeros((1, 3), np.uint8)
NO_LINES: Final = np.zeros((1, 2, 3), np.float32)
"""Contents of a node before there is anything to draw: the page cannot draw a node without points."""


def _posed(T: F64 | None) -> dict[str, Any]:
    return {} if T is None else {"wxyz": wxyz(T[:3, :3]), "position": T[:3, 3]}


def place(node: viser.SceneNodeHandle, T: F64) -> None:
    """Move a node to a pose (3 or 4, 4) in its parent's frame."""
    node.wxyz, node.position = wxyz(T[:3, :3]), T[:3, 3]


def label_text(text: str) -> str:
    """A text shortened for a label in the scene, since a long one would cover the map."""
    return text if len(text) <= _LABEL_TEXT else text[: _LABEL_TEXT - 1].rstrip() + "…"


def clear(nodes: list[Any]) -> None:
    """Remove nodes from the scene, and from the list."""
    while nodes:
        nodes.pop().remove()


def add_points(
    scene: viser.SceneApi, name: str, points: F32, colours: U8 | Rgb, size: float, T: F64 | None = None,
    *, visible: bool = True,
) -> viser.PointCloudHandle:  # fmt: skip
    """(n, 3) points, n > 0, as flat discs of `size` m, sent as half floats."""
    return scene.add_point_cloud(
        name, points, colours, point_size=size, point_shape="circle", point_shading="flat", visible=visible, **_posed(T)
    )


def add_exact_points(
    scene: viser.SceneApi, name: str, points: F32, colours: U8 | Rgb, size: float
) -> viser.PointCloudHandle:
    """(n, 3) points, n > 0, sent as full floats: a half float resolves 2 cm at 20 m."""
    return scene.add_point_cloud(name, points, colours, point_size=size, point_shape="circle", precision="float32")


def add_lines(
    scene: viser.SceneApi, name: str, segments: F32, colour: Rgb, width: float, T: F64 | None = None,
    *, visible: bool = True,
) -> viser.LineSegmentsHandle:  # fmt: skip
    """(n, 2, 3) segments of `width` pixels."""
    return scene.add_line_segments(
        name, segments, colour, thickness=width, thickness_units="screen", visible=visible, **_posed(T)
    )


def add_surface(
    scene: viser.SceneApi, name: str, vertices: F32, faces: npt.NDArray[np.uint32], colour: Rgb, opacity: float,
    T: F64 | None = None,
) -> viser.MeshHandle:  # fmt: skip
    """A translucent mesh that throws no shadow."""
    return scene.add_mesh_simple(
        name, vertices, faces, color=colour, opacity=opacity, side="double", material="toon3", cast_shadow=False,
        receive_shadow=False, **_posed(T),
    )  # fmt: skip


def segments(positions: F64 | F32) -> F32:
    """(n, 3) positions -> (n-1, 2, 3) segments between neighbours."""
    return np.stack((positions[:-1], positions[1:]), axis=1).astype(np.float32)


class TrajectoryNode:
    """A path, in blocks of at most `BLOCK` segments below the node `root`."""

    def __init__(self, scene: viser.SceneApi, root: str, colour: Rgb = PATH_COLOUR, width: float = 3.0) -> None:
        self._scene, self._root, self._colour, self._width = scene, root, colour, width
        self._blocks: list[viser.LineSegmentsHandle] = []

    def draw(self, positions: F64, visible: bool) -> None:
        """Draw (n, 3) positions, sending only the blocks that changed."""
        while len(self._blocks) > -(-max(len(positions) - 1, 0) // BLOCK):
            self._blocks.pop().remove()
        for index, first in enumerate(range(0, len(positions) - 1, BLOCK)):
            part = segments(positions[first : first + BLOCK + 1])
            if index == len(self._blocks):
                self._blocks.append(add_lines(self._scene, f"{self._root}/{index}", part, self._colour, self._width))
            elif len(part) != len(drawn := self._blocks[index].points) or np.abs(part - drawn).max() > STILL_M:
                self._blocks[index].points = part
            self._blocks[index].visible = visible


class Truth:
    """The true path in the truth's own frame. Only the pose of the frame changes as the trajectory grows."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._frame = scene.add_frame(root, show_axes=False, visible=False)
        self._path = TrajectoryNode(scene, f"{root}/path", TRUTH_COLOUR, 1.5)

    def draw(self, positions: F64 | None, T_map_truth: F64 | None, visible: bool) -> None:
        """Show (m, 3) positions transformed by `T_map_truth` (4, 4); hidden while that is unknown."""
        known = np.empty((0, 3)) if positions is None else positions
        self._path.draw(known[:: max(1, len(known) // _MOST_TRUTH_POINTS)], True)
        self._frame.visible = visible and T_map_truth is not None
        if T_map_truth is not None:
            place(self._frame, T_map_truth)
