"""The brush marks points of the present frame as ground or not; `ground-f1` then compares labels with these marks."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser

from app.mapping.painted import SUFFIX, UNMARKED, Stroke, marks, read_json, strokes_of, to_json
from app.server.keeping import Paint, UndoPaint
from app.server.protocol import Seek, Snapshot
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.types import GROUND, NON_GROUND, U8, StepResult
from app.ui.colours import LABEL_COLOURS
from app.ui.html import panel
from app.ui.nodes import add_points, clear, place
from app.ui.sensor import SCAN_POINT_SCALE
from app.ui.study_maths import point_at
from app.ui.viser_adapter import Bridge
from app.ui.widgets import ROOT, Changes, Page, View, add_button, by_user

_OFF: Final = "off"
_MARKS: Final = {"ground": GROUND, "not ground": NON_GROUND, "erase": UNMARKED}
_COLOURS: Final = np.array([(255, 92, 141), LABEL_COLOURS[GROUND]], np.uint8)
"""Colours of marks: not ground in pink, ground in teal."""
_SCALE: Final = 2.0
"""Marked points are drawn larger than the other points of the scan."""


class BrushPanel:
    """Widgets in the caller's container, and the marked points of the present frame in the scene."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._changes = Changes()
        self._mark: int | None = None
        self._nodes: list[viser.SceneNodeHandle] = []
        self._why = gui.add_html("")
        brush = gui.add_button_group(
            "brush", (*_MARKS, _OFF), hint="Pause, then click points of the scan; Shift and drag marks a rectangle."
        )
        self._radius = gui.add_slider("radius (m)", 0.05, 3.0, 0.05, 0.4)
        hint = "Unmarked points of this frame get the engine's labels as marks; then correct these."
        self._rest = add_button(gui, "Mark the rest as labelled", lambda _: self._mark_rest(), hint=hint)
        self._undo = add_button(
            gui, "Undo mark", lambda _: page.send(UndoPaint()), viser.Icon.ARROW_BACK_UP, visible=False
        )
        self._bridge = Bridge(gui, "labelled", self._go)
        self._list = gui.add_html("")
        self._save = add_button(gui, "Download labels", self._download, viser.Icon.DOWNLOAD, visible=False)
        self._load = gui.add_upload_button("Load labels", icon=viser.Icon.UPLOAD, color="gray", mime_type=".json")
        brush.on_click(by_user(lambda name, _: self.choose(name)))
        self._load.on_upload(by_user(self._read))
        page.scene.on_rect_select(modifier="shift")(self._drag)

    @property
    def painting(self) -> bool:
        """Whether the brush takes clicks in the scene."""
        return self._mark is not None

    def choose(self, name: str) -> None:
        self._mark = _MARKS.get(name)

    def draw(self, snapshot: Snapshot, view: View) -> None:
        result, playing = snapshot.result, snapshot.transport.playing
        if not self._changes(snapshot.painted, result, self._mark, view.point_size, playing):
            return
        found = marks(snapshot.painted)
        self._undo.visible = bool(snapshot.painted)
        self._rest.visible, self._rest.disabled, self._radius.visible = self.painting, playing, self.painting
        self._save.visible = bool(found)
        self._why.content = panel("quiet", self._words(snapshot, bool(found)))
        start_ns, rows = snapshot.recording.start_ns if snapshot.recording else None, []
        for stamp, labels in found.items():
            when = f"{(stamp - start_ns) * 1e-9:.1f} s" if start_ns is not None else ""
            rows.append((stamp, when, *(int(np.count_nonzero(labels == mark)) for mark in (GROUND, NON_GROUND))))
        self._list.content = self._bridge.live(panel("labelled", rows)) if rows else ""
        self._draw_scene(result, found.get(result.stamp_ns) if result is not None else None, view.point_size)

    def _words(self, snapshot: Snapshot, any_marks: bool) -> str:
        if self.painting:
            click = "Pause, then click" if snapshot.transport.playing else "Click"
            return f"{click} points of the scan, or hold Shift and drag a rectangle. Marks belong to this frame only."
        if any_marks:
            return "Auto-tune uses these marks for Ground F1."
        return "Mark ground in a few frames, and Auto-tune finds the parameters that label them best."

    def _draw_scene(self, result: StepResult | None, found: U8 | None, size: float) -> None:
        clear(self._nodes)
        if result is None or found is None or len(found) != len(result.cloud):
            return
        shown = np.flatnonzero(found != UNMARKED)
        points, colours = result.cloud.points[shown], _COLOURS[found[shown]]
        node = add_points(self._page.scene, f"{ROOT}/painted", points, colours, _SCALE * SCAN_POINT_SCALE * size)
        place(node, result.T_map_lidar)
        self._nodes.append(node)

    # --- what is marked --------------------------------------------------------------------------
    def _frame(self) -> StepResult | None:
        """The present frame; None during playback, or while the brush is off."""
        snapshot = self._page.snapshot()
        return None if snapshot.transport.playing or not self.painting else snapshot.result

    def clicked(self, event: viser.SceneClickEvent) -> bool:
        """Handle a click in the scene if the brush is on. Returns whether it did."""
        if (result := self._frame()) is None:
            return self.painting
        points, index = result.cloud.points, point_at(result, self._page.in_map(event))
        if index is not None:
            self._paint(result, np.linalg.norm(points - points[index], axis=1) <= self._radius.value)
        return True

    def _drag(self, event: viser.SceneRectSelectEvent) -> None:
        if (result := self._frame()) is not None:
            seen = self._page.in_picture(event.client, lie.moved(result.T_map_lidar, result.cloud.points))
            low, high = np.array(event.screen_min), np.array(event.screen_max)
            self._paint(result, np.asarray(((seen >= low) & (seen <= high)).all(axis=1)))

    def _paint(self, result: StepResult, touched: npt.NDArray[np.bool_]) -> None:
        if self._mark is not None and touched.any():
            self._page.send(Paint(Stroke.of(result.stamp_ns, touched, self._mark)))

    def _mark_rest(self) -> None:
        if (result := self._frame()) is None:
            return
        found = marks(self._page.snapshot().painted).get(result.stamp_ns)
        free = np.ones(len(result.cloud), np.bool_) if found is None else found == UNMARKED
        rest = np.where(free, np.where(result.cloud.labels != NON_GROUND, GROUND, NON_GROUND), UNMARKED)
        self._send_joined(strokes_of({result.stamp_ns: rest}))

    def _send_joined(self, strokes: tuple[Stroke, ...]) -> None:
        for number, stroke in enumerate(strokes):
            self._page.send(Paint(replace(stroke, joined=number > 0)))

    # --- the frames that have marks --------------------------------------------------------------
    def _go(self, word: str, _: viser.ClientHandle) -> None:
        """Handle what the list sends: "frame 1700000000000000000", with the frame's stamp."""
        frames = np.flatnonzero(self._page.snapshot().known_ns == int(word.removeprefix("frame ")))
        if not len(frames):
            raise HemislamError("This frame is not in the trajectory yet; play up to its time.")
        self._page.send(Seek(int(frames[0])))

    def _download(self, client: viser.ClientHandle) -> None:
        snapshot = self._page.snapshot()
        name = f"{snapshot.recording.path.stem if snapshot.recording else 'frames'}{SUFFIX}"
        client.send_file_download(name, to_json(snapshot.painted).encode(), save_immediately=True)

    def _read(self, file: Any, _: viser.ClientHandle) -> None:
        self._send_joined(read_json(file.content.decode("utf-8", errors="replace"), Path(file.name).name))
