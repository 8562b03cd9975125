"""Georeferencing in the page: choose fixes or control points, see residuals, accept or reject them, pick points."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import viser

from app.georeference.align import Alignment
from app.georeference.control import control_table, sound_places
from app.georeference.ledger import in_rows
from app.georeference.survey import Pick, Survey
from app.mapping.kept import Spot
from app.server.folders import Folders
from app.server.protocol import EditLoop, Georeference, RedoLoop, Snapshot, UndoLoop
from app.slam.errors import HemislamError
from app.slam.loops.edits import Override
from app.ui.files import FileList
from app.ui.georeference_maths import centre_of_sphere, lines_of, names_of, numbers_in, rows_of
from app.ui.html import panel
from app.ui.loops.words import describe_edit
from app.ui.measure import POINT, STOP, MeasurePanel
from app.ui.nodes import add_exact_points, add_lines, clear
from app.ui.viser_adapter import Bridge
from app.ui.widgets import ROOT, Changes, Page, add_button, by_user, dialog, limited, show

NOTHING, RECORDED, FILE, CONTROL = "nothing", "fixes of the recording", "fixes of a file", "control points"
_ALIGN, _FACTORS = "align only", "as factors"
_PICK: Final = "Pick it on the map"
_POINT, _SPHERE = "a point", "a sphere's centre"
_FIXES: Final = (".csv", ".txt", ".nmea", ".log", ".ubx")
_MOST_BYTES: Final = 64 << 10
"""Largest size of a table of control points, which is stored in the session file."""
_GOOD, _BAD = (80, 220, 150), (255, 90, 90)
_SIZE_M: Final = 0.12


class GeoreferencePanel:
    """Widgets in the caller's container; fixes and control points in the scene, below the map's node.

    Args:
        folders: where files of fixes may be. measure: takes the clicks that pick control points.
    """

    def __init__(self, page: Page, folders: Folders, measure: MeasurePanel) -> None:
        gui = page.gui
        self._page, self._folders, self._measure = page, folders, measure
        self._changes, self._scene_changes = Changes(), Changes()
        self._shown: Survey | None = None  # what the widgets were last set to
        self._open: Path | None = None  # the recording that was open then
        self._file: Path | None = None
        self._control = ""
        self._nodes: list[Any] = []
        self._by = gui.add_dropdown("georeference by", (NOTHING, RECORDED, FILE, CONTROL))
        self._choose = add_button(gui, "Choose a file of fixes…", self._browse, viser.Icon.FOLDER_OPEN)
        self._table = gui.add_folder(None, visible=False)  # an upload button cannot be hidden by itself
        with self._table:
            load = gui.add_upload_button(
                "Load control points…",
                icon=viser.Icon.UPLOAD,
                color="gray",
                mime_type=".csv,.txt,text/*",
                hint="A CSV table with a header line: name,E,N,H or name,latitude,longitude,height.",
            )
        self._use = gui.add_dropdown("use them", (_ALIGN, _FACTORS), hint="As factors, fixes bend the map.")
        self._crs = gui.add_text("grid", "", hint="EPSG:25832, for example; empty: the local UTM zone.")
        self._lever = gui.add_text(
            "lever arm (m)", "", hint="From the IMU to the antenna, in the IMU's axes: 0.05 -0.1 0.4; empty: estimated."
        )
        self._offset = gui.add_text(
            "clock offset (ms)", "", hint="Delay from the measurement of a fix to its stamp; empty: estimated."
        )
        self._height = gui.add_text(
            "heights above", "", hint="Height reference to name in the files; empty: as in the fixes."
        )
        self._lay = add_button(
            gui, "Georeference the map", lambda _: page.send(Georeference(self.survey())), viser.Icon.WORLD, color=None
        )
        self._name = gui.add_dropdown("control point", ("–",))
        self._fit = gui.add_dropdown("pick", (_POINT, _SPHERE), hint="By a click on the map.")
        self._radius = limited(gui.add_number("sphere's radius (m)", 0.0725, min=0.01, max=1.0, step=0.0005))
        self._pick = add_button(
            gui, _PICK, lambda _: measure.begin(POINT, self._picked), viser.Icon.MAP_PIN, color=None
        )
        self._bridge = Bridge(gui, "georeference", self._act)
        self._html = gui.add_html("")
        self._by.on_update(by_user(lambda _, __: self._show_widgets()))
        self._fit.on_update(by_user(lambda _, __: self._show_widgets()))
        load.on_upload(by_user(lambda file, _: self._uploaded(file.content)))
        self._show_widgets()

    # --- what is chosen --------------------------------------------------------------------------
    def survey(self) -> Survey | None:
        """The survey as set in the widgets. Raises HemislamError: a number is invalid, or no file is chosen yet."""
        if self._by.value == NOTHING:
            return None
        if self._by.value == FILE and self._file is None:
            raise HemislamError("Choose a file of fixes first.")
        if self._by.value == CONTROL and not self._control:
            raise HemislamError("Load a table of control points first.")
        before = self._page.snapshot().earth.survey
        arm = numbers_in(self._lever.value, "lever arm", 3)
        offset = numbers_in(self._offset.value, "clock offset", 1)
        by_points = self._by.value == CONTROL
        return Survey(
            gnss=self._file if self._by.value == FILE else None,
            control=self._control if by_points else "",
            picks=before.picks if before is not None else (),
            crs=self._crs.value.strip(),
            height=self._height.value.strip(),
            lever=(arm[0], arm[1], arm[2]) if arm and not by_points else None,
            offset_s=offset[0] * 1e-3 if offset and not by_points else None,
            factors=self._use.value == _FACTORS and not by_points,
        )

    def _browse(self, client: viser.ClientHandle) -> None:
        def choose(path: Path) -> None:
            self._file = self._folders.inside(path)
            self._choose.label = self._file.name

        with dialog(client, "Fixes") as close:
            nothing = "No logs of fixes (.csv, .nmea, .txt, .log) here."
            FileList(client.gui, self._folders, _FIXES, nothing, choose, close)

    def _uploaded(self, content: bytes) -> None:
        if len(content) > _MOST_BYTES:
            raise HemislamError(f"A table of control points may have at most {_MOST_BYTES >> 10} kB.")
        text = content.decode("utf-8-sig", errors="replace")
        sound_places(control_table(text))  # refused here, and not only when it is used
        self._control = text
        self._show_widgets()

    def _show(self, survey: Survey | None, otherwise: str) -> None:
        """Set the widgets to the session's survey; otherwise: the choice to preselect if there is no survey."""
        self._shown = survey
        if survey is None:
            show(self._by, otherwise)
        else:
            self._file, self._control = survey.gnss, survey.control
            show(self._by, CONTROL if survey.control else FILE if survey.gnss else RECORDED)
            self._choose.label = self._file.name if self._file else "Choose a file of fixes…"
            show(self._use, _FACTORS if survey.factors else _ALIGN)
            show(self._crs, survey.crs)
            show(self._height, survey.height)
            show(self._lever, " ".join(f"{value:g}" for value in survey.lever or ()))
            show(self._offset, "" if survey.offset_s is None else f"{survey.offset_s * 1e3:g}")
        self._show_widgets()

    def _show_widgets(self) -> None:
        by = self._by.value
        names = names_of(self._control) if by == CONTROL else ()
        self._choose.visible, self._table.visible = by == FILE, by == CONTROL
        self._use.visible = self._lever.visible = self._offset.visible = by in (RECORDED, FILE)
        self._crs.visible = self._height.visible = by != NOTHING
        self._lay.label = "Stop georeferencing" if by == NOTHING else "Georeference the map"
        self._lay.visible = by != NOTHING or self._shown is not None
        self._name.visible = self._fit.visible = self._pick.visible = bool(names)
        self._radius.visible = bool(names) and self._fit.value == _SPHERE
        if names and self._name.options != names:
            self._name.options = names
        if not names and self._measure.taker == self._picked:
            self._measure.begin(STOP)  # there is no point to pick any more, for example in another recording

    # --- picking ---------------------------------------------------------------------------------
    def _picked(self, spots: tuple[Spot, ...], current: Snapshot) -> None:
        """Assign the clicked point, or the centre of the sphere there, to the chosen control point."""
        (spot,), poses, name = spots, current.keyframe_poses, self._name.value
        at = spot.at
        try:
            if self._fit.value == _SPHERE:
                at = centre_of_sphere(current.chunks, poses, spot, self._radius.value)
            survey = self.survey()
        except HemislamError as error:
            self._page.notify_error(error)
            return
        if survey is None:
            return
        others = tuple(pick for pick in survey.picks if pick.name != name)
        self._page.send(Georeference(replace(survey, picks=(*others, Pick(name, spot.keyframe, at, spot.frame)))))
        left = [one for one in self._name.options if one not in {pick.name for pick in others} | {name}]
        if left:
            show(self._name, left[0])

    # --- what came of it -------------------------------------------------------------------------
    def draw(self, current: Snapshot) -> None:
        """Show the session's survey and its fit."""
        earth, recording = current.earth, current.recording
        opened = recording.path if recording is not None else None
        if earth.survey != self._shown or opened != self._open:
            new = opened != self._open and recording is not None and recording.fixes
            self._open = opened
            self._show(earth.survey, RECORDED if new else NOTHING)
        picking = self._measure.taker == self._picked
        self._pick.label = f"Click {self._name.value} on the map …" if picking else _PICK
        edits = (current.loops.undo, current.loops.redo)
        if self._changes(earth, *edits, current.session):
            self._html.content = self._bridge.live(_result(current)) if earth.survey is not None else ""
        if self._scene_changes(earth.found, current.session):
            self._draw_scene(earth.found, labelled=earth.survey is not None and bool(earth.survey.control))

    def _draw_scene(self, found: Alignment | None, *, labelled: bool) -> None:
        clear(self._nodes)
        if found is None:
            return
        scene, name = self._page.scene, f"{ROOT}/fixes"
        measured, lines = lines_of(found)
        colours = np.where(found.used[:, None], _GOOD, _BAD).astype(np.uint8)
        self._nodes.append(add_exact_points(scene, f"{name}/points", measured, colours, _SIZE_M))
        for label, which, colour in (("used", found.used, _GOOD), ("rejected", ~found.used, _BAD)):
            if which.any():
                self._nodes.append(add_lines(scene, f"{name}/{label}", lines[which], colour, 1.5))
        if labelled:
            for place, text in zip(measured, found.names, strict=True):
                self._nodes.append(scene.add_label(f"{name}/{text}", text, position=place))

    def _act(self, word: str, _: viser.ClientHandle) -> None:
        """Handle what the table sends: "override fix 12", "drop P1", "undo", "redo"."""
        earth = self._page.snapshot().earth
        match word.split(" ", 1):
            case ["undo"]:
                self._page.send(UndoLoop())
            case ["redo"]:
                self._page.send(RedoLoop())
            case ["drop", name] if earth.survey is not None:
                left = tuple(pick for pick in earth.survey.picks if pick.name != name)
                self._page.send(Georeference(replace(earth.survey, picks=left)))
            case ["override", what] if earth.found is not None:
                used = dict(zip(earth.found.names, earth.found.used.tolist(), strict=True))
                if (name := what.partition(" ")[2]) in used:
                    self._page.send(EditLoop(Override(what, not used[name])))


def _result(current: Snapshot) -> str:
    """The result in words and as a table, with the problem, if any, and what can be undone."""
    earth, loops = current.earth, current.loops
    assert earth.survey is not None
    found, undo = earth.found, [describe_edit(edits[-1]) if edits else "" for edits in (loops.undo, loops.redo)]
    lines, rows, remark = [], [], ""
    if found is not None:
        what = "control points" if earth.survey.control else "fixes"
        lines, rows = in_rows(found, what), rows_of(found, current)
        if len(found.names) > len(rows):
            remark = f"{len(rows)} of {len(found.names):,}; the rejected ones and the largest residuals come first."
    picked = [pick.name for pick in earth.survey.picks] if earth.survey.control else []
    return panel("georeference.result", earth.problem, lines, rows, remark, picked, undo)
