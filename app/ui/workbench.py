"""The page of a session: assembles the panels and draws snapshots into them.

Callbacks of the page only enqueue commands for the engine. One thread draws: it waits for snapshots and sends the
differences between the last drawn snapshot and the newest. Everything is drawn on the server's scene and panels, which
viser keeps for every browser, including those that connect or reload later. Every panel has a `draw` that this thread
calls often; a panel sends only changes.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import viser

from app.server.folders import Folders
from app.server.fork import Workspace
from app.server.protocol import Snapshot
from app.server.setup import POINT_BUDGET
from app.slam.params import Params
from app.ui.appearance import AppearancePanel, apply_theme
from app.ui.brush import BrushPanel
from app.ui.calibration import CalibrationPanel
from app.ui.camera import CameraPanel
from app.ui.clip import ClipPanel
from app.ui.colours import DIMMED, Rgb
from app.ui.compare import ComparePanel, Sides
from app.ui.files import FilesPanel, RecentPanel
from app.ui.georeference import GeoreferencePanel
from app.ui.html import render
from app.ui.live import LivePanel
from app.ui.loops.panel import LoopsPanel
from app.ui.map_compare import MapComparePanel
from app.ui.measure import MeasurePanel
from app.ui.nodes import PATH_COLOUR, TRUTH_COLOUR
from app.ui.notes import NotesPanel
from app.ui.parameters import ParameterPanel, add_yaml_buttons
from app.ui.pictures import PicturesPanel
from app.ui.readouts import ReadoutPanel
from app.ui.scale import Looks, ScaleBars
from app.ui.scene import Scene
from app.ui.status import DoctorPanel, HeaderPanel, NoticePanel
from app.ui.study import StudyPanel
from app.ui.timeline import TimelinePanel
from app.ui.transport import SPEEDS, BreakpointPanel, TransportPanel
from app.ui.tune import TunePanel
from app.ui.viser_adapter import Bridge, page_parts
from app.ui.widgets import PANEL_PERIOD_S, SCENE_PERIOD_S, Changes, Page, View

log = logging.getLogger(__name__)

_TUNING_S: Final = 8.0
"""After a change of a ground parameter, the map is dimmed behind the present scan for at least this long."""
_TICK_S: Final = 0.04
"""How long the drawing thread waits for a snapshot before it checks the page's own controls."""


class Workbench:
    """Builds the page on `server`; `start` begins drawing, `close` ends it.

    Args:
        server: serves the page. forks: provides snapshots and takes commands.
        folders: where recordings may be opened from. point_budget: of the engine's reader, shown to the user.
        results: folder below which results are saved.
        now: monotonic seconds. calibrate: begin calibrations automatically where they help.
        resolve: see `CalibrationPanel`.

    Attributes:
        parts: HTML that belongs into viser's page.
    """

    parts: Final = page_parts(SPEEDS)

    def __init__(
        self,
        server: viser.ViserServer,
        forks: Workspace,
        folders: Folders,
        point_budget: int = POINT_BUDGET,
        *,
        results: Path = Path("results"),
        now: Callable[[], float] = time.monotonic,
        calibrate: bool = False,
        resolve: Callable[..., Params] | None = None,
    ) -> None:
        self._server = server
        self._forks = forks
        self._budget = point_budget
        gui = server.gui
        apply_theme(gui, light=False)
        gui.set_panel_label("hemislam")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(360)
        self._scene = Scene(server, point_budget)
        page = Page(server, forks.send, lambda: forks.snapshot, now, lambda: self._scene.offset)

        self._header, scale = HeaderPanel(gui), ScaleBars(page)
        self._transport, self._timeline = TransportPanel(page), TimelinePanel(page)
        Bridge(gui, "camera", self._scene.framing.cover)
        legend = gui.add_html("")
        files = FilesPanel(page, folders, results)
        self._recent = RecentPanel(page, folders, results / "sessions", files.browse)
        Bridge(gui, "legend", lambda word, _: self._appearance.choose_ends(word))
        Bridge(gui, "opened", lambda tab, _: self._opened(tab))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS_HORIZONTAL):
            self._sides = Sides(gui, forks)
            tuned = replace(page, send=self._sides.send)
            self._parameters = ParameterPanel(tuned, forks.snapshot.params)
            add_yaml_buttons(tuned, lambda: self._sides.tuned(forks.snapshot).params)
        with tabs.add_tab("Readouts", viser.Icon.CHART_LINE):
            self._readouts = ReadoutPanel(page)
            with gui.add_folder("Pause when", expand_by_default=False):
                self._breakpoints = BreakpointPanel(page)
        with tabs.add_tab("Loops", viser.Icon.INFINITY):
            self._loops = LoopsPanel(page, self._look_freely)
        with tabs.add_tab("Study", viser.Icon.MICROSCOPE):
            self._study = StudyPanel(page)
            with gui.add_folder("Label by hand", expand_by_default=False):
                self._brush = BrushPanel(page)
        with tabs.add_tab("A/B", viser.Icon.GIT_COMPARE):
            self._compare = ComparePanel(page, forks, self._sides)
        with tabs.add_tab("Auto-tune", viser.Icon.TARGET_ARROW):
            self._tune = TunePanel(page, forks, self._sides, results / "tuning")
        with tabs.add_tab("View", viser.Icon.EYE):
            self._appearance = AppearancePanel(gui, legend, Looks(server))
            self._camera = CameraPanel(page, self._scene.framing, self._look_freely)
            with gui.add_folder("Pictures", expand_by_default=False):
                self._pictures = PicturesPanel(
                    page, results, lambda: (self._appearance.key, self._appearance.view.light)
                )
            with gui.add_folder("Measure"):
                self._measure = MeasurePanel(page)
            with gui.add_folder("Clip and section", expand_by_default=False):
                self._clip = ClipPanel(page, self._measure, self._camera, self._scene.chunks.sample, files.ask_where)
            with gui.add_folder("Distance to another map", expand_by_default=False):
                self._map_compare = MapComparePanel(page, folders, results, self._appearance.colour_by)
        with tabs.add_tab("Recording", viser.Icon.FILE_DATABASE):
            files.add_buttons()
            self._live = LivePanel(page)
            self._doctor = DoctorPanel(page)
            with gui.add_folder("Calibration", expand_by_default=False):
                self._calibration = CalibrationPanel(page, unasked=calibrate, resolve=resolve)
            with gui.add_folder("Georeference", expand_by_default=False):
                self._georeference = GeoreferencePanel(page, folders, self._measure)
            with gui.add_folder("Notes"):
                self._notes = NotesPanel(page)
            self._notices = NoticePanel(server)
        with tabs.add_tab("Help", viser.Icon.HELP):
            gui.add_html(render("help.html"))

        self._panels = (
            self._transport, self._breakpoints, self._notices, self._header, self._recent, self._timeline,
            self._readouts, self._doctor, self._calibration, self._live, files, self._camera,
            self._tune, self._georeference, self._clip, self._map_compare, self._pictures, scale,
        )  # fmt: skip
        server.scene.on_click()(self.clicked)
        self._drawn: Snapshot | None = None
        self._scene_due, self._legend_due = Changes(now, SCENE_PERIOD_S), Changes(now, PANEL_PERIOD_S)
        self._tuned_at = -_TUNING_S
        self._tuned: tuple[int, View] | None = None  # frame and view since then: the map stays dimmed while both last
        self._more = 0
        self._now = now
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="workbench", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop drawing; the page stays unchanged until its server stops."""
        self._stop.set()
        for working in (self._calibration, self._tune, self._map_compare, self._pictures):
            working.close()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        revision = -1
        while not self._stop.is_set():
            snapshot = self._forks.wait(revision, _TICK_S)
            revision = snapshot.revision
            try:
                self.draw(snapshot)
            except Exception:  # the page must survive a snapshot that cannot be drawn
                log.exception("Snapshot %d could not be drawn", snapshot.revision)
                time.sleep(PANEL_PERIOD_S)

    def draw(self, current: Snapshot) -> None:
        """Update the page to `current`: the scene first, since it shows the effect of changed parameters."""
        view = self._study.seen(self._loops.seen(self._appearance.view))
        self._compare.draw(current, view)
        view = self._clip.seen(current, self._map_compare.seen(current, self._compare.seen(view)))
        view = self._draw_scene(current, view)
        self._parameters.follow(current)
        self._parameters.draw(self._sides.tuned(current), view.tuning)
        self._loops.draw(current, view)
        self._study.draw(current, view)
        self._measure.draw(current, view)
        self._brush.draw(current, view)
        self._notes.draw(current, view)
        for one in self._panels:
            one.draw(current)

    def _lines(self, current: Snapshot, view: View) -> list[tuple[Rgb, str]]:
        """Colours and names of the lines in the scene, and of the submaps of an inspected loop."""
        truth = current.recording is not None and current.recording.truth_positions is not None
        path = [(PATH_COLOUR, "path")] + [(TRUTH_COLOUR, "truth")] * truth if view.path else []
        dimmed = [(DIMMED[view.light], "map, while ground sliders move")] if view.tuning and view.map else []
        return [*self._loops.keys(current, view.light), *path, *dimmed]

    def clicked(self, event: viser.SceneClickEvent) -> None:
        """Offer a click in the scene to the panels in turn, until one takes it."""
        for one in (self._measure, self._brush, self._notes, self._loops, self._study):
            if one.clicked(event):
                return

    def _look_freely(self, client: viser.ClientHandle) -> None:
        """Prepare for a browser's camera to be sent elsewhere and to stay there."""
        self._appearance.look_freely(client)
        self._scene.framing.leave(client)

    def _opened(self, tab: str) -> None:
        """When another tab opens, or on Escape (""), end the inspection of the previous tab, except under View."""
        if tab not in ("Loops", "View"):
            self._loops.choose(None)
        if tab != "Parameters":
            self._tuned_at, self._tuned = -_TUNING_S, None

    def _draw_scene(self, current: Snapshot, view: View) -> View:
        """Draw the scene. Returns the view as drawn."""
        drawn = self._drawn
        tuned = drawn is None or drawn.params != current.params
        if drawn is not None and drawn.session == current.session and drawn.params.ground != current.params.ground:
            self._tuned_at = self._now()
        look = current.transport.frame, view
        if self._now() - self._tuned_at < _TUNING_S:
            self._tuned = look
        view = replace(view, tuning=look == self._tuned)
        if self._scene_due(current, view, self._more, self._scene.framing.pictures, self._scene.eyes, at_once=tuned):
            self._more += not self._scene.draw(current, view)
            self._drawn = current
        lines = self._lines(current, view)
        if self._legend_due(current, view, str(lines)):
            chunks = self._scene.chunks
            limits = chunks.limits.get(view.colour_by)
            self._appearance.draw(view, limits, lines, chunks.points, chunks.moving, self._budget)
        return view
