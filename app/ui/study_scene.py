"""What a study shows in space: the frame in colours of its own, the point clicked, its neighbours and planes."""

from typing import Any, Final

import numpy as np
import viser

from app.slam import lie
from app.slam.types import F64, StepResult
from app.ui.geometry import disc, rotation_to
from app.ui.nodes import add_lines, add_points, add_surface, place
from app.ui.sensor import SCAN_POINT_SCALE, shown_of
from app.ui.study_maths import AS_MAP, RESIDUAL, STUDY_MODES, Picked, study_colours
from app.ui.widgets import ROOT

_POINT: Final = (255, 255, 255)
_NEIGHBOURS: Final = (255, 92, 141)
_MAP: Final = (64, 184, 240)
_LEAST_RADIUS_M: Final = 0.1


class StudyScene:
    """Nodes below the map's."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._map = f"{ROOT}/study"
        self._lidar = scene.add_frame(self._map, show_axes=False)
        self._cloud: viser.PointCloudHandle | None = None
        self._marks: list[Any] = []

    def draw_cloud(self, result: StepResult | None, by: str, size: float) -> None:
        """The frame coloured by a number; nothing for `AS_MAP`."""
        points = STUDY_MODES[by].points(result) if result is not None and by != AS_MAP else ()
        if result is None or len(points) == 0:
            if self._cloud is not None:
                self._cloud.remove()
                self._cloud = None
            return
        place(self._lidar, result.T_map_imu @ result.state.T_imu_lidar)
        shown = shown_of(len(points))
        self._cloud = add_points(
            self._scene,
            f"{self._map}/cloud",
            np.asarray(points)[shown],
            study_colours(result, by)[shown],
            size * (2.2 if by == RESIDUAL else SCAN_POINT_SCALE),
        )

    def draw_picked(self, result: StepResult, picked: Picked | None, size: float) -> None:
        """Mark a point, its neighbours, the plane through them and the map's plane nearby."""
        for mark in self._marks:
            mark.remove()
        self._marks.clear()
        if picked is None:
            return
        place(self._lidar, result.T_map_imu @ result.state.T_imu_lidar)
        points, patch = result.cloud.points, picked.patch
        for name, chosen, colour, scale in (
            ("neighbours", patch.indices[1:], _NEIGHBOURS, 2.0),
            ("point", patch.indices[:1], _POINT, 3.0),
        ):
            mark = add_points(self._scene, f"{self._map}/{name}", points[chosen], colour, scale * size)
            self._marks.append(mark)
        radius = max(patch.radius, _LEAST_RADIUS_M)
        self._plane("patch", patch.center, patch.normal, radius, _NEIGHBOURS)
        match = picked.match
        if match is not None and match.center is not None and match.normal is not None:
            T_lidar_odom = lie.inverse(result.state.T_odom_imu @ result.state.T_imu_lidar)
            R = T_lidar_odom[:3, :3]
            self._plane("map_patch", R @ match.center + T_lidar_odom[:3, 3], R @ match.normal, radius, _MAP)

    def _plane(self, name: str, center: F64, normal: F64, radius: float, colour: tuple[int, int, int]) -> None:
        vertices, faces, rim = disc(radius, 40)
        stem = np.array([[[0, 0, 0], [0, 0, radius]]], dtype=np.float32)
        T, node = lie.transform(rotation_to(normal), center), f"{self._map}/{name}"
        self._marks.append(add_surface(self._scene, node, vertices, faces, colour, 0.25, T))
        self._marks.append(add_lines(self._scene, f"{node}_rim", np.concatenate((rim, stem)), colour, 2.0, T))
