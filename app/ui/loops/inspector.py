"""Everything about one loop: its numbers, its Scan Contexts, its residuals, and both submaps superimposed."""

from collections.abc import Callable
from typing import Final

import numpy as np
import viser

from app.export.ceilings import below_ceiling
from app.server.protocol import Snapshot
from app.slam import lie
from app.slam.loops.scan_context import YAWS
from app.slam.loops.types import LoopDetail, LoopEdge, Pair
from app.slam.sections import LoopsParams
from app.slam.types import F32, F64, NON_GROUND, U8
from app.ui.colours import TABLES
from app.ui.html import heading, panel
from app.ui.loops.words import NEWER, OLDER, evidence
from app.ui.nodes import add_exact_points, clear, place
from app.ui.widgets import ROOT, Changes, Page, View, by_user, chart, show

FLY, SEEK, CLOSE = "fly there", "frame", "close"
UNSEEN: Final = (104, 108, 116)
"""Grey for unseen cells, which do not count in the comparison."""
_DISC: Final = 300
_GAP: Final = 20
_BARS: Final = 30
MOST_POINTS: Final = 30_000
_LEAST_POINT_M: Final = 0.035
"""Submaps have fewer points than the map."""
_NO_CONTEXTS: Final = np.zeros((1, 1, 4), np.uint8)


def on_the_way(T_from: F64, T_to: F64, share: float) -> F64:
    """(4, 4) interpolated between two poses: position on a straight line, rotation about one axis. share: 0 to 1."""
    turn = lie.log(T_from[:3, :3].T @ T_to[:3, :3])
    return lie.transform(T_from[:3, :3] @ lie.exp(share * turn), (1 - share) * T_from[:3, 3] + share * T_to[:3, 3])


def without_ceiling(points: F32) -> F32:
    """(n, 3) points of a submap without the ceiling; z is up, and the keyframe is at the origin."""
    return points[below_ceiling(points, np.full(len(points), NON_GROUND, np.uint8), np.array([0.0, 0.0, 1.0]))]


class Overlay:
    """Two superimposed clouds, nodes below `root`. Their points are sent once; moving one of them sends only a pose."""

    def __init__(self, scene: viser.SceneApi, root: str) -> None:
        self._scene, self._root = scene, root
        self._nodes: list[viser.PointCloudHandle] = []
        self._changes = Changes()

    @property
    def shown(self) -> bool:
        return bool(self._nodes)

    def clear(self) -> None:
        clear(self._nodes)
        self._changes()

    def draw(self, older: F32, newer: F32, T_map_older: F64, T_map_newer: F64, point_size: float) -> None:
        """Show (n, 3) points of both, each in its own frame, which is placed by a (4, 4) pose."""
        both = ("older", older, OLDER, T_map_older), ("newer", newer, NEWER, T_map_newer)
        clouds = [cloud for cloud in both if len(cloud[1])]  # the page cannot draw a cloud without points
        if self._changes(older, newer):
            clear(self._nodes)
            for name, points, colour, _ in clouds:
                node, some = f"{self._root}/{name}", points[:MOST_POINTS]
                self._nodes.append(add_exact_points(self._scene, node, some, colour, point_size))
        for cloud, (*_, T) in zip(self._nodes, clouds, strict=True):
            place(cloud, T)
            cloud.point_size = point_size


class Inspector:
    """Widgets in the caller's container, and clouds below the scene node of the map.

    Args:
        act: called with `FLY`, `SEEK` or `CLOSE` and the browser.
    """

    def __init__(self, page: Page, act: Callable[[str, viser.ClientHandle], None]) -> None:
        gui = page.gui
        self._overlay = Overlay(page.scene, f"{ROOT}/submaps")
        self._clouds: tuple[LoopDetail, bool, F32, F32] | None = None
        self._changes = Changes()
        self._alone_before: bool | None = None  # the user's choice, while the map replaces the submaps
        self._evidence = gui.add_html("")
        self._go = gui.add_button_group(
            "go", (FLY, SEEK, CLOSE), hint="Fly to the loop, go to the frame of its verdict, or close it."
        )
        self._go.on_click(by_user(act))
        self._waiting = gui.add_html(panel("quiet", "Waiting for the submaps …"))
        hint = "Left: the submaps as the graph placed them. Right: as registered."
        self._share = gui.add_slider("graph to fit", 0.0, 1.0, 0.01, 1.0, hint=hint)
        self._alone = gui.add_checkbox(
            "hide the map", True, hint="Show the two submaps alone, without the map and the scan."
        )
        self._details = gui.add_folder(None)
        with self._details:
            self._add_details(gui)

    def _add_details(self, gui: viser.GuiApi) -> None:
        self._legend = gui.add_html("")
        gui.add_html(heading("Heights around both keyframes from above, the newer rotated to match; grey: not seen"))
        self._contexts = gui.add_image(_NO_CONTEXTS, format="png")
        self._shifts_title = gui.add_html("")
        line, limit = {"stroke": "#40b8f0", "width": 1.5}, {"stroke": "#e08a00", "width": 1.5, "dash": [3, 3]}
        self._shifts = chart(gui, [line, limit])
        gui.add_html(heading("Histogram of the points' distances to the other submap's surface, mm"))
        self._residuals = chart(gui, [line | {"fill": "#40b8f080"}, limit])

    def show_map(self) -> None:
        """Show the edited map in place of the submaps, until another loop or `alone` is chosen."""
        if self._alone_before is None:
            self._alone_before = self._alone.value
        show(self._alone, False)

    def hide_map(self) -> None:
        """Restore the user's choice from before `show_map`."""
        if self._alone_before is not None:
            show(self._alone, self._alone_before)
        self._alone_before = None

    @property
    def shown(self) -> bool:
        """Whether the two submaps are in the scene."""
        return self._overlay.shown

    @property
    def alone(self) -> bool:
        return self.shown and self._alone.value

    def draw(self, snapshot: Snapshot, edge: LoopEdge | None) -> None:
        """Show the loop `edge`; the engine delivers its details a moment later."""
        detail = _detail(snapshot, edge.pair if edge is not None else None)
        if not self._changes(detail, edge, snapshot.params.loops):
            return
        self._share.visible = self._alone.visible = self._details.visible = detail is not None
        self._waiting.visible = detail is None
        if edge is None:
            return
        self._evidence.content = evidence(edge, snapshot.params.loops)
        names = [(OLDER, f"keyframe {edge.older}"), (NEWER, f"keyframe {edge.newer}")]
        self._legend.content = panel("keys", names, True)
        if detail is not None:
            self._draw_charts(detail, snapshot.params.loops)

    def _draw_charts(self, detail: LoopDetail, params: LoopsParams) -> None:
        turn = best_yaw(detail.shift_distances)
        self._contexts.image = contexts_image(detail.older_context, detail.newer_context, turn)
        title = (
            f"Difference of the two against the rotation of the newer, in degrees; smallest at {np.degrees(turn):.0f}°"
        )
        self._shifts_title.content = heading(title)
        self._shifts.data = shift_curve(detail.shift_distances, params.context_distance)
        self._residuals.data = outline = histogram(detail.residuals, params.max_residual)
        self._residuals.scales = {"x": {"time": False}, "y": {"range": (0.0, float(outline[1].max()))}}

    def draw_scene(self, snapshot: Snapshot, chosen: Pair | None, view: View) -> None:
        """Place the submaps in the scene; the slider interpolates between the two poses."""
        detail, poses = _detail(snapshot, chosen), snapshot.keyframe_poses
        if self._alone_before is not None and not self._alone.value:
            detail = None
        if detail is None or chosen is None or chosen[1] >= len(poses):
            self._overlay.clear()
            return
        T_map_older = poses[chosen[0]] @ detail.T_imu_level
        if self._clouds is None or self._clouds[0] is not detail or self._clouds[1] != view.ceilings:
            both = detail.older, detail.newer
            older, newer = both if view.ceilings else map(without_ceiling, both)
            self._clouds = detail, view.ceilings, older, newer
        T_map_newer = T_map_older @ on_the_way(detail.T_guess, detail.T_registered, self._share.value)
        self._overlay.draw(*self._clouds[2:], T_map_older, T_map_newer, max(view.point_size, _LEAST_POINT_M))


def _detail(snapshot: Snapshot, pair: Pair | None) -> LoopDetail | None:
    inspected = snapshot.loops.inspected
    return inspected[1] if inspected is not None and inspected[0] == pair else None


# --- charts --------------------------------------------------------------------------------------
def disc(context: F32, turn: float = 0.0) -> U8:
    """(_DISC, _DISC, 4) image of a context from above, x to the right and y up; transparent outside its radius.

    Args:
        context: (rings, sectors), NaN where unseen. turn: rad, anticlockwise rotation.
    """
    rings, sectors = context.shape
    at = (np.arange(_DISC) + 0.5) / (_DISC / 2) - 1.0
    x, y = np.meshgrid(at, -at)
    radius = np.hypot(x, y)
    ring = np.minimum((radius * rings).astype(np.int64), rings - 1)
    sector = np.floor((np.arctan2(y, x) - turn) * (sectors / (2 * np.pi))).astype(np.int64) % sectors
    values = context[ring, sector]
    seen = np.isfinite(values)
    high = max(float(np.nanmax(context)), 1e-6) if np.isfinite(context).any() else 1.0
    colours = TABLES["viridis"][np.clip(np.where(seen, values, 0.0) / high * 255, 0, 255).astype(np.uint8)]
    image = np.empty((_DISC, _DISC, 4), np.uint8)
    image[..., :3] = np.where(seen[..., None], colours, np.array(UNSEEN, np.uint8))
    image[..., 3] = np.where(radius <= 1.0, 255, 0)
    return image


def contexts_image(older: F32, newer: F32, turn: float) -> U8:
    """Image of both contexts side by side, the newer one rotated by `turn` (rad) to match the older one."""
    gap = np.zeros((_DISC, _GAP, 4), np.uint8)
    return np.concatenate((disc(older), gap, disc(newer, turn)), axis=1)


def best_yaw(shift_distances: F64) -> float:
    """Heading (rad) of the newer keyframe in the older one's frame at which their contexts are most similar."""
    return float(YAWS[int(np.argmin(shift_distances))])


def shift_curve(shift_distances: F64, limit: float) -> tuple[F64, F64, F64]:
    """Rotation of the newer context (degrees), distance of the contexts, and its limit, (sectors,) each."""
    order = np.argsort(YAWS)
    distances = np.asarray(shift_distances, dtype=np.float64)[order]
    return np.degrees(YAWS[order]), distances, np.full(len(distances), limit)


def histogram(residuals: F64, limit: float) -> tuple[F64, F64, F64]:
    """Histogram of the points' distances (mm) to the other submap's surface, as the outline of its bars.

    Args:
        residuals: (k,) m. limit: m, drawn between two bars by the third series, which is NaN elsewhere.
    """
    values = 1000 * np.abs(residuals[np.isfinite(residuals)])
    high = max(float(np.percentile(values, 99)), 1100 * limit) if len(values) else 1100 * limit
    per_limit = max(round(_BARS * 1000 * limit / high), 1)
    width = 1000 * limit / per_limit
    counts, edges = np.histogram(values, bins=width * np.arange(int(np.ceil(high / width)) + 1))
    mark = np.full(2 * len(counts), np.nan)
    mark[2 * per_limit - 1 : 2 * per_limit + 1] = 0.0, counts.max(initial=1)
    return np.repeat(edges, 2)[1:-1], np.repeat(counts, 2).astype(np.float64), mark
