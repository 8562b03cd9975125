"""The sensor and its newest scan, with field of view, seed wedge and ground plane."""

from collections.abc import Mapping
from typing import Final

import numpy as np
import viser

from app.slam import lie
from app.slam.params import Params
from app.slam.types import F64, GROUND, SEED, StepResult
from app.ui.colours import LABEL, LABEL_COLOURS, LOOK, Limits, PointSet, colours
from app.ui.geometry import disc, field_of_view, foot, ring_elevations, rotation_to, seed_wedge, wxyz
from app.ui.nodes import NO_COLOURS, NO_LINES, NO_POINTS, add_lines, add_points, add_surface, place
from app.ui.widgets import View

MOST_SCAN_POINTS: Final = 30_000
"""Of a denser scan, every k-th point is drawn. Every browser gets every scan: 2.7 MB/s at 10 Hz."""

_PATCH_RADIUS_M: Final = 2.5
SCAN_POINT_SCALE: Final = 1.3
"""The current scan has larger points than the map so that it stands out."""
_TUNED_POINT_SCALE: Final = 2.0
"""The scale while the ground is tuned."""


def shown_of(count: int) -> slice:
    """Every k-th point of a scan, with the smallest k that leaves at most `MOST_SCAN_POINTS`."""
    return slice(0, count, max(1, -(-count // MOST_SCAN_POINTS)))


class SensorScene:
    """Nodes below `root`: the IMU's axes and, in the LiDAR frame, everything that belongs to one scan."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._imu = scene.add_frame(root, axes_length=0.35, axes_radius=0.012, origin_radius=0.03, visible=False)
        self._lidar = scene.add_frame(f"{root}/lidar", show_axes=False)
        below = f"{root}/lidar"
        self._scan = add_points(scene, f"{below}/scan", NO_POINTS, NO_COLOURS, 0.04, visible=False)
        self._view_lines = add_lines(scene, f"{below}/view", NO_LINES, (120, 140, 170), 1.2)
        seed, ground = LABEL_COLOURS[SEED], LABEL_COLOURS[GROUND]
        triangle = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)
        self._wedge = add_surface(scene, f"{below}/wedge", *triangle, seed, 0.14)
        self._wedge_lines = add_lines(scene, f"{below}/wedge_lines", NO_LINES, seed, 1.5)
        vertices, faces, rim = disc(_PATCH_RADIUS_M)
        self._plane = scene.add_frame(f"{below}/plane", show_axes=False)
        add_surface(scene, f"{below}/plane/disc", vertices, faces, ground, 0.16)
        add_lines(scene, f"{below}/plane/rim", rim, ground, 2.0)
        self.clear()

    def clear(self) -> None:
        self._imu.visible = False
        self._elevations: F64 = np.empty(0)
        self._height = 1.3
        self.ground_z: float | None = None

    def draw(self, result: StepResult, params: Params, view: View, limits: Mapping[str, Limits], start_ns: int) -> None:
        """Draw `result`. If a frame was only relabelled, viser sends only colours, since the rest is unchanged.

        Args:
            limits: ends of the colour maps by mode. start_ns: of the recording.
        """
        self._imu.visible = True
        T_map_lidar = result.T_map_lidar
        cloud, shown = result.cloud, np.arange(len(result.cloud))[shown_of(len(result.cloud))]
        if view.clip is not None:
            shown = shown[view.clip.holds(lie.moved(T_map_lidar, cloud.points[shown]))]
        if len(shown):  # the page cannot draw a cloud without points: it is hidden instead
            points = PointSet.of(cloud, shown, T_map_lidar, (result.stamp_ns - start_ns) * 1e-9)
            by = LABEL if view.tuning or view.colour_by == LOOK else view.colour_by  # labels stand out while tuning
            self._scan.colors = colours(points, by, limits)
            self._scan.points = points.points.astype(np.float16)
        place(self._imu, result.T_map_imu)
        place(self._lidar, result.state.T_imu_lidar)
        self._scan.point_size = view.point_size * (_TUNED_POINT_SCALE if view.tuning else SCAN_POINT_SCALE)
        self._scan.visible = view.scan and len(shown) > 0
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
