"""The page of a session: puts the panels together and draws snapshots into them.

Callbacks of the page only enqueue commands for the engine. One thread draws: it waits for snapshots
and sends what differs between the last one drawn and the newest. Everything is drawn on the server's
scene and panels, which viser keeps for every browser, those that connect or reload later included.
"""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import viser

from app.server.folders import Folders
from app.server.fork import Engine, Workspace
from app.server.protocol import Snapshot
from app.server.setup import POINT_BUDGET, Setup
from app.ui.appearance import AppearancePanel
from app.ui.breakpoints import BreakpointPanel
from app.ui.compare import ComparePanel, Sides
from app.ui.doctor import DoctorPanel
from app.ui.files import FilesPanel
from app.ui.header import HELP, HeaderPanel
from app.ui.html import ACCENT, STYLE, heading
from app.ui.keys import KEYS
from app.ui.live import LivePanel
from app.ui.loops.panel import LoopsPanel
from app.ui.notes import NotesPanel
from app.ui.notices import NoticePanel
from app.ui.parameters import ParameterPanel, add_yaml_buttons
from app.ui.readouts import ReadoutPanel
from app.ui.scene import ROOT, Scene
from app.ui.study import StudyPanel
from app.ui.timeline import TimelinePanel
from app.ui.transport import TransportPanel
from app.ui.view import View

log = logging.getLogger(__name__)

_SCENE_PERIOD_S: Final = 1 / 15
_PANEL_PERIOD_S: Final = 1 / 4
_PLAYING_PERIOD_S: Final = 1 / 2
_PLAYING_PLOTS_PERIOD_S: Final = 1.0
"""Laying out and painting panels costs a browser without a graphics card more than the scene does, which then waits."""
_TICK_S: Final = 0.04
"""How long the drawing thread waits for a snapshot before it looks at the page's own controls."""


class Workbench:
    """Builds the page on `server`; `start` begins to draw, `close` ends it.

    Args:
        server: whose page this is. engine: where snapshots come from and commands go; a `Workspace` can be forked.
        folders: where recordings may be opened from. point_budget: of the engine's reader, to be told.
        results: folder below which results are saved.
        now: monotonic seconds.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        engine: Engine | Workspace,
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
        first = engine.snapshot
        self._scene = Scene(server)

        gui.add_html(STYLE + KEYS)
        self._header = HeaderPanel(gui)
        self._transport = TransportPanel(gui, engine.send, lambda: engine.snapshot)
        self._timeline = TimelinePanel(gui, engine.send, lambda: engine.snapshot, now)
        with gui.add_folder("Pause when", expand_by_default=False):
            self._breakpoints = BreakpointPanel(gui, engine.send)
        with gui.add_folder("Notes", expand_by_default=False):
            self._notes = NotesPanel(gui, engine.send)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Tune", viser.Icon.ADJUSTMENTS_HORIZONTAL):
            self._sides = Sides(gui, forks)
            self._parameters = ParameterPanel(gui, first.params, self._sides.send)
            add_yaml_buttons(gui, lambda: self._sides.tuned(engine.snapshot).params, self._sides.send)
        with tabs.add_tab("View", viser.Icon.EYE):
            self._appearance = AppearancePanel(gui)
        with tabs.add_tab("Study", viser.Icon.MICROSCOPE):
            self._study = StudyPanel(
                server,
                ROOT,
                lambda: engine.snapshot,
                lambda: self._scene.offset,
                now,
                taken=lambda origin, direction: self._loops.points_at(origin, direction),
            )
        with tabs.add_tab("Files", viser.Icon.FOLDER):
            self._files = FilesPanel(gui, folders, results, engine.send, lambda: engine.snapshot)
        with tabs.add_tab("Help", viser.Icon.HELP):
            gui.add_html(HELP)

        left = gui.add_panel()
        with left.add_tab("Readouts", viser.Icon.CHART_LINE):
            self._readouts = ReadoutPanel(gui)
        with left.add_tab("Recording", viser.Icon.STETHOSCOPE):
            self._live = LivePanel(gui)
            gui.add_html(heading("The recording doctor"))
            self._doctor = DoctorPanel(gui)
            gui.add_html(heading("Log"))
            self._notices = NoticePanel(server)
        with left.add_tab("Loops", viser.Icon.INFINITY):
            self._loops = LoopsPanel(
                server,
                ROOT,
                engine.send,
                lambda: engine.snapshot,
                lambda: self._scene.offset,
                self._appearance.look_freely,
                now,
            )
        with left.add_tab("A/B", viser.Icon.GIT_COMPARE):
            self._compare = ComparePanel(server, ROOT, forks, self._sides, now)
        left.dock_left()
        left.set_width(300)

        self._drawn: Snapshot | None = None
        self._drawn_view: View | None = None
        self._scene_drawn_at = self._frame_drawn_at = self._panels_drawn_at = self._plots_drawn_at = -1e9
        self._panels_due = self._plots_due = True
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
            except Exception:  # the page must outlive one snapshot that can not be drawn
                log.exception("Snapshot %d could not be drawn", snapshot.revision)
                time.sleep(_PANEL_PERIOD_S)

    def draw(self, current: Snapshot) -> None:
        """Bring the page up to `current`: at once what a user waits for, the rest no faster than one can see.

        A frame waits for the frame before, not for what else was drawn since.
        """
        now, drawn = self._now(), self._drawn
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
        news = drawn is not current
        awaited = drawn is not None and _changed_by_user(drawn, current)
        frame = news and (drawn is None or drawn.result is not current.result)
        due = now - (self._frame_drawn_at if frame else self._scene_drawn_at) >= _SCENE_PERIOD_S
        if (news and (due or awaited)) or view != self._drawn_view:
            if current.result is not None and (drawn is None or drawn.result is None):
                self._parameters.fit_lines(int(current.result.cloud.ring.max(initial=0)) + 1)
            self._scene.draw(drawn, current, view, self._drawn_view)
            self._drawn, self._drawn_view = current, view
            self._scene_drawn_at = now
            self._frame_drawn_at = now if frame else self._frame_drawn_at
            self._panels_due = self._plots_due = True
            if awaited:  # the page is to be quick with this before anything else
                self._server.flush()
                self._panels_drawn_at = self._plots_drawn_at = now
        self._study.tick(current, view)
        self._timeline.draw(current)
        playing = current.transport.playing
        if self._panels_due and now - self._panels_drawn_at >= (_PLAYING_PERIOD_S if playing else _PANEL_PERIOD_S):
            self._panels_due = False
            self._panels_drawn_at = now
            self._readouts.draw(current)
            self._doctor.draw(current)
            self._live.draw(current)
            self._files.draw(current)
            self._appearance.draw(view, self._scene.limits(view.colour_by), self._scene.points, self._budget)
        self._plots_due |= self._readouts.stale
        if self._plots_due and now - self._plots_drawn_at >= (_PLAYING_PLOTS_PERIOD_S if playing else _PANEL_PERIOD_S):
            self._plots_due, self._plots_drawn_at = False, now
            self._readouts.draw_plots(current)


def _changed_by_user(drawn: Snapshot, current: Snapshot) -> bool:
    """Whether parameters are others, or the frame that is drawn was labelled anew by them."""
    before, after = drawn.result, current.result
    relabelled = before is not after and before is not None and after is not None and before.index == after.index
    return relabelled or drawn.params != current.params
