"""Adding a loop by hand: choose two keyframes, an initial guess, and whether to register them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from app.server.protocol import Chunk, Snapshot
from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Add, rows
from app.slam.loops.types import Pair
from app.slam.types import F32, F64
from app.ui.chunks import shown_points
from app.ui.geometry import wxyz
from app.ui.html import panel
from app.ui.loops.edges import nearest
from app.ui.loops.inspector import MOST_POINTS, Overlay
from app.ui.loops.words import NEWER, OLDER
from app.ui.nodes import add_exact_points, clear
from app.ui.widgets import ROOT, Changes, Edit, Page, View, add_button, by_user, limited, show

_REST_S: Final = 0.4
"""The guess is tried after the gizmo has not moved for this long."""
_PICK, _FIRST, _SECOND = "Pick in the scene", "Click a keyframe …", "Click the other one …"
_FROM_M: Final = 12.0
_DOT: Final = (236, 240, 246)
_REACH: Final = 5
"""The points of this many keyframes before and after a keyframe are shown with its own."""
_NODE: Final = f"{ROOT}/add_loop"


def upright(T_map_imu: F64) -> F64:
    """(4, 4) T_map_upright: a frame at the keyframe's position with the map's axes."""
    return lie.transform(np.eye(3), T_map_imu[:3, 3])


def surroundings(chunks: tuple[Chunk, ...], poses: F64, index: int, ceilings: bool) -> F32:
    """(n, 3) points of a keyframe and its neighbours in time, in the keyframe's upright frame."""
    near = [chunk for chunk in chunks if abs(chunk.index - index) <= _REACH and chunk.index < len(poses)]
    share = MOST_POINTS // max(len(near), 1)
    parts = [np.empty((0, 3))]
    for chunk in near:
        T = poses[chunk.index] @ chunk.T_imu_lidar
        points = chunk.points[shown_points(chunk, T, ceilings)][:share]
        parts.append(lie.moved(T, points) - poses[index][:3, 3])
    return np.concatenate(parts).astype(np.float32)


@dataclass(slots=True)
class Nudging:
    """Two clouds; the user moves the newer one by arrows and rings.

    Attributes:
        older, newer: (n, 3) their points, in the upright frames of the keyframes.
        T_map_older, T_map_newer: (4, 4) poses of the keyframes at the start.
        guess: the last pose of the newer cloud; not sent while it is being moved.
    """

    pair: Pair
    older: F32
    newer: F32
    T_map_older: F64
    T_map_newer: F64
    gizmo: viser.TransformControlsHandle
    guess: Edit

    @property
    def T_map(self) -> F64:
        return lie.transform(lie.matrix(np.asarray(self.gizmo.wxyz)[[1, 2, 3, 0]]), np.array(self.gizmo.position))

    @property
    def T_older_newer(self) -> F64:
        """(4, 4) between the keyframes, with the newer one moved like its cloud."""
        return lie.inverse(self.T_map_older) @ self.T_map @ lie.inverse(upright(self.T_map_newer)) @ self.T_map_newer


class AddLoopPanel:
    """Widgets in the caller's container.

    Args:
        propose: takes the edit to try. fly: moves a browser's camera to look at a place (3,) of the map from a
            distance in metres.
    """

    def __init__(
        self, page: Page, propose: Callable[[Add], None], fly: Callable[[viser.ClientHandle, F64, float], None]
    ) -> None:
        gui = page.gui
        self._page, self._propose, self._fly = page, propose, fly
        self._overlay = Overlay(page.scene, f"{_NODE}/clouds")
        self._dots: list[viser.PointCloudHandle] = []  # one node or none
        self._changes = Changes()  # of the dots
        self._picked: list[int] | None = None
        self._nudging: Nudging | None = None
        self._tried = False  # whether the user tried an impossible pair
        gui.add_html(panel("text", "Connect two keyframes that see the same place, even if the search found no loop."))
        self._older = limited(gui.add_number("older keyframe", 0, min=0, step=1))
        self._newer = limited(gui.add_number("newer keyframe", 0, min=0, step=1))
        self._pick = add_button(gui, _PICK, lambda _: self._toggle_picking(), viser.Icon.POINTER)
        self._register = gui.add_checkbox(
            "register", True, hint="Register one submap to the other. Off: use the guess as it is."
        )
        self._nudge = gui.add_checkbox(
            "nudge the guess",
            False,
            hint="First move the newer submap with arrows and rings. Off: the guess is its pose in the graph.",
        )
        self._try = add_button(gui, "Try it", lambda _: self.suggest(), viser.Icon.LINK, color=None)
        self._problem = gui.add_html("")
        self._nudge.on_update(by_user(self._look))

    @property
    def picking(self) -> bool:
        return self._picked is not None

    @property
    def nudging(self) -> bool:
        return self._nudging is not None

    @property
    def pair(self) -> Pair:
        return KeyframeId(0, int(self._older.value)), KeyframeId(0, int(self._newer.value))

    def suggest_pair(self, pair: Pair) -> None:
        show(self._older, pair[0])
        show(self._newer, pair[1])

    def done(self) -> None:
        """Remove the clouds, the gizmo and the dots after a decision, or for another session."""
        show(self._nudge, False)
        self._picked = None

    def suggest(self) -> None:
        self._tried = True
        if self._is_possible(len(self._page.snapshot().keyframe_poses)):
            older, newer = self.pair
            self._propose(Add(older, newer, self._guess(), self._register.value))

    def _is_possible(self, count: int) -> bool:
        """Whether both are among the first `count` keyframes, in order; if not, tells a user who wants to use them."""
        older, newer = self.pair
        good = 0 <= older < newer < count
        self._tried &= not good
        problem = panel("text", f"Choose two of the {count} keyframes, the older one first.")
        self._problem.content = problem if not good and (self._tried or self._nudge.value) else ""
        return good

    def pick(self, origin: F64, direction: F64) -> None:
        """Handle a click while picking; the ray is in the map frame."""
        picked, positions = self._picked, self._page.snapshot().keyframe_poses[:, :3, 3]
        index = nearest(positions[:, None], origin, direction, within=np.radians(3.0))
        if picked is None or index is None or index in picked:
            return
        picked.append(index)
        if len(picked) == 2:
            self.suggest_pair((KeyframeId(0, min(picked)), KeyframeId(0, max(picked))))
            self._picked = None

    def draw_scene(self, snapshot: Snapshot, view: View) -> None:
        """Draw the dots to pick and the two clouds; try the guess once it rests. Called often by the drawing thread."""
        self._draw_picking(snapshot)
        poses, pair, nudging = snapshot.keyframe_poses, self.pair, self._nudging
        wanted = self._is_possible(len(poses)) and self._nudge.value
        if nudging is not None and (not wanted or nudging.pair != pair):
            nudging.gizmo.remove()
            self._overlay.clear()
            self._nudging = nudging = None
        if not wanted:
            return
        if nudging is None:
            nudging = self._nudging = self._begin(snapshot.chunks, poses, view)
        T, now, guess = nudging.T_map, self._page.now(), nudging.guess
        self._overlay.draw(nudging.older, nudging.newer, upright(nudging.T_map_older), T, view.point_size)
        if not np.array_equal(T, guess.value):
            nudging.guess = Edit(T, now)
        elif not guess.sent and now - guess.at >= _REST_S:
            guess.sent = True
            self.suggest()

    def _begin(self, chunks: tuple[Chunk, ...], poses: F64, view: View) -> Nudging:
        older, newer = self.pair
        T = upright(poses[newer])
        gizmo = self._page.scene.add_transform_controls(
            f"{_NODE}/gizmo", scale=1.6, depth_test=False, wxyz=wxyz(T[:3, :3]), position=T[:3, 3]
        )
        there, here = (surroundings(chunks, poses, index, view.ceilings) for index in self.pair)
        nudging = Nudging(self.pair, there, here, poses[older], poses[newer], gizmo, Edit(T, 0.0, sent=True))
        nudging.guess.value = nudging.T_map
        return nudging

    def _guess(self) -> tuple[tuple[float, ...], ...] | None:
        """T_older_newer of the IMU frames according to the gizmo; None: use the pose in the graph."""
        nudging = self._nudging
        return rows(nudging.T_older_newer) if nudging is not None and nudging.pair == self.pair else None

    def _look(self, nudging: bool, client: viser.ClientHandle) -> None:
        poses, newer = self._page.snapshot().keyframe_poses, self.pair[1]
        if nudging and newer < len(poses):
            self._fly(client, poses[newer][:3, 3], _FROM_M)

    def _toggle_picking(self) -> None:
        self._picked = [] if self._picked is None else None

    def _draw_picking(self, snapshot: Snapshot) -> None:
        positions = snapshot.keyframe_poses[:, :3, 3]
        if (picked := self._picked) is not None:
            picked[:] = [index for index in picked if index < len(positions)]  # the session may have gone back
        self._pick.label = _PICK if picked is None else (_SECOND if picked else _FIRST)
        if not self._changes(snapshot.keyframe_poses, -1 if picked is None else len(picked)):
            return
        clear(self._dots)
        if picked is None or not len(positions):
            return
        colours = np.tile(np.array(_DOT, np.uint8), (len(positions), 1))
        colours[picked] = OLDER if len(picked) < 2 else NEWER
        name, exact = f"{_NODE}/keyframes", positions.astype(np.float32)
        self._dots.append(add_exact_points(self._page.scene, name, exact, colours, 0.15))
