"""A single frame under study: colours by number, the ground threshold, one point and its planes, files."""

import time
from collections.abc import Callable
from dataclasses import replace
from html import escape
from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam import study
from app.slam.types import F64, StepResult
from app.ui.colours import LABEL_COLOURS
from app.ui.html import box, css, dot, heading
from app.ui.study_colours import StudyBy, study_legend
from app.ui.study_curve import HEADROOM, Curve, curve
from app.ui.study_point import Picked, describe, nearest_to_ray, pick
from app.ui.study_scene import StudyScene
from app.ui.view import View
from app.ui.widgets import by_user, same, show

_PERIOD_S: Final = 1 / 15
_CURVE_PERIOD_S: Final = 0.25
_THRESHOLD: Final = (255, 107, 107)
_ASK: Final = box('<span class="hs-quiet">Pause and click a point of the scan.</span>')


class StudyPanel:
    """Widgets in the caller's container, and what they show in the scene.

    Args:
        root: scene node of the map, whose position below the scene's origin is `offset`.
        snapshot: the newest one. now: monotonic seconds.
        taken: whether a click's ray in the map, its origin and direction, was meant for something else.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        snapshot: Callable[[], Snapshot],
        offset: Callable[[], F64],
        now: Callable[[], float] = time.monotonic,
        taken: Callable[[F64, F64], bool] = lambda origin, direction: False,
    ) -> None:
        gui = server.gui
        self._snapshot, self._offset, self._now, self._taken = snapshot, offset, now, taken
        self._scene = StudyScene(server.scene, root)
        self._clicked: tuple[F64, F64] | None = None  # in the scene: origin and direction of the newest click's ray
        self._picked: Picked | None = None
        self._drawn: tuple[StepResult | None, StudyBy, float] = (None, StudyBy.MAP, 0.0)
        self._marked: tuple[StepResult | None, float, int, float] = (None, 0.0, 0, 0.0)
        self._curve_of: tuple[StepResult | None, float] = (None, 0.0)
        self._drawn_at = self._curve_at = -1e9

        self._by = gui.add_dropdown(
            "colour scan by", tuple(StudyBy), initial_value=StudyBy.MAP, hint="Of the newest frame alone. V: the next."
        )
        self._legend = gui.add_html(study_legend(None, StudyBy.MAP))
        self._alone = gui.add_checkbox("only this frame", False, hint="Hides the map meanwhile.")
        gui.add_html(heading("Distance to the ground plane over range, and σ · range"))
        self._plot = _plot(gui, curve(None, 0.025))
        self._said = gui.add_html("")
        gui.add_html(heading("A point"))
        self._neighbours = gui.add_number("neighbours", 20, min=4, max=200, step=1, hint="Nearest points of this scan.")
        self._point = gui.add_html(_ASK)
        gui.add_html(heading("This frame as a file, with all its points carry"))
        self._save = gui.add_button_group("save", ("PLY", "PCD"), hint="Downloads it, in the LiDAR frame.")
        self._save.on_click(by_user(self._download))
        gui.add_command("Next colouring of the frame under study", hotkey="V").on_trigger(lambda _: self._next())
        server.scene.on_click()(self._click)

    def seen(self, view: View) -> View:
        """The view less what stands in the way of the study."""
        by, alone = self._by.value, self._alone.value
        return replace(view, scan=view.scan and by == StudyBy.MAP, map=view.map and not alone)

    def tick(self, snapshot: Snapshot, view: View) -> None:
        """Called by the drawing thread, often."""
        now, result, by = self._now(), snapshot.result, StudyBy(self._by.value)
        if not same(self._drawn, (result, by, view.point_size), 1) and (
            now - self._drawn_at >= _PERIOD_S or by is not self._drawn[1]
        ):
            self._drawn, self._drawn_at = (result, by, view.point_size), now
            self._scene.draw_cloud(result, by, view.point_size)
            self._legend.content = study_legend(result, by)
        self._tick_point(snapshot, view)
        sigma = snapshot.params.ground.sigma
        if not same(self._curve_of, (result, sigma), 1) and now - self._curve_at >= _CURVE_PERIOD_S:
            if snapshot.transport.playing and self._curve_of[0] is not None:
                return
            self._curve_of, self._curve_at = (result, sigma), now
            self._draw_curve(result, curve(result, sigma))

    def _tick_point(self, snapshot: Snapshot, view: View) -> None:
        result, sigma, count = snapshot.result, snapshot.params.ground.sigma, int(self._neighbours.value)
        clicked, self._clicked = self._clicked, None
        index = self._picked.index if self._picked is not None else None
        before = self._marked[0]
        if result is None or before is None or result.cloud.points is not before.cloud.points:
            index = None  # that point is of another frame
        if clicked is not None and result is not None and not snapshot.transport.playing:
            T = result.T_map_imu @ result.state.T_imu_lidar
            origin, direction = T[:3, :3].T @ (clicked[0] - T[:3, 3]), T[:3, :3].T @ clicked[1]
            index = nearest_to_ray(result.cloud.points, origin, direction)
        elif same(self._marked, (result, sigma, count, view.point_size), 1):
            return
        self._marked = (result, sigma, count, view.point_size)
        if index is None and self._picked is None:
            return
        self._picked = pick(result, index, sigma, count) if index is not None and result is not None else None
        if result is not None:
            self._scene.draw_picked(result, self._picked, view.point_size)
        self._point.content = describe(result, self._picked) if self._picked is not None and result else _ASK

    def _draw_curve(self, result: StepResult | None, drawn: Curve) -> None:
        self._plot.scales = _scales(drawn)
        self._plot.data = (drawn.range, drawn.threshold, drawn.under, drawn.over)
        if result is None:
            self._said.content = ""
        elif not drawn.points_under + drawn.points_over:
            self._said.content = box(f'<span class="hs-note">No plane: {escape(result.ground.reason)}.</span>')
        else:
            why = "" if result.ground.found else f" The plane was not accepted: {result.ground.reason}."
            self._said.content = box(
                f'<div class="hs-keys hs-note">{dot(LABEL_COLOURS[1], f"{drawn.points_under:,} under")}'
                f"{dot(LABEL_COLOURS[0], f'{drawn.points_over:,} over')}{dot(_THRESHOLD, 'σ · range')}</div>"
                f'<span class="hs-note">Across: range, m. Up: distance, cm.{escape(why)}</span>'
            )

    def _click(self, event: viser.SceneClickEvent) -> None:
        ray = np.array(event.ray_origin) - self._offset(), np.array(event.ray_direction)
        if not self._taken(*ray):
            self._clicked = ray

    def _next(self) -> None:
        order = list(StudyBy)
        show(self._by, order[(order.index(StudyBy(self._by.value)) + 1) % len(order)])

    def _download(self, kind: Any, client: viser.ClientHandle) -> None:
        snapshot = self._snapshot()
        if snapshot.result is None or snapshot.recording is None:
            client.add_notification("Note", "There is no frame yet; play or step first.", auto_close_seconds=6.0)
            return
        write = {"PLY": study.ply, "PCD": study.pcd}[kind]
        name = f"{snapshot.recording.path.stem}-frame-{snapshot.result.index:06d}.{kind.lower()}"
        client.send_file_download(name, write(snapshot.result), save_immediately=True)


def _scales(drawn: Curve) -> dict[str, Any]:
    """Given, since the plot takes no range from numbers among which there is a nan."""
    return {"x": {"time": False}, "y": {"range": (0.0, HEADROOM * float(drawn.threshold[-1]))}}


def _plot(gui: viser.GuiApi, data: Curve) -> viser.GuiUplotHandle:
    ground, other = css(LABEL_COLOURS[1]), css(LABEL_COLOURS[0])
    lines: list[Any] = [{"label": "range, m"}, {"label": "σ · range, cm", "stroke": css(_THRESHOLD), "width": 1.5,
                                                "points": {"show": False}}]  # fmt: skip
    for label, colour in (("under, cm", ground), ("over, cm", other)):
        lines.append(
            {"label": label, "stroke": colour, "width": 0, "points": {"show": True, "size": 2.5, "width": 0,
                                                                     "fill": colour}}
        )  # fmt: skip
    axes: Any = tuple({"font": "10px sans-serif", "ticks": {"size": 3}, "gap": 2, "size": size} for size in (22, 38))
    return gui.add_uplot(
        (data.range, data.threshold, data.under, data.over),
        tuple(lines),
        scales=_scales(data),
        axes=axes,
        legend={"show": False},
        height=200,
        padding=(6, 10, 0, 0),
    )
