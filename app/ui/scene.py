"""The scene: everything of a snapshot that is drawn in space, z up, in metres.

All nodes hang below one frame. To follow the sensor, that frame is shifted so that the sensor stays
at the origin: the camera of every page is left to its user, who may orbit and zoom while following.
"""

from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import F64
from app.ui.chunks import MapChunks
from app.ui.colours import ColourBy, Limits
from app.ui.paths import Trajectory, Truth
from app.ui.sensor import Sensor
from app.ui.view import View

ROOT: Final = "/map"
_FOLLOWED_M: Final = 1e-3
_FOLLOW_RATE: Final = 0.3
"""Share of the way to the sensor that the view goes per drawing: the walker's sway is not the viewer's."""
_FOLLOW_JUMP_M: Final = 4.0
_GROUND_BEFORE_SEEN_M: Final = -1.2


class Scene:
    """Draws snapshots on a viser server, sending differences only."""

    def __init__(self, server: viser.ViserServer) -> None:
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(cast_shadow=False)  # nothing here throws one, and they cost every frame
        self._server = server
        self._root = scene.add_frame(ROOT, show_axes=False)
        self._grid = scene.add_grid(
            f"{ROOT}/grid",
            infinite_grid=True,
            cell_size=1.0,
            cell_color=(70, 80, 98),
            section_size=5.0,
            section_color=(96, 110, 134),
            section_thickness=1.2,
            fade_distance=60.0,
            shadow_opacity=0.0,
            position=(0.0, 0.0, _GROUND_BEFORE_SEEN_M),
        )
        self._chunks = MapChunks(scene, f"{ROOT}/keyframes")
        self._sensor = Sensor(scene, f"{ROOT}/sensor")
        self._trajectory = Trajectory(scene, f"{ROOT}/trajectory")
        self._truth = Truth(scene, f"{ROOT}/truth")
        # The page compiles the shader of points anew, for a tenth of a second, whenever colours change and
        # no other cloud that is drawn uses it. This one always does: two points that are too small to see.
        scene.add_point_cloud("/shader", np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8), point_size=1e-6)
        server.initial_camera.position = (-4.0, -4.0, 9.0)  # high enough to look into a corridor without its ceiling
        server.initial_camera.look_at = (0.3, 0.2, -0.6)
        server.initial_camera.fov = float(np.radians(60.0))

    @property
    def offset(self) -> F64:
        """(3,) m where the map's origin is in the scene: moved against the sensor while that is followed."""
        return np.array(self._root.position)

    @property
    def points(self) -> int:
        """Map points in the page."""
        return self._chunks.points

    def limits(self, by: ColourBy) -> Limits | None:
        """Ends of a colour map as drawn; None for labels and before there is anything to colour."""
        return self._chunks.limits.get(by)

    def draw(self, previous: Snapshot | None, current: Snapshot, view: View, previous_view: View | None) -> None:
        """Make the scene show `current` seen as `view`, given that it shows `previous` seen as `previous_view`."""
        with self._server.atomic():
            fresh = previous is None or previous.session != current.session
            if fresh:
                self._clear(current)
            before = None if fresh or previous is None else previous
            poses = current.keyframe_poses if current.keyframe_poses is not None else np.empty((0, 4, 4))
            result = current.result
            position = result.T_map_imu[:3, 3] if result is not None else np.zeros(3)
            limits_before = self.limits(view.colour_by)
            self._chunks.draw(current.chunks[: len(poses)], poses, view)
            if current.trajectory is not None:
                self._trajectory.draw(current.trajectory, view.path)
            self._truth.load(current.recording.truth_positions if current.recording else None)
            self._truth.draw(current.T_map_truth, view.path)
            self._grid.visible = view.grid
            if result is None:
                return
            limits = self.limits(view.colour_by)
            unchanged = (
                before is not None
                and before.result is result
                and before.params == current.params
                and view == previous_view
                and limits == limits_before
            )
            if not unchanged:
                drawn = before.result if before is not None else None
                self._sensor.draw(drawn, result, current.params, view, limits)
            self._level_grid()
            if view.follow:
                self._follow(position, jump=before is None or before.result is None)

    def _clear(self, current: Snapshot) -> None:
        recording = current.recording
        self._chunks.clear(
            recording.start_ns if recording else 0,
            recording.duration_s if recording else 1.0,
        )
        self._trajectory.clear()
        self._sensor.clear()

    def _level_grid(self) -> None:
        """Lay the grid on the ground below the sensor; steps under 3 cm are left out, so it does not shiver."""
        z = self._sensor.ground_z
        if z is not None and abs(z - self._grid.position[2]) > 0.03:
            self._grid.position = (0.0, 0.0, z)

    def _follow(self, position: F64, jump: bool) -> None:
        behind = -position - self._root.position
        if jump or float(np.linalg.norm(behind)) > _FOLLOW_JUMP_M:
            self._root.position = -position
        elif float(np.linalg.norm(behind)) > _FOLLOWED_M:  # else it would never arrive, and the page draw for ever
            self._root.position = self._root.position + _FOLLOW_RATE * behind
