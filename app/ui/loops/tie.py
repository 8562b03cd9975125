"""Tying two keyframes by hand: which two, from which guess, and whether they are registered."""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam import lie
from app.slam.loops.types import Add, Pair, rows
from app.slam.types import F64
from app.ui.html import box
from app.ui.loops.edges import nearest
from app.ui.loops.kinds import NEWER, OLDER
from app.ui.loops.overlay import Gizmo, Overlay, Pairing, surroundings, upright
from app.ui.view import View
from app.ui.widgets import by_user, show

_REST_S: Final = 0.4
"""The guess is tried when the hand has rested for so long."""
_PICK, _FIRST, _SECOND = "Pick in the scene", "Click a keyframe …", "Click the other one …"
_FROM_M: Final = 12.0
_DOT: Final = (236, 240, 246)


class TiePanel:
    """Widgets in the caller's container.

    Args:
        propose: takes the command to be tried. fly: takes a browser's camera to a place (3,) of the map, to see it
            from so many metres. now: monotonic seconds.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        propose: Callable[[Add], None],
        snapshot: Callable[[], Snapshot],
        fly: Callable[[viser.ClientHandle, F64, float], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        gui = server.gui
        self._scene, self._root = server.scene, root
        self._propose, self._snapshot, self._fly, self._now = propose, snapshot, fly, now
        self._overlay = Overlay(server.scene, f"{root}/clouds")
        self._gizmo = Gizmo(server.scene, f"{root}/gizmo")
        self._dots: viser.PointCloudHandle | None = None
        self._dotted: tuple[object, ...] = ()
        self._picked: list[int] | None = None
        self._start: tuple[Pair, Pairing, F64, F64] | None = None
        self._moved: tuple[F64, float] | None = None
        gui.add_html(box("Tell the graph that two keyframes see the same place, whatever the finder thinks."))
        self._older = gui.add_number("older keyframe", 0, min=0, step=1)
        self._newer = gui.add_number("newer keyframe", 0, min=0, step=1)
        self._pick = gui.add_button(_PICK, icon=viser.Icon.POINTER, color="gray")
        self._register = gui.add_checkbox(
            "register", True, hint="Lay the submaps on each other; without, the guess counts as it is."
        )
        self._nudge = gui.add_checkbox(
            "nudge the guess",
            False,
            hint="Move the newer submap by arrows and rings first; without, the guess is where the graph has it.",
        )
        self._try = gui.add_button("Try it", icon=viser.Icon.LINK)
        self._problem = gui.add_html("", visible=False)
        self._pick.on_click(by_user(lambda _, __: self._toggle_picking()))
        self._nudge.on_update(by_user(self._look))
        self._try.on_click(by_user(lambda _, __: self.suggest()))

    @property
    def picking(self) -> bool:
        return self._picked is not None

    @property
    def nudging(self) -> bool:
        """Whether its two clouds are in the scene."""
        return self._start is not None

    @property
    def pair(self) -> Pair:
        return int(self._older.value), int(self._newer.value)

    def suggest_pair(self, pair: Pair) -> None:
        show(self._older, pair[0])
        show(self._newer, pair[1])

    def done(self) -> None:
        """After a decision: the clouds and the gizmo go."""
        show(self._nudge, False)

    def suggest(self) -> None:
        """Propose what the widgets say."""
        older, newer = self.pair
        count = len(_poses(self._snapshot()))
        good = 0 <= older < newer < count
        self._problem.visible = not good
        if good:
            self._propose(Add(older, newer, self._guess(), self._register.value))
        else:
            self._problem.content = box(f"Choose two of the {count} keyframes, the older one first.")

    def pick(self, origin: F64, direction: F64) -> None:
        """A click while picking; the ray is in the map."""
        picked, positions = self._picked, _poses(self._snapshot())[:, :3, 3]
        index = nearest(positions[:, None], origin, direction, within=np.radians(3.0))
        if picked is None or index is None or index in picked:
            return
        picked.append(index)
        if len(picked) == 2:
            self.suggest_pair((min(picked), max(picked)))
            self._picked = None

    def draw_scene(self, snapshot: Snapshot, view: View) -> None:
        """Called by the drawing thread, often: dots to pick from, the two clouds, and a guess that has come to rest."""
        self._draw_picking(snapshot)
        poses = _poses(snapshot)
        older, newer = pair = self.pair
        wanted = self._nudge.value and 0 <= older < newer < len(poses)
        if self._start is not None and (not wanted or self._start[0] != pair):
            self._gizmo.hide()
            self._overlay.draw(None, None, view.point_size)
            self._start = self._moved = None
        if not wanted:
            return
        if self._start is None:
            pairing = Pairing(
                surroundings(snapshot.chunks, poses, older, view.ceilings),
                surroundings(snapshot.chunks, poses, newer, view.ceilings),
                upright(poses[older]),
            )
            self._start = (pair, pairing, poses[older], poses[newer])
            self._gizmo.show(upright(poses[newer]))
        T = self._gizmo.pose
        self._overlay.draw(self._start[1], T, view.point_size)
        if T is None:
            return
        now = self._now()
        if self._moved is None or not np.array_equal(T, self._moved[0]):
            resting = self._moved is None  # it was only put there
            self._moved = (T, np.inf if resting else now)
        elif now - self._moved[1] >= _REST_S:
            self._moved = (T, np.inf)
            self.suggest()

    def _guess(self) -> tuple[tuple[float, ...], ...] | None:
        """T_older_newer of the IMU frames as the gizmo has it; None: as the graph has it."""
        start, T = self._start, self._gizmo.pose
        if start is None or T is None or start[0] != self.pair:
            return None
        _, _, T_map_older, T_map_newer = start
        nudged = T @ lie.inverse(upright(T_map_newer)) @ T_map_newer
        return rows(lie.inverse(T_map_older) @ nudged)

    def _look(self, nudging: bool, client: viser.ClientHandle) -> None:
        """To where there is something to nudge."""
        poses, newer = _poses(self._snapshot()), self.pair[1]
        if nudging and newer < len(poses):
            self._fly(client, poses[newer][:3, 3], _FROM_M)

    def _toggle_picking(self) -> None:
        self._picked = [] if self._picked is None else None

    def _draw_picking(self, snapshot: Snapshot) -> None:
        picked = self._picked
        label = _PICK if picked is None else (_SECOND if picked else _FIRST)
        if self._pick.label != label:
            self._pick.label = label
        marked = tuple(picked) if picked is not None else None
        asked = (snapshot.keyframe_poses, marked)
        if len(self._dotted) == 2 and self._dotted[0] is asked[0] and self._dotted[1] == marked:
            return
        self._dotted = asked
        if self._dots is not None:
            self._dots.remove()
            self._dots = None
        positions = _poses(snapshot)[:, :3, 3]
        if marked is None or not len(positions):
            return
        colours = np.tile(np.array(_DOT, np.uint8), (len(positions), 1))
        colours[list(marked)] = OLDER if len(marked) < 2 else NEWER
        self._dots = self._scene.add_point_cloud(
            f"{self._root}/keyframes",
            positions.astype(np.float32),
            colours,
            point_size=0.15,
            point_shape="circle",
            precision="float32",
        )


def _poses(snapshot: Snapshot) -> F64:
    return snapshot.keyframe_poses if snapshot.keyframe_poses is not None else np.empty((0, 4, 4))
