"""Study a single frame: colours by a number, the ground threshold, one point and its planes, downloads."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam import lie, study
from app.slam.params import Params
from app.slam.types import F64, StepResult
from app.ui.colours import LABEL_COLOURS
from app.ui.geometry import disc, rotation_to
from app.ui.html import css, heading, panel
from app.ui.nodes import add_lines, add_points, add_surface, clear, place
from app.ui.sensor import SCAN_POINT_SCALE, shown_of
from app.ui.study_maths import (
    AS_MAP,
    HEADROOM,
    RESIDUAL,
    STUDY_BY,
    STUDY_MODES,
    Curve,
    Picked,
    curve,
    describe,
    pick,
    point_at,
    study_colours,
    study_legend,
)
from app.ui.widgets import (
    PANEL_PERIOD_S,
    ROOT,
    SCENE_PERIOD_S,
    Changes,
    Page,
    View,
    add_command,
    by_user,
    chart,
    choose_next,
    limited,
)

_POINT: Final = (255, 255, 255)
_NEIGHBOURS: Final = (255, 92, 141)
_MAP: Final = (64, 184, 240)
_LEAST_RADIUS_M: Final = 0.1
_THRESHOLD: Final = (255, 107, 107)
_PAUSE: Final = "Drawn for the frame at which you pause."
_ASK: Final = "Pause and click a point of the scan."


class StudyScene:
    """The frame in its own colours, the clicked point, its neighbours and planes; nodes below that of the map."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._map = f"{ROOT}/study"
        self._lidar = scene.add_frame(self._map, show_axes=False)
        self._cloud: list[viser.PointCloudHandle] = []  # one node or none
        self._marks: list[Any] = []

    def draw_cloud(self, result: StepResult | None, by: str, size: float) -> None:
        """Draw the frame coloured by a number; nothing for `AS_MAP`."""
        points = STUDY_MODES[by].points(result) if result is not None and by != AS_MAP else ()
        if result is None or len(points) == 0:
            clear(self._cloud)
            return
        place(self._lidar, result.T_map_lidar)
        shown = shown_of(len(points))
        colours = study_colours(result, by)[shown]
        size *= 2.2 if by == RESIDUAL else SCAN_POINT_SCALE
        self._cloud = [add_points(self._scene, f"{self._map}/cloud", np.asarray(points)[shown], colours, size)]

    def draw_picked(self, result: StepResult | None, picked: Picked | None, size: float) -> None:
        """Mark a point, its neighbours, the plane through them and the map's plane nearby."""
        clear(self._marks)
        if result is None or picked is None:
            return
        place(self._lidar, result.T_map_lidar)
        points, patch = result.cloud.points, picked.patch
        for name, chosen, colour, scale in (
            ("neighbours", patch.indices[1:], _NEIGHBOURS, 2.0),
            ("point", patch.indices[:1], _POINT, 3.0),
        ):
            mark = add_points(self._scene, f"{self._map}/{name}", points[chosen], colour, scale * size)
            self._marks.append(mark)
        radius = max(patch.radius, _LEAST_RADIUS_M)
        self._plane("patch", patch.center, patch.normal, radius, _NEIGHBOURS)
        matches, i = result.registration.matches, picked.match
        if matches is not None and i >= 0 and matches.normals[i].any():
            T = lie.inverse(result.state.T_odom_lidar)
            center, normal = lie.moved(T, matches.centers[i]), T[:3, :3] @ matches.normals[i]
            self._plane("map_patch", center, normal, radius, _MAP)

    def _plane(self, name: str, center: F64, normal: F64, radius: float, colour: tuple[int, int, int]) -> None:
        vertices, faces, rim = disc(radius, 40)
        stem = np.array([[[0, 0, 0], [0, 0, radius]]], dtype=np.float32)
        T, node = lie.transform(rotation_to(normal), center), f"{self._map}/{name}"
        self._marks.append(add_surface(self._scene, node, vertices, faces, colour, 0.25, T))
        self._marks.append(add_lines(self._scene, f"{node}_rim", np.concatenate((rim, stem)), colour, 2.0, T))


class StudyPanel:
    """Widgets in the caller's container, and the nodes that they show in the scene."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._scene = StudyScene(page.scene)
        self._click: tuple[F64, F64] | None = None  # the newest click's ray, in the map
        self._picked: Picked | None = None
        self._of: StepResult | None = None  # the frame of the picked point
        self._scene_changes = Changes(page.now, SCENE_PERIOD_S)
        self._point_changes = Changes()
        self._curve_changes = Changes(page.now, PANEL_PERIOD_S)

        self._by = gui.add_dropdown(
            "colour scan by", STUDY_BY, initial_value=AS_MAP, hint="Colours of the newest frame only. V: next mode."
        )
        self._legend = gui.add_html(study_legend(None, AS_MAP))
        self._alone = gui.add_checkbox("only this frame", False, hint="Hide the map.")
        gui.add_html(heading("Distance to the ground plane over range, and σ · range"))
        self._plot = _plot(gui)
        self._summary = gui.add_html("")
        self._draw_curve(None, Params().ground.sigma)
        gui.add_html(heading("A point"))
        self._neighbours = limited(
            gui.add_number("neighbours", 20, min=4, max=200, step=1, hint="Nearest points of this scan.")
        )
        self._point = gui.add_html(panel("quiet", _ASK))
        gui.add_html(heading("Download this frame with the values of each point"))
        self._save = gui.add_button_group("save", ("PLY", "PCD"), hint="In the LiDAR frame.")
        self._save.on_click(by_user(self._download))
        add_command(gui, "Next colour mode of the frame under study", lambda _: choose_next(self._by), hotkey="V")

    def seen(self, view: View) -> View:
        """The view without anything that would hide the studied frame."""
        return replace(view, scan=view.scan and self._by.value == AS_MAP, map=view.map and not self._alone.value)

    def draw(self, snapshot: Snapshot, view: View) -> None:
        result, by = snapshot.result, self._by.value
        if self._scene_changes(result, by, view.point_size):
            self._scene.draw_cloud(result, by, view.point_size)
            self._legend.content = study_legend(result, by)
        self._draw_point(snapshot, view)
        # The page rebuilds this plot for every new scale; at ten a second, it would never show one.
        if not snapshot.transport.playing and self._curve_changes(result, snapshot.params.ground.sigma):
            self._draw_curve(result, snapshot.params.ground.sigma)

    def _draw_point(self, snapshot: Snapshot, view: View) -> None:
        result, sigma, count = snapshot.result, snapshot.params.ground.sigma, int(self._neighbours.value)
        clicked, self._click = self._click, None
        before, self._of = self._of, result
        index = self._picked.index if self._picked is not None else None
        frames = [one and (one.stamp_ns, len(one.cloud)) for one in (before, result)]
        if frames[0] != frames[1]:
            index = None  # the point belongs to another frame
        if clicked is not None and result is not None and not snapshot.transport.playing:
            index = point_at(result, clicked)
        if not self._point_changes(result if index is not None else None, index, sigma, count, view.point_size):
            return
        if result is None or index is None:
            self._picked, text = None, panel("quiet", _ASK)
        else:
            self._picked = pick(result, index, sigma, count)
            text = describe(result, self._picked)
        self._point.content = text
        self._scene.draw_picked(result, self._picked, view.point_size)

    def _draw_curve(self, result: StepResult | None, sigma: float) -> None:
        drawn = curve(result, sigma)
        self._plot.scales = _scales(drawn)
        self._plot.data = (drawn.range, drawn.threshold, drawn.under, drawn.over)
        if result is None:
            self._summary.content = panel("quiet", _PAUSE)
        elif not drawn.points_under + drawn.points_over:
            self._summary.content = panel("note", f"No plane: {result.ground.reason}.")
        else:
            why = "" if result.ground.found else f" The plane was not accepted: {result.ground.reason}."
            colours = (LABEL_COLOURS[1], LABEL_COLOURS[0], _THRESHOLD)
            self._summary.content = panel("curve", drawn.points_under, drawn.points_over, colours, why)

    def clicked(self, event: viser.SceneClickEvent) -> bool:
        """Take any click in the scene; `draw` finds the clicked point of the frame."""
        self._click = self._page.in_map(event)
        return True

    def _download(self, kind: Any, client: viser.ClientHandle) -> None:
        snapshot = self._page.snapshot()
        if snapshot.result is None or snapshot.recording is None:
            client.add_notification("Note", "There is no frame yet; play or step first.", auto_close_seconds=6.0)
            return
        write = {"PLY": study.ply, "PCD": study.pcd}[kind]
        name = f"{snapshot.recording.path.stem}-frame-{snapshot.result.index:06d}.{kind.lower()}"
        client.send_file_download(name, write(snapshot.result), save_immediately=True)


def _scales(drawn: Curve) -> dict[str, Any]:
    """The scale, given explicitly: the plot cannot find a range itself if some numbers are NaN."""
    return {"x": {"time": False}, "y": {"range": (0.0, HEADROOM * float(drawn.threshold[-1]))}}


def _plot(gui: viser.GuiApi) -> viser.GuiUplotHandle:
    lines: list[dict[str, Any]] = [{"stroke": css(_THRESHOLD), "width": 1.5}]
    for colour in (css(LABEL_COLOURS[1]), css(LABEL_COLOURS[0])):
        points = {"show": True, "size": 2.5, "width": 0, "fill": colour}
        lines.append({"stroke": colour, "width": 0, "points": points})
    return chart(gui, lines, 200)
