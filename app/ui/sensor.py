"""The sensor and what it sees just now: scan, field of view, seed wedge, ground plane."""

from typing import Final

import numpy as np
import viser

from app.slam.params import Params
from app.slam.types import F64, U8, StepResult
from app.ui.colours import LABEL_COLOURS, MAP_OF, TABLES, ColourBy, Limits, label_colours, value_colours
from app.ui.geometry import disc, field_of_view, foot, ring_elevations, rotation_to, seed_wedge, wxyz
from app.ui.thinning import strided
from app.ui.view import View

MOST_SCAN_POINTS: Final = 30_000
"""More points than this of one scan can not be told apart on a page; every k-th is drawn."""

_PATCH_RADIUS_M: Final = 2.5
_SCAN_POINT_SCALE: Final = 1.3
"""The current scan stands out from the map by larger points."""
_NOTHING: Final = np.zeros((1, 2, 3), dtype=np.float32)


class Sensor:
    """Nodes below `root`: the IMU's axes and, in the LiDAR frame, everything that belongs to one scan."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._imu = scene.add_frame(root, axes_length=0.35, axes_radius=0.012, origin_radius=0.03, visible=False)
        self._lidar = scene.add_frame(f"{root}/lidar", show_axes=False)
        below = f"{root}/lidar"
        self._scan = scene.add_point_cloud(
            f"{below}/scan",
            np.zeros((1, 3), np.float32),
            np.zeros((1, 3), np.uint8),
            point_size=0.04,
            point_shape="circle",
            point_shading="flat",
            visible=False,
        )
        self._view_lines = scene.add_line_segments(
            f"{below}/view", _NOTHING, (120, 140, 170), thickness=1.2, thickness_units="screen"
        )
        seed = LABEL_COLOURS[2]
        self._wedge = scene.add_mesh_simple(
            f"{below}/wedge",
            np.zeros((3, 3), np.float32),
            np.array([[0, 1, 2]], np.uint32),
            color=seed,
            opacity=0.14,
            side="double",
            material="toon3",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._wedge_lines = scene.add_line_segments(
            f"{below}/wedge_lines", _NOTHING, seed, thickness=1.5, thickness_units="screen"
        )
        vertices, faces, rim = disc(_PATCH_RADIUS_M)
        ground = LABEL_COLOURS[1]
        self._plane = scene.add_frame(f"{below}/plane", show_axes=False)
        scene.add_mesh_simple(
            f"{below}/plane/disc",
            vertices,
            faces,
            color=ground,
            opacity=0.16,
            side="double",
            material="toon3",
            cast_shadow=False,
            receive_shadow=False,
        )
        scene.add_line_segments(f"{below}/plane/rim", rim, ground, thickness=2.0, thickness_units="screen")
        self._elevations: F64 = np.empty(0)
        self._height = 1.3
        self.ground_z: float | None = None

    def clear(self) -> None:
        """Forget the scan of an ended session."""
        self._imu.visible = False
        self._elevations = np.empty(0)
        self._height = 1.3
        self.ground_z = None

    def draw(
        self, previous: StepResult | None, result: StepResult, params: Params, view: View, limits: Limits | None
    ) -> None:
        """Draw `result`; of a frame that was only labelled anew nothing but colours are sent.

        Args:
            previous: what is drawn now. limits: ends of the colour map in use; None for labels.
        """
        self._imu.visible = True
        T_map_lidar = result.T_map_imu @ result.state.T_imu_lidar
        shown = strided(len(result.cloud), MOST_SCAN_POINTS)
        another = previous is None or previous.index != result.index or previous.stamp_ns != result.stamp_ns
        if len(result.cloud):  # the page can not draw a cloud of no points: it is hidden instead
            self._scan.colors = scan_colours(result, T_map_lidar, shown, view.colour_by, limits)
            if another:
                self._scan.points = result.cloud.points[shown].astype(np.float16)
        if another:
            T = result.T_map_imu
            self._imu.wxyz, self._imu.position = wxyz(T[:3, :3]), T[:3, 3]
            self._lidar.wxyz, self._lidar.position = wxyz(result.state.R_imu_lidar), result.state.p_imu_lidar
        self._scan.point_size = view.point_size * _SCAN_POINT_SCALE
        self._scan.visible = view.scan and len(result.cloud) > 0
        self._draw_plane(result, T_map_lidar, view)
        self._draw_wedge(result, params, view)

    def _draw_plane(self, result: StepResult, T_map_lidar: F64, view: View) -> None:
        ground = result.ground
        self._plane.visible = view.plane and ground.found
        if not ground.found:
            return
        below = foot(ground.centroid, ground.normal, ground.down)
        self._plane.wxyz, self._plane.position = wxyz(rotation_to(ground.normal)), below
        self._height = float(np.linalg.norm(below))
        self.ground_z = float(T_map_lidar[2, :3] @ below + T_map_lidar[2, 3])

    def _draw_wedge(self, result: StepResult, params: Params, view: View) -> None:
        cloud = result.cloud
        if len(cloud) and int(cloud.ring.max()) >= len(self._elevations):
            self._elevations = ring_elevations(cloud.points, cloud.ring)
            seen = self._elevations[np.isfinite(self._elevations)]
            self._view_lines.points = field_of_view(float(seen.min()), float(seen.max()), radius=0.3)
        alpha = float(np.radians(params.ground.alpha))
        reach = min(self._height / max(float(np.cos(alpha)), 0.4), 8.0)
        lines = self._elevations[np.isfinite(self._elevations)][: params.ground.scan_lines]
        wedge = seed_wedge(lines, result.ground.down, alpha, reach) if params.ground.enabled else None
        self._wedge.visible = self._wedge_lines.visible = view.wedge and wedge is not None
        if wedge is not None and view.wedge:
            self._wedge.faces = wedge.faces
            self._wedge.vertices = wedge.vertices
            self._wedge_lines.points = wedge.segments


def scan_colours(result: StepResult, T_map_lidar: F64, shown: slice, by: ColourBy, limits: Limits | None) -> U8:
    """(n, 3) colours of the shown points of a scan."""
    cloud = result.cloud
    if by is ColourBy.LABEL or limits is None:
        return label_colours(cloud.labels[shown])
    if by is ColourBy.HEIGHT:
        values = cloud.points[shown] @ T_map_lidar[2, :3].astype(np.float32) + np.float32(T_map_lidar[2, 3])
    elif by is ColourBy.INTENSITY:
        values = cloud.intensity[shown]
    elif by is ColourBy.RING:
        values = cloud.ring[shown].astype(np.float32)
    else:  # the whole scan is as new as the map's newest points
        values = np.full(len(cloud.labels[shown]), limits.high, dtype=np.float32)
    return value_colours(values, limits, TABLES[MAP_OF[by]])
