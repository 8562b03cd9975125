"""What a comparison shows in space: where B walked and stands, and A's scan by who calls it ground."""

from typing import Final

import numpy as np
import viser

from app.slam.types import F64, U8, StepResult
from app.ui.compare_maths import B_COLOUR, GROUND_COLOURS
from app.ui.geometry import wxyz
from app.ui.paths import Trajectory
from app.ui.sensor import MOST_SCAN_POINTS
from app.ui.thinning import strided

_SCALE: Final = 1.3
"""As the current scan is drawn."""


class CompareScene:
    """Nodes below the scene node `root`, which is the map's."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._path = Trajectory(scene, f"{root}/compare_path", B_COLOUR)
        self._marker = scene.add_icosphere(
            f"{root}/compare_sensor", radius=0.07, color=B_COLOUR, cast_shadow=False, receive_shadow=False,
            visible=False,
        )  # fmt: skip
        self._lidar = scene.add_frame(f"{root}/compare_lidar", show_axes=False, visible=False)
        self._cloud = scene.add_point_cloud(
            f"{root}/compare_lidar/scan",
            np.zeros((1, 3), np.float32),
            np.zeros((1, 3), np.uint8),
            point_size=0.04,
            point_shape="circle",
            point_shading="flat",
        )

    def draw_b(self, positions: F64 | None, at: F64 | None, visible: bool) -> None:
        """B's walk, (n, 3) positions, and where its sensor is, (3,); None takes them away."""
        self._path.draw(positions if positions is not None else np.empty((0, 3)), visible)
        self._marker.visible = visible and at is not None
        if at is not None:
            self._marker.position = at

    def draw_ground(self, result: StepResult | None, ground: U8, size: float) -> None:
        """A's frame, its points coloured by (n,) `Ground`; None hides it."""
        self._lidar.visible = result is not None
        if result is None:
            return
        T = result.T_map_imu @ result.state.T_imu_lidar
        self._lidar.wxyz, self._lidar.position = wxyz(T[:3, :3]), T[:3, 3]
        shown = strided(len(result.cloud), MOST_SCAN_POINTS)
        self._cloud.points = result.cloud.points[shown].astype(np.float16)
        self._cloud.colors = GROUND_COLOURS[ground[shown]]
        self._cloud.point_size = size * _SCALE
