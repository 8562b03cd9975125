"""The scene: everything of a snapshot that is drawn in space, z up, in metres.

All nodes are children of one frame. To follow the sensor, this frame is shifted so that the sensor stays at the origin.
Cameras are left alone, so users may orbit and zoom while following.
"""

from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.server.setup import POINT_BUDGET
from app.slam.types import F64
from app.ui.camera import Framing
from app.ui.chunks import MapChunks
from app.ui.colours import chosen_ends
from app.ui.nodes import TrajectoryNode, Truth
from app.ui.profile import ProfileNode
from app.ui.sensor import SensorScene
from app.ui.widgets import ROOT, Changes, View

_FOLLOWED_M: Final = 1e-3
_FOLLOW_RATE: Final = 0.3
"""Share of the distance to the sensor that the view moves per drawing, so that a walker's sway does not shake it."""
_FOLLOW_JUMP_M: Final = 4.0
_GROUND_BEFORE_SEEN_M: Final = -1.2
_GRID_STEP_M: Final = 0.03
_GRID: Final = {False: ((42, 48, 58), (62, 72, 88)), True: ((214, 220, 228), (186, 195, 207))}
"""Colours of the grid's lines and of every fifth line, on a dark and on a light background."""
_EYE_STEP_M: Final = 1.0
_FRAMED_AGAIN: Final = 1.05
"""The view of the whole map is fitted again after the number of keyframes has grown by this factor."""


class Scene:
    """Draws snapshots on a viser server, sending only changes.

    Attributes:
        chunks: the map as drawn. framing: keeps the map in the picture.
    """

    def __init__(self, server: viser.ViserServer, budget: int = POINT_BUDGET) -> None:
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(cast_shadow=False)
        self._server = server
        self._root = scene.add_frame(ROOT, show_axes=False)
        self._grid = scene.add_grid(
            f"{ROOT}/grid",
            infinite_grid=True,
            cell_size=1.0,
            cell_color=_GRID[False][0],
            section_size=5.0,
            section_color=_GRID[False][1],
            section_thickness=1.2,
            fade_distance=60.0,
            shadow_opacity=0.0,
            position=(0.0, 0.0, _GROUND_BEFORE_SEEN_M),
        )
        self._session = -1
        self._seen = False  # whether a frame of this session was drawn
        self._changes = Changes()
        self.chunks = MapChunks(scene, f"{ROOT}/keyframes", budget)
        self._sensor = SensorScene(scene, f"{ROOT}/sensor")
        self._trajectory = TrajectoryNode(scene, f"{ROOT}/trajectory")
        self._truth = Truth(scene, f"{ROOT}/truth")
        self._profile = ProfileNode(scene, self._root, self.chunks.shown)
        self.framing = Framing(server)
        self._framed, self._followed = 0, False

    @property
    def offset(self) -> F64:
        """(3,) m, position of the map's origin in the scene; moves opposite to the sensor while following."""
        return np.array(self._root.position)

    @property
    def eyes(self) -> frozenset[tuple[float, ...]]:
        """(x, y, z) of every camera in the map, rounded; empty while the whole map is drawn anyway."""
        if not self.chunks.partial:
            return frozenset()
        cameras = (client.camera for client in self._server.get_clients().values())
        places = (np.array(camera.position) - self.offset for camera in cameras)
        return frozenset(tuple(np.round(place / _EYE_STEP_M) * _EYE_STEP_M) for place in places)

    def draw(self, current: Snapshot, view: View) -> bool:
        """Update the scene to `current`. Returns False if it must be called again, even without a new snapshot."""
        limits = self.chunks.limits
        with self._server.atomic():
            self._draw_scan(current, view)
        with self._server.atomic():
            poses = current.keyframe_poses
            eyes = np.array(list(self.eyes)).reshape(-1, 3)
            self.chunks.draw(current.chunks[: len(poses)], poses, view, eyes)
            self._profile.draw(current, view)
            self._trajectory.draw(current.trajectory, view.path)
            recording = current.recording
            self._truth.draw(recording.truth_positions if recording else None, current.T_map_truth, view.path)
        return self._look(current, view) and self.chunks.limits is limits and self.chunks.settled

    def _draw_scan(self, current: Snapshot, view: View) -> None:
        """Draw the newest scan, without waiting for the map."""
        recording, result = current.recording, current.result
        start_ns = recording.start_ns if recording else 0
        if current.session != self._session:
            self._session, self._seen, self._framed = current.session, False, 0
            self.chunks.clear(start_ns, recording.end_s if recording else 1.0)
            self._sensor.clear()
        self._grid.visible = view.grid
        self._grid.cell_color, self._grid.section_color = _GRID[view.light]
        if result is None:
            return
        limits = self.chunks.limits
        if self._changes(result, current.params, view, limits):
            ends = chosen_ends(limits, view.colour_by, view.ends)
            self._sensor.draw(result, current.params, view, ends, start_ns)
        z = self._sensor.ground_z
        if z is not None and abs(z - self._grid.position[2]) > _GRID_STEP_M:  # smaller steps would make it jitter
            self._grid.position = (0.0, 0.0, z)
        if view.follow:
            self._follow(result.T_map_imu[:3, 3], jump=not self._seen)
        self._seen = True

    def _look(self, current: Snapshot, view: View) -> bool:
        """Keep the map or the sensor in the picture. Returns False while cameras are on their way."""
        if view.follow != self._followed:
            self._followed = view.follow
            if view.follow:
                self.framing.follow()
        keyframes = len(current.chunks)
        if current.result is not None and not self._framed <= keyframes < _FRAMED_AGAIN * self._framed + 1:
            first, self._framed = not self._framed, keyframes
            self.framing.see(self.chunks.sample(), at_once=first)
        return view.follow or self.framing.draw(self.offset)

    def _follow(self, position: F64, jump: bool) -> None:
        behind = -position - self._root.position
        if jump or float(np.linalg.norm(behind)) > _FOLLOW_JUMP_M:
            self._root.position = -position
        elif float(np.linalg.norm(behind)) > _FOLLOWED_M:  # otherwise drawing would never end
            self._root.position = self._root.position + _FOLLOW_RATE * behind
