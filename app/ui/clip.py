"""The clip box with its handles, sections cut by two clicks, and the profile along the walk."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import viser

from app.export.box import Box
from app.export.section import strides
from app.mapping.kept import Clip, Spot
from app.server.keeping import SetClip
from app.server.protocol import Snapshot
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import F64
from app.ui.camera import OBLIQUE, CameraPanel
from app.ui.clip_maths import FACES, along_line, carried, edges, handle, pulled
from app.ui.geometry import wxyz
from app.ui.html import panel
from app.ui.measure import DISTANCE, MeasurePanel
from app.ui.nodes import add_lines
from app.ui.widgets import ROOT, Changes, Page, View, add_button, as_set, by_user, limited, notify_error, show

_NODE: Final = f"{ROOT}/clip"
_COLOUR: Final = (255, 205, 80)
_HANDLE_PX: Final = 70.0
_FAR_M: Final = 1e5
_MIDDLE: Final = -1
"""Number of the handle in the middle; the other handles are numbered as in `FACES`."""


class ClipPanel:
    """Widgets in the caller's container; the box and its handles in the scene, below the map's node.

    Args:
        measure: takes the clicks that cut a section. around: returns (n, 3) some points of the map.
        ask_where: asks where to save a file of a format.
    """

    def __init__(
        self,
        page: Page,
        measure: MeasurePanel,
        camera: CameraPanel,
        around: Callable[[], F64],
        ask_where: Callable[[viser.ClientHandle, str], None],
    ) -> None:
        gui = page.gui
        self._page, self._measure, self._camera, self._around = page, measure, camera, around
        self._scene_changes = Changes()
        self._shown: Clip | None = None  # what the widgets were last set to
        self._dragged: Box | None = None  # the box as set by a handle, until the session stores it
        self._held: int | None = None  # the browser that holds a handle
        self._lines: viser.LineSegmentsHandle | None = None
        self._handles: dict[int, viser.TransformControlsHandle] = {}
        self._on = gui.add_checkbox("clip box", False, hint="Hide what is outside. Exports can be limited to it.")
        self._fields = gui.add_folder(None, visible=False)
        with self._fields:
            self._middle = limited(
                gui.add_vector3("middle (m)", (0.0,) * 3, min=(-_FAR_M,) * 3, max=(_FAR_M,) * 3, step=0.05)
            )
            self._size = limited(gui.add_vector3("size (m)", (1.0,) * 3, min=(0.05,) * 3, max=(_FAR_M,) * 3, step=0.05))
            self._turn = limited(gui.add_number("turn (°)", 0.0, min=-360.0, max=360.0, step=1.0))
            self._turn.precision = 2  # by default viser takes it from the step, which turns 12.5 into 12
            self._pull = gui.add_checkbox(
                "handles", True, hint="The arrows move the sides; the handle in the middle moves the box."
            )
            add_button(gui, "Look from its front", self.look, viser.Icon.VIEWPORT_NARROW)
            save = viser.Icon.DEVICE_FLOPPY
            add_button(gui, "Save as a section…", lambda client: ask_where(client, "section"), save)
            add_button(gui, "Around the whole map", lambda _: self._send(box=self._whole()), viser.Icon.MAXIMIZE)
        self._slab = limited(
            gui.add_number(
                "slab (m)", 1.0, min=0.05, max=100.0, step=0.05, hint="Thickness of a cut section or of the profile."
            )
        )
        hint = "Click two points: the clip box becomes the slab between them."
        add_button(
            gui, "Cut by two clicks", lambda _: measure.begin(DISTANCE, self._picked), viser.Icon.SLICE, hint=hint
        )
        self._asked = gui.add_html("")
        self._unrolled = gui.add_checkbox(
            "profile", False, hint="The map along the walked path: distance walked to the right, height up."
        )
        self._save_profile = add_button(
            gui, "Save the profile…", lambda client: ask_where(client, "profile"), save, visible=False
        )
        for control in (self._middle, self._size, self._turn):
            control.on_update(as_set(lambda _, __: self._typed()))
        self._on.on_update(by_user(lambda on, _: self._switch(on)))
        self._slab.on_update(as_set(lambda slab, _: self._send(slab=slab)))
        self._unrolled.on_update(by_user(self._unroll))

    def seen(self, current: Snapshot, view: View) -> View:
        """The view with the map clipped, or with a profile in its place."""
        clip = current.clip
        if clip.unrolled:
            return replace(view, clip=clip.hiding, slab=clip.slab, map=False)
        return replace(view, clip=clip.hiding)

    def draw(self, current: Snapshot) -> None:
        """Show the session's box, or the dragged box while a handle is held."""
        clip = current.clip
        if self._held is not None and self._held not in self._page.server.get_clients():
            self._held = self._dragged = None  # a browser that has left reports no release
        if clip != self._shown:
            self._shown, self._dragged = clip, None
            self._show(clip)
        asked = f"Click the {'other' if self._measure.spots else 'first'} end on the map."
        self._asked.content = panel("note", asked) if self._measure.taker == self._picked else ""
        box = None if clip.unrolled else clip.hiding
        if self._scene_changes(box, self._dragged, self._held, self._pull.value):
            self._draw_scene(box)

    # --- what is chosen --------------------------------------------------------------------------
    def _send(self, **changes: Any) -> None:
        self._page.send(SetClip(changes))

    def _switch(self, on: bool) -> None:
        try:
            box = {} if self._page.snapshot().clip.box is not None else {"box": self._whole()}
        except HemislamError:
            show(self._on, False)
            raise
        self._send(on=on, **box)

    def _whole(self) -> Box:
        """The box around the map without a few far points. Raises HemislamError: there is no map yet."""
        points = self._around()
        if not len(points):
            raise HemislamError("There is no map yet to clip; play the recording first.")
        low, high = np.percentile(points, (0.5, 99.5), axis=0)
        return Box.around((low + high) / 2, np.maximum(high - low, 1.0) + 0.1)

    def _typed(self) -> None:
        self._send(box=Box.around(self._middle.value, self._size.value, self._turn.value))

    def _show(self, clip: Clip) -> None:
        show(self._on, clip.on)
        show(self._unrolled, clip.unrolled)
        show(self._slab, clip.slab)
        self._fields.visible, self._save_profile.visible = clip.on, clip.unrolled
        if clip.box is not None:
            show(self._middle, tuple(clip.box.middle.round(3).tolist()))
            show(self._size, tuple(clip.box.size.round(3).tolist()))
            show(self._turn, round(clip.box.turn, 2))

    def look(self, client: viser.ClientHandle) -> None:
        """Look at the box from its front, in orthographic view."""
        if (box := self._page.snapshot().clip.box) is not None:
            self._face(client, box)

    def _face(self, client: viser.ClientHandle, box: Box) -> None:
        self._camera.face(client, box.middle, (box.size[0], box.size[2]), box.axes)

    def _unroll(self, on: bool, client: viser.ClientHandle) -> None:
        """Show the whole profile, or the whole map again."""
        trajectory, points = self._page.snapshot().trajectory, self._around()
        try:
            path = strides(trajectory[:, :2])
        except HemislamError:
            show(self._unrolled, False)
            raise
        if on:
            self._send(unrolled=True, on=False)  # a section's box would hide most of it
            length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
            low, high = np.percentile(points[:, 2], (1, 99)) if len(points) else (0.0, 1.0)
            self._camera.face(client, np.array([length / 2, 0.0, (low + high) / 2]), (length, high - low))
        else:
            self._send(unrolled=False)
            self._camera.look(OBLIQUE, client)

    # --- a section by two clicks -----------------------------------------------------------------
    def _picked(self, spots: tuple[Spot, ...], current: Snapshot) -> None:
        first, second = (lie.moved(current.keyframe_poses[spot.keyframe], spot.at) for spot in spots)
        whole, client = self._whole(), self._measure.client
        box = along_line(first, second, current.clip.slab, whole.low[2], whole.high[2])
        if box is not None:
            self._send(box=box, on=True, unrolled=False)
        if box is not None and client is not None:
            self._face(client, box)
        elif client is not None:
            notify_error(client, "The two points are one above the other; click two that are apart.")

    # --- in the scene ----------------------------------------------------------------------------
    def _draw_scene(self, box: Box | None) -> None:
        scene = self._page.scene
        if box is None or not self._pull.value:
            for gizmo in self._handles.values():
                gizmo.remove()
            self._handles.clear()
            self._held = self._dragged = None  # no browser reports the release of a removed handle
        if box is None:
            if self._lines is not None:
                self._lines.remove()
                self._lines = None
            return
        lines = edges(self._dragged or box)
        if self._lines is None:
            self._lines = add_lines(scene, f"{_NODE}/edges", lines, _COLOUR, 2.0)
        else:
            self._lines.points = lines
        if self._pull.value and self._held is None:
            self._place_handles(box)

    def _place_handles(self, box: Box) -> None:
        for number in (_MIDDLE, *range(len(FACES))):
            R, place = (box.axes, box.middle) if number == _MIDDLE else handle(box, *FACES[number])
            if number in self._handles:
                self._handles[number].wxyz, self._handles[number].position = wxyz(R), place
                continue
            axis = 2 if number == _MIDDLE else FACES[number][0]
            gizmo = self._page.scene.add_transform_controls(
                f"{_NODE}/handle/{number}",
                scale=_HANDLE_PX,
                fixed=True,
                active_axes=tuple((k == axis) != (number == _MIDDLE) for k in range(3)),
                disable_rotations=number != _MIDDLE,
                disable_axes=number == _MIDDLE,
                depth_test=False,
                wxyz=wxyz(R),
                position=place,
            )
            gizmo.on_update(self._noting(number))
            self._handles[number] = gizmo

    def _noting(self, number: int) -> Callable[[Any], Any]:
        """A callback for a handle: a coroutine, since viser calls coroutines in order."""

        async def moved(event: viser.TransformControlsEvent) -> None:
            box = self._page.snapshot().clip.box
            if box is None or event.client is None:
                return
            gizmo = event.target
            place = np.array(gizmo.position)
            if number == _MIDDLE:
                w, x, y, z = np.asarray(gizmo.wxyz, np.float64)
                box = carried(box, lie.matrix(np.array([x, y, z, w])), place)
            else:
                box = pulled(box, *FACES[number], place)
            self._dragged, self._held = box, None if event.phase == "end" else event.client.client_id
            if self._held is None:
                self._send(box=box)

        return moved
