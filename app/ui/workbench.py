"""The page of a session: puts the panels together and draws snapshots into them.

Callbacks of the page only enqueue commands for the engine. One thread draws: it waits for snapshots
and sends what differs between the last one drawn and the newest. Everything is drawn on the server's
scene and panels, which viser keeps for every browser, also those that connect or reload later.
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
from app.server.fork import RunningEngine, Workspace
from app.server.protocol import Snapshot
from app.server.setup import POINT_BUDGET, Setup
from app.ui.appearance import AppearancePanel
from app.ui.breakpoints import BreakpointPanel
from app.ui.compare import ComparePanel, Sides
from app.ui.doctor import DoctorPanel
from app.ui.files import FilesPanel
from app.ui.header import HeaderPanel
from app.ui.html import heading, render
from app.ui.live import LivePanel
from app.ui.loops.panel import LoopsPanel
from app.ui.notes import NotesPanel
from app.ui.notices import NoticePanel
from app.ui.parameters import ParameterPanel, add_yaml_buttons
from app.ui.readouts import ReadoutPanel
from app.ui.scene import Scene
from app.ui.study import StudyPanel
from app.ui.timeline import TimelinePanel
from app.ui.transport import TransportPanel
from app.ui.view import View
from app.ui.viser_adapter import prepare_page
from app.ui.widgets import Page

log = logging.getLogger(__name__)

ACCENT: Final = (38, 166, 154)
_SCENE_PERIOD_S: Final = 1 / 15
_PANEL_PERIOD_S: Final = 1 / 4
_TICK_S: Final = 0.04
"""How long the drawing thread waits for a snapshot before it looks at the page's own controls."""


class Workbench:
    """Builds the page on `server`; `start` begins to draw, `close` ends it.

    Args:
        server: whose page this is. engine: where snapshots come from and commands go; a `Workspace` can be forked.
        folders: where recordings may be opened from. point_budget: of the engine's reader, shown to the user.
        results: folder below which results are saved.
        now: monotonic seconds.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        engine: RunningEngine | Workspace,
        folders: Folders,
        point_budget: int = POINT_BUDGET,
        *,
        results: Path = Path("results"),
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        forks = engine if isinstance(engine, Workspace) else Workspace(engine, Setup(), lambda _: engine)
        self._server = server
        self._engine = engine
        self._budget = point_budget
        self._now = now
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=ACCENT)
        gui.set_panel_label("hemislam")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)
        self._scene = Scene(server)
        page = Page(server, engine.send, lambda: engine.snapshot, now, lambda: self._scene.offset)

        prepare_page(gui)
        self._header = HeaderPanel(gui)
        self._transport = TransportPanel(page)
        self._timeline = TimelinePanel(page)
        with gui.add_folder("Pause when", expand_by_default=False):
            self._breakpoints = BreakpointPanel(page)
        with gui.add_folder("Notes", expand_by_default=False):
            self._notes = NotesPanel(page)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Tune", viser.Icon.ADJUSTMENTS_HORIZONTAL):
            self._sides = Sides(gui, forks)
            tuned = replace(page, send=self._sides.send)
            self._parameters = ParameterPanel(tuned, engine.snapshot.params)
            add_yaml_buttons(tuned, lambda: self._sides.tuned(engine.snapshot).params)
        with tabs.add_tab("View", viser.Icon.EYE):
            self._appearance = AppearancePanel(gui)
        with tabs.add_tab("Study", viser.Icon.MICROSCOPE):
            self._study = StudyPanel(page, taken=lambda origin, direction: self._loops.points_at(origin, direction))
        with tabs.add_tab("Files", viser.Icon.FOLDER):
            self._files = FilesPanel(page, folders, results)
        with tabs.add_tab("Help", viser.Icon.HELP):
            gui.add_html(render("help.html"))

        left = gui.add_panel()
        with left.add_tab("Readouts", viser.Icon.CHART_LINE):
            self._readouts = ReadoutPanel(gui)
        with left.add_tab("Recording", viser.Icon.STETHOSCOPE):
            self._live = LivePanel(gui)
            gui.add_html(heading("Recording doctor"))
            self._doctor = DoctorPanel(gui)
            gui.add_html(heading("Log"))
            self._notices = NoticePanel(server)
        with left.add_tab("Loops", viser.Icon.INFINITY):
            self._loops = LoopsPanel(page, self._appearance.look_freely)
        with left.add_tab("A/B", viser.Icon.GIT_COMPARE):
            self._compare = ComparePanel(page, forks, self._sides)
        left.dock_left()
        left.set_width(300)

        self._drawn: Snapshot | None = None
        self._drawn_view: View | None = None
        self._scene_drawn_at = self._panels_drawn_at = -1e9
        self._panels_due = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="workbench", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def close(self) -> None:
        """Stop drawing; the page stays as it is until its server stops."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        revision = -1
        while not self._stop.is_set():
            snapshot = self._engine.wait(revision, _TICK_S)
            revision = snapshot.revision
            try:
                self.draw(snapshot)
            except Exception:  # the page must survive a snapshot that cannot be drawn
                log.exception("Snapshot %d could not be drawn", snapshot.revision)
                time.sleep(_PANEL_PERIOD_S)

    def draw(self, current: Snapshot) -> None:
        """Bring the page up to `current`: at once what a user waits for, the rest at the rate that eyes follow."""
        view = self._study.seen(self._loops.seen(self._appearance.view))
        self._compare.tick(current, view)
        view = self._compare.seen(view)
        self._transport.tick(current)
        self._breakpoints.tick(current)
        self._notes.draw(current)
        self._parameters.tick(self._sides.tuned(current))
        self._notices.draw(current)
        self._header.draw(current)
        self._loops.tick(current, view)
        self._draw_scene(current, view)
        self._study.tick(current, view)
        self._timeline.draw(current)
        self._draw_panels(current, view)

    def _draw_scene(self, current: Snapshot, view: View) -> None:
        now, drawn = self._now(), self._drawn
        awaited = drawn is not None and _changed_by_user(drawn, current)
        due = awaited or now - self._scene_drawn_at >= _SCENE_PERIOD_S
        if (drawn is current or not due) and view == self._drawn_view:
            return
        if current.result is not None and (drawn is None or drawn.result is None):
            self._parameters.fit_lines(int(current.result.cloud.ring.max(initial=0)) + 1)
        self._scene.draw(drawn, current, view, self._drawn_view)
        self._drawn, self._drawn_view, self._scene_drawn_at = current, view, now
        self._panels_due = True
        if awaited:  # the user waits for this before anything else
            self._server.flush()
            self._panels_drawn_at = now

    def _draw_panels(self, current: Snapshot, view: View) -> None:
        now = self._now()
        due = self._panels_due or self._readouts.stale
        if not due or now - self._panels_drawn_at < _PANEL_PERIOD_S:
            return
        self._panels_due, self._panels_drawn_at = False, now
        self._readouts.draw(current)
        self._doctor.draw(current)
        self._live.draw(current)
        self._files.draw(current)
        self._appearance.draw(view, self._scene.limits(view.colour_by), self._scene.points, self._budget)


def _changed_by_user(drawn: Snapshot, current: Snapshot) -> bool:
    """Whether parameters changed, or labels of the frame that is drawn."""
    before, after = drawn.result, current.result
    relabelled = before is not after and before is not None and after is not None and before.index == after.index
    return relabelled or drawn.params != current.params
