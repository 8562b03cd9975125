"""Study of a single frame: colours by number, the ground threshold, one point and its planes, files."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import viser

from app.server.protocol import Snapshot
from app.slam import study
from app.slam.types import F64, StepResult
from app.ui.colours import LABEL_COLOURS
from app.ui.html import css, heading, panel
from app.ui.study_maths import (
    AS_MAP,
    HEADROOM,
    STUDY_BY,
    Curve,
    Picked,
    curve,
    describe,
    nearest_to_ray,
    pick,
    study_legend,
)
from app.ui.study_scene import StudyScene
from app.ui.view import View
from app.ui.widgets import Page, by_user, chart, show, unchanged

_PERIOD_S: Final = 1 / 15
_CURVE_PERIOD_S: Final = 0.25
_THRESHOLD: Final = (255, 107, 107)
_ASK: Final = "Pause and click a point of the scan."


class StudyPanel:
    """Widgets in the caller's container, and what they show in the scene.

    Args:
        taken: whether a click's ray in the map, its origin and direction, was meant for something else.
    """

    def __init__(self, page: Page, taken: Callable[[F64, F64], bool] = lambda origin, direction: False) -> None:
        gui = page.gui
        self._page, self._taken = page, taken
        self._scene = StudyScene(page.scene)
        self._clicked: tuple[F64, F64] | None = None  # the newest click's ray, in the map
        self._picked: Picked | None = None
        self._drawn: tuple[Any, ...] = ()
        self._marked: tuple[Any, ...] = ()
        self._curve_of: tuple[Any, ...] = ()
        self._drawn_at = self._curve_at = -1e9

        self._by = gui.add_dropdown(
            "colour scan by", STUDY_BY, initial_value=AS_MAP, hint="Of the newest frame only. V: the next."
        )
        self._legend = gui.add_html(study_legend(None, AS_MAP))
        self._alone = gui.add_checkbox("only this frame", False, hint="Hide the map.")
        gui.add_html(heading("Distance to the ground plane over range, and σ · range"))
        self._plot = _plot(gui, curve(None, 0.025))
        self._summary = gui.add_html("")
        gui.add_html(heading("A point"))
        self._neighbours = gui.add_number("neighbours", 20, min=4, max=200, step=1, hint="Nearest points of this scan.")
        self._point = gui.add_html(panel("quiet", _ASK))
        gui.add_html(heading("Download this frame with all its points' numbers"))
        self._save = gui.add_button_group("save", ("PLY", "PCD"), hint="In the LiDAR frame.")
        self._save.on_click(by_user(self._download))
        gui.add_command("Next colour mode of the frame under study", hotkey="V").on_trigger(lambda _: self._next())
        page.scene.on_click()(self._click)

    def seen(self, view: View) -> View:
        """The view without what stands in the way of the study."""
        return replace(view, scan=view.scan and self._by.value == AS_MAP, map=view.map and not self._alone.value)

    def tick(self, snapshot: Snapshot, view: View) -> None:
        """Called by the drawing thread, often."""
        now, result, by = self._page.now(), snapshot.result, self._by.value
        look = (result, by, view.point_size)
        due = now - self._drawn_at >= _PERIOD_S or by != self._drawn[1]
        if not unchanged(self._drawn, look) and due:
            self._drawn, self._drawn_at = look, now
            self._scene.draw_cloud(result, by, view.point_size)
            self._legend.content = study_legend(result, by)
        self._tick_point(snapshot, view)
        self._tick_curve(snapshot, now)

    def _tick_point(self, snapshot: Snapshot, view: View) -> None:
        result, sigma, count = snapshot.result, snapshot.params.ground.sigma, int(self._neighbours.value)
        clicked, self._clicked = self._clicked, None
        index = self._picked.index if self._picked is not None else None
        before: StepResult | None = self._marked[0] if self._marked else None
        if result is None or before is None or result.cloud.points is not before.cloud.points:
            index = None  # that point was of another frame
        look = (result, sigma, count, view.point_size)
        if clicked is not None and result is not None and not snapshot.transport.playing:
            T = result.T_map_imu @ result.state.T_imu_lidar
            origin, direction = T[:3, :3].T @ (clicked[0] - T[:3, 3]), T[:3, :3].T @ clicked[1]
            index = nearest_to_ray(result.cloud.points, origin, direction)
        elif unchanged(self._marked, look):
            return
        self._marked = look
        if index is None and self._picked is None:
            return
        self._picked = pick(result, index, sigma, count) if index is not None and result is not None else None
        if result is not None:
            self._scene.draw_picked(result, self._picked, view.point_size)
        known = self._picked is not None and result is not None
        self._point.content = describe(result, self._picked) if known else panel("quiet", _ASK)  # type: ignore[arg-type]

    def _tick_curve(self, snapshot: Snapshot, now: float) -> None:
        """Draw the curve of the newest frame; of what plays only the first."""
        result, sigma = snapshot.result, snapshot.params.ground.sigma
        if unchanged(self._curve_of, (result, sigma)) or now - self._curve_at < _CURVE_PERIOD_S:
            return
        if snapshot.transport.playing and self._curve_of and self._curve_of[0] is not None:
            return
        self._curve_of, self._curve_at = (result, sigma), now
        drawn = curve(result, sigma)
        self._plot.scales = _scales(drawn)
        self._plot.data = (drawn.range, drawn.threshold, drawn.under, drawn.over)
        if result is None:
            self._summary.content = ""
        elif not drawn.points_under + drawn.points_over:
            self._summary.content = panel("note", f"No plane: {result.ground.reason}.")
        else:
            why = "" if result.ground.found else f" The plane was not accepted: {result.ground.reason}."
            colours = (LABEL_COLOURS[1], LABEL_COLOURS[0], _THRESHOLD)
            self._summary.content = panel("curve", drawn.points_under, drawn.points_over, colours, why)

    def _click(self, event: viser.SceneClickEvent) -> None:
        ray = self._page.in_map(event)
        if not self._taken(*ray):
            self._clicked = ray

    def _next(self) -> None:
        show(self._by, STUDY_BY[(STUDY_BY.index(self._by.value) + 1) % len(STUDY_BY)])

    def _download(self, kind: Any, client: viser.ClientHandle) -> None:
        snapshot = self._page.snapshot()
        if snapshot.result is None or snapshot.recording is None:
            client.add_notification("Note", "There is no frame yet; play or step first.", auto_close_seconds=6.0)
            return
        write = {"PLY": study.ply, "PCD": study.pcd}[kind]
        name = f"{snapshot.recording.path.stem}-frame-{snapshot.result.index:06d}.{kind.lower()}"
        client.send_file_download(name, write(snapshot.result), save_immediately=True)


def _scales(drawn: Curve) -> dict[str, Any]:
    """Given explicitly: the plot finds no range itself where some numbers are nan."""
    return {"x": {"time": False}, "y": {"range": (0.0, HEADROOM * float(drawn.threshold[-1]))}}


def _plot(gui: viser.GuiApi, drawn: Curve) -> viser.GuiUplotHandle:
    lines: list[dict[str, Any]] = [{"stroke": css(_THRESHOLD), "width": 1.5}]
    for colour in (css(LABEL_COLOURS[1]), css(LABEL_COLOURS[0])):
        points = {"show": True, "size": 2.5, "width": 0, "fill": colour}
        lines.append({"stroke": colour, "width": 0, "points": points})
    data = (drawn.range, drawn.threshold, drawn.under, drawn.over)
    return chart(gui, data, lines, 200, scales=_scales(drawn))
