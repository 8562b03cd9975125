"""What a study shows in space: the frame in colours of its own, the point clicked, its neighbours and planes."""

from typing import Any, Final

import numpy as np
import viser

from app.slam.types import F64, StepResult
from app.ui.geometry import disc, rotation_to, wxyz
from app.ui.sensor import shown_of
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
        self._place(result)
        shown = shown_of(len(points))
        self._cloud = self._scene.add_point_cloud(
            f"{self._map}/cloud",
            np.asarray(points)[shown],
            study_colours(result, by)[shown],
            point_size=size * (2.2 if by == RESIDUAL else 1.3),
            point_shape="circle",
            point_shading="flat",
        )

    def draw_picked(self, result: StepResult, picked: Picked | None, size: float) -> None:
        """Mark a point, its neighbours, the plane through them and the map's plane nearby."""
        for mark in self._marks:
            mark.remove()
        self._marks.clear()
        if picked is None:
            return
        self._place(result)
        points, patch = result.cloud.points, picked.patch
        for name, chosen, colour, scale in (
            ("neighbours", patch.indices[1:], _NEIGHBOURS, 2.0),
            ("point", patch.indices[:1], _POINT, 3.0),
        ):
            self._marks.append(
                self._scene.add_point_cloud(
                    f"{self._map}/{name}", points[chosen], colour, point_size=scale * size, point_shape="circle",
                    point_shading="flat",
                )
            )  # fmt: skip
        radius = max(patch.radius, _LEAST_RADIUS_M)
        self._plane("patch", patch.center, patch.normal, radius, _NEIGHBOURS)
        match = picked.match
        if match is not None and match.center is not None and match.normal is not None:
            T_lidar_odom = np.linalg.inv(result.state.T_odom_imu @ result.state.T_imu_lidar)
            R = T_lidar_odom[:3, :3]
            self._plane("map_patch", R @ match.center + T_lidar_odom[:3, 3], R @ match.normal, radius, _MAP)

    def _plane(self, name: str, center: F64, normal: F64, radius: float, colour: tuple[int, int, int]) -> None:
        vertices, faces, rim = disc(radius, 40)
        stem = np.array([[[0, 0, 0], [0, 0, radius]]], dtype=np.float32)
        orientation = wxyz(rotation_to(normal))
        self._marks.append(
            self._scene.add_mesh_simple(
                f"{self._map}/{name}", vertices, faces, color=colour, opacity=0.25, side="double", cast_shadow=False,
                receive_shadow=False, wxyz=orientation, position=center,
            )
        )  # fmt: skip
        self._marks.append(
            self._scene.add_line_segments(
                f"{self._map}/{name}_rim", np.concatenate((rim, stem)), colour, thickness=2.0,
                thickness_units="screen", wxyz=orientation, position=center,
            )
        )  # fmt: skip

    def _place(self, result: StepResult) -> None:
        T = result.T_map_imu @ result.state.T_imu_lidar
        self._lidar.wxyz, self._lidar.position = wxyz(T[:3, :3]), T[:3, 3]
