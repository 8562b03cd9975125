"""All there is on one loop: its numbers, its contexts, its residuals, and both submaps in the scene."""

from collections.abc import Callable
from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.loops.types import LoopDetail, LoopEdge, Pair
from app.slam.types import F32, F64
from app.ui.html import box, heading
from app.ui.loops.charts import best_yaw, contexts_image, histogram, shift_plot
from app.ui.loops.overlay import Overlay, Pairing, on_the_way, without_ceiling
from app.ui.loops.words import evidence, submap_legend
from app.ui.view import View
from app.ui.widgets import by_user, unchanged

FLY, SEEK, CLOSE = "fly there", "frame", "close"
_LEAST_POINT_M: Final = 0.035
"""Submaps are thinner than the map."""
_NO_CONTEXTS: Final = np.zeros((1, 1, 4), np.uint8)


class Inspector:
    """Widgets in the caller's container, and clouds below the scene node `root`.

    Args:
        act: called with `FLY`, `SEEK` or `CLOSE` and the browser.
    """

    def __init__(self, server: viser.ViserServer, root: str, act: Callable[[str, viser.ClientHandle], None]) -> None:
        gui = server.gui
        self._overlay = Overlay(server.scene, root)
        self._pairing: Pairing | None = None
        self._detail: LoopDetail | None = None
        self._clouds: tuple[LoopDetail, bool, F32, F32] | None = None
        self._told: tuple[object, ...] = ()
        self._evidence = gui.add_html("")
        self._go = gui.add_button_group(
            "go", (FLY, SEEK, CLOSE), hint="Fly to the loop, seek to the frame at which it was decided, or close it."
        )
        self._go.on_click(by_user(act))
        self._waiting = gui.add_html(box('<span class="hs-quiet">The engine gets the submaps …</span>'))
        self._laid = gui.add_slider(
            "submaps", 0.0, 1.0, 0.01, 1.0, hint="Left: where the graph had them. Right: as they were registered.",
            marks=((0.0, "graph"), (1.0, "fit")),
        )  # fmt: skip
        self._alone = gui.add_checkbox("these alone", True, hint="Hide the map and the scan behind the two submaps.")
        self._legend = gui.add_html("")
        self._contexts_title = gui.add_html(
            heading("Scan Contexts from above; grey was never seen, the newer one is turned to fit")
        )
        self._contexts = gui.add_image(_NO_CONTEXTS, format="png")
        self._charts = gui.add_html("")

    @property
    def alone(self) -> bool:
        """Whether the submaps are in the scene and nothing else should be."""
        return self._pairing is not None and self._alone.value

    def draw(self, snapshot: Snapshot, edge: LoopEdge | None) -> None:
        """Show the loop `edge`; what has not come yet from the engine is waited for."""
        asked = edge.pair if edge is not None else None
        detail = _detail(snapshot, asked)
        news = (detail, edge, snapshot.params.loops)
        if unchanged(self._told, news):
            return
        self._told = news
        for handle in (self._laid, self._alone, self._legend, self._contexts_title, self._contexts, self._charts):
            handle.visible = detail is not None
        self._waiting.visible = detail is None
        if edge is None:
            return
        params = snapshot.params.loops
        self._evidence.content = evidence(edge, params)
        self._legend.content = submap_legend(edge.pair)
        if detail is not None:
            if detail is not self._detail:
                turn = best_yaw(detail.shift_distances)
                self._contexts.image = contexts_image(detail.older_context, detail.newer_context, turn)
            degrees = np.degrees(best_yaw(detail.shift_distances))
            self._charts.content = (
                heading(f"Distance of the contexts over the turn of the newer; best at {degrees:.0f}°")
                + box(shift_plot(detail.shift_distances, params.context_distance))
                + heading("Points over their distance to the other submap's surface, mm")
                + box(histogram(detail.residuals, params.max_residual))
            )
        self._detail = detail

    def draw_scene(self, snapshot: Snapshot, chosen: Pair | None, view: View) -> None:
        """Lay the submaps into the scene, as far between the two poses as the slider says."""
        detail, poses = _detail(snapshot, chosen), snapshot.keyframe_poses
        if detail is None or chosen is None or poses is None or chosen[1] >= len(poses):
            self._pairing = None
            self._overlay.draw(None, None, view.point_size)
            return
        T_map_older = poses[chosen[0]] @ detail.T_imu_level
        if self._clouds is None or self._clouds[0] is not detail or self._clouds[1] != view.ceilings:
            both = detail.older, detail.newer
            older, newer = both if view.ceilings else map(without_ceiling, both)
            self._clouds = detail, view.ceilings, older, newer
        self._pairing = Pairing(*self._clouds[2:], T_map_older)
        size = max(view.point_size, _LEAST_POINT_M)
        self._overlay.draw(self._pairing, placed(detail, T_map_older, self._laid.value), size)


def placed(detail: LoopDetail, T_map_older: F64, share: float) -> F64:
    """(4, 4) T_map_newer of the level frames. share: 0 where the graph had it, 1 as registered."""
    return np.asarray(T_map_older @ on_the_way(detail.T_guess, detail.T_registered, share))


def _detail(snapshot: Snapshot, pair: Pair | None) -> LoopDetail | None:
    inspected = snapshot.loops.inspected
    return inspected[1] if inspected is not None and inspected[0] == pair else None
