"""Scene nodes as this page draws them: points, lines and translucent surfaces, placed by a pose."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser

from app.slam.types import F32, F64, U8
from app.ui.colours import Rgb
from app.ui.geometry import wxyz

NO_POINTS: Final = np.zeros((1, 3), np.float32)
NO_COLOURS: Final = np.zeros((1, 3), np.uint8)
NO_LINES: Final = np.zeros((1, 2, 3), np.float32)
"""What a node is made with before there is anything to draw: the page cannot draw a node without points."""


def _posed(T: F64 | None) -> dict[str, Any]:
    return {} if T is None else {"wxyz": wxyz(T[:3, :3]), "position": T[:3, 3]}


def place(node: viser.SceneNodeHandle, T: F64) -> None:
    """Move a node to a pose (3 or 4, 4) in its parent's frame."""
    node.wxyz, node.position = wxyz(T[:3, :3]), T[:3, 3]


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
