"""Two settings side by side: fork the session, see the differences, then swap, keep or discard.

`Sides` decides whether the parameter panel belongs to A or to B; `ComparePanel` shows both.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import viser

from app.server.fork import Workspace, same_recording
from app.server.protocol import Command, Snapshot
from app.slam.errors import HemislamError
from app.slam.types import F64, U8, StepResult
from app.ui import compare_maths as maths
from app.ui.html import css, heading, panel
from app.ui.nodes import NO_COLOURS, NO_POINTS, TrajectoryNode, add_points, place
from app.ui.sensor import SCAN_POINT_SCALE, shown_of
from app.ui.widgets import (
    PANEL_PERIOD_S,
    ROOT,
    SCENE_PERIOD_S,
    Changes,
    Page,
    View,
    add_button,
    add_command,
    by_user,
    chart,
    dialog,
    show,
)

_RECENT: Final = 16
"""How many frames of A are kept until B reaches them."""
_SWAP, _KEEP, _DISCARD = "swap", "keep", "discard"
_NO_POINTS: Final[U8] = np.empty(0, dtype=np.uint8)


class Sides:
    """The choice between the parameters of A and of B; hidden while there is no fork."""

    def __init__(self, gui: viser.GuiApi, forks: Workspace) -> None:
        self._forks = forks
        self._choice = gui.add_dropdown(
            "act on",
            ("A", "B"),
            initial_value="A",
            visible=False,
            hint="Whose parameters are shown and changed. T switches.",
        )
        add_command(gui, "Parameters of A or of its fork B", lambda _: self._other(), hotkey="T")

    @property
    def on_b(self) -> bool:
        return self._choice.value == "B" and self._forks.other is not None

    def choose(self, side: str) -> None:
        show(self._choice, side)

    def draw(self, b: Snapshot | None) -> None:
        self._choice.visible = b is not None

    def tuned(self, a: Snapshot) -> Snapshot:
        other = self._forks.other
        return other if other is not None and self.on_b else a

    def send(self, command: Command) -> None:
        if self.on_b:
            self._forks.send_other(command)
        else:
            self._forks.send(command)

    def _other(self) -> None:
        if self._forks.other is None:
            raise HemislamError("There is no fork; fork first.")
        self.choose("A" if self._choice.value == "B" else "B")


class CompareScene:
    """B's trajectory and sensor, and A's scan coloured by which of A and B label a point ground; in the map's frame."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._path = TrajectoryNode(scene, f"{ROOT}/compare_path", maths.B_COLOUR)
        self._marker = scene.add_icosphere(
            f"{ROOT}/compare_sensor",
            radius=0.07,
            color=maths.B_COLOUR,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        self._lidar = scene.add_frame(f"{ROOT}/compare_lidar", show_axes=False, visible=False)
        self._cloud = add_points(scene, f"{ROOT}/compare_lidar/scan", NO_POINTS, NO_COLOURS, 0.04)

    def draw_b(self, positions: F64, at: F64 | None, visible: bool) -> None:
        """Draw B's trajectory since the fork, (n, 3), and its sensor at (3,); None hides the sensor."""
        self._path.draw(positions, visible)
        self._marker.visible = visible and at is not None
        if at is not None:
            self._marker.position = at

    def draw_ground(self, result: StepResult | None, ground: U8, size: float) -> None:
        """Draw A's frame with its points coloured by (n,) `Labelled`; None hides it."""
        self._lidar.visible = result is not None
        if result is None:
            return
        place(self._lidar, result.T_map_lidar)
        shown = shown_of(len(result.cloud))
        self._cloud.points = result.cloud.points[shown].astype(np.float16)
        self._cloud.colors = maths.GROUND_COLOURS[ground[shown]]
        self._cloud.point_size = size * SCAN_POINT_SCALE


class ComparePanel:
    """Everything about the fork in the caller's container, and the differences in the scene.

    Args:
        sides: shows which side a new fork's parameters are on.
    """

    def __init__(self, page: Page, forks: Workspace, sides: Sides) -> None:
        gui = page.gui
        self._forks = forks
        self._sides = sides
        self._scene = CompareScene(page.scene)
        self._recent: dict[tuple[int, int], StepResult] = {}
        self._pair: tuple[StepResult, StepResult] | None = None
        self._covering = False
        self._ground: U8 = _NO_POINTS
        self._scene_changes, self._pair_changes = Changes(page.now, SCENE_PERIOD_S), Changes()
        self._panel_changes = Changes(page.now, PANEL_PERIOD_S)
        self._name_changes = Changes()

        self._status = gui.add_html(panel("no_fork", False))
        self._name = gui.add_text("name", "", hint="Name of the fork, and of its file if you keep it.")
        hint = "Continue from this frame with other parameters, side by side."
        self._fork = add_button(gui, "Fork here", lambda _: self._begin(), viser.Icon.GIT_BRANCH, color=None, hint=hint)
        hint = "A kept fork or an older session, beside A."
        self._open = add_button(gui, "Open as B…", self._choose, viser.Icon.FOLDER_OPEN, hint=hint)
        hint = "X swaps. Keep saves a file that can be opened again."
        self._what = gui.add_button_group("fork", (_SWAP, _KEEP, _DISCARD), visible=False, hint=hint)
        hint = "Colour the scan by whether A, B or both label a point ground."
        self._by_ground = gui.add_checkbox("ground: A against B", True, visible=False, hint=hint)
        self._comparison = gui.add_folder(None, visible=False)
        with self._comparison:
            self._add_comparison(gui)
        self._what.on_click(by_user(self._act))
        add_command(gui, "Swap A and its fork B", lambda _: forks.swap(), hotkey="X")

    def _add_comparison(self, gui: viser.GuiApi) -> None:
        gui.add_html(maths.legend())
        self._numbers = gui.add_html("")
        colours = css(maths.A_COLOUR), css(maths.B_COLOUR), "#b8c0cc"
        a, b, both = ({"stroke": colour, "width": 1.5} for colour in colours)
        self._plots: list[tuple[viser.GuiFolderHandle, viser.GuiUplotHandle]] = []
        for title, lines in (
            ("A to B, cm", [both]),
            ("A to B, °", [both]),
            ("Frame time, ms (peaks cut)", [a, b]),
            ("Position error to truth, cm", [a, b]),
        ):
            titled = gui.add_folder(None, visible=False)
            with titled:
                gui.add_html(heading(title))
                self._plots.append((titled, chart(gui, lines)))

    def seen(self, view: View) -> View:
        """The view; without the scan while this panel draws it in other colours."""
        return replace(view, scan=False) if self._covering else view

    def draw(self, a: Snapshot, view: View) -> None:
        """Called often by the drawing thread, with the view after all other panels have changed it."""
        b, name = self._forks.other, self._forks.names[1]
        self._sides.draw(b)
        if self._name_changes(name):
            show(self._name, name)  # `keep` keeps B
        self._fork.visible = self._open.visible = b is None
        self._fork.disabled = self._open.disabled = a.live is not None
        self._what.visible = self._by_ground.visible = self._comparison.visible = b is not None
        if b is None:
            self._recent.clear()
        elif a.result is not None:
            self._recent[(a.session, a.result.index)] = a.result
            while len(self._recent) > _RECENT:
                del self._recent[next(iter(self._recent))]
        look = (a, b, view.point_size, view.scan, view.path, self._by_ground.value)
        if self._scene_changes(*look, at_once=b is None):
            self._draw_scene(a, b, view)
        if self._panel_changes(a, b, self._pair, at_once=b is None):
            self._draw_panel(a, b)

    # --- what is drawn ---------------------------------------------------------------------------
    def _draw_scene(self, a: Snapshot, b: Snapshot | None, view: View) -> None:
        if b is None or not same_recording(a, b):
            b = None
        positions = b.trajectory if b is not None else np.empty((0, 3))
        at = positions[-1] if len(positions) else None
        self._scene.draw_b(positions[max(self._forks.forked_at, 0) :], at, view.path)
        pair = self._matching(a, b) if b is not None else None
        if pair is None:
            self._pair = None
        elif self._pair_changes(*pair) or self._pair is None:
            self._pair = pair
            self._ground = maths.ground_difference(pair[0].cloud, pair[1].cloud)
        self._covering = pair is not None and view.scan and bool(self._by_ground.value) and len(pair[0].cloud) > 0
        self._scene.draw_ground(pair[0] if pair and self._covering else None, self._ground, view.point_size)

    def _matching(self, a: Snapshot, b: Snapshot) -> tuple[StepResult, StepResult] | None:
        """The newest frame that both have: A's present frame or, during playback, a recent one."""
        if b.result is None:
            return None
        ours = self._recent.get((a.session, b.result.index))
        return (ours, b.result) if ours is not None and ours.stamp_ns == b.result.stamp_ns else None

    def _draw_panel(self, a: Snapshot, b: Snapshot | None) -> None:
        self._status.content = maths.status(a, b, self._forks.names, self._forks.forked_at)
        if b is None or not same_recording(a, b):
            self._numbers.content = ""
            self._show_plots([None] * 4)
            return
        found = maths.difference(a, b, self._forks.forked_at)
        counts = np.bincount(self._ground, minlength=len(maths.Labelled)) if self._pair is not None else None
        self._numbers.content = maths.numbers(found, counts)
        self._show_plots(_curves(found))

    def _show_plots(self, curves: "list[tuple[Any, ...] | None]") -> None:
        for (titled, plot), curve in zip(self._plots, curves, strict=True):
            titled.visible = curve is not None
            if curve is not None:
                plot.data = curve

    # --- what is asked for -----------------------------------------------------------------------
    def _act(self, what: Any, client: viser.ClientHandle) -> None:
        match what:
            case "swap":
                self._forks.swap()
            case "keep":
                path = self._forks.keep(self._name.value)
                client.add_notification("Kept", f"The fork is saved as {path}; hemislam serve opens it.")
            case "discard":
                self._forks.discard()

    def _begin(self) -> None:
        self._forks.fork(self._name.value)
        self._sides.choose("B")

    def _choose(self, client: viser.ClientHandle) -> None:
        kept = self._forks.kept()
        with dialog(client, "Open a session as B") as close:
            if not kept:
                client.gui.add_html(
                    panel(
                        "text",
                        "No other session of this recording begins where this one does; fork, then keep the fork.",
                    )
                )
            for path in kept:
                add_button(client.gui, path.stem, partial(self._open_beside, path, close))

    def _open_beside(self, path: Path, close: Callable[[], None], _: viser.ClientHandle) -> None:
        close()
        self._forks.open(path)


def _curves(found: maths.Difference) -> "list[tuple[Any, ...] | None]":
    """The data of the plots, in their order; None for a plot without data."""
    (ms_a, ms_b), (error_a, error_b) = found.total_ms, found.error_m
    if len(found):  # the peaks of the first frames would flatten the rest
        most = 4 * np.nanmedian(np.concatenate(found.total_ms))
        ms_a, ms_b = np.minimum(ms_a, most), np.minimum(ms_b, most)
    columns = [(100 * found.position_m,), (found.turn_deg,), (ms_a, ms_b), (100 * error_a, 100 * error_b)]
    curves = [maths.thinned(found.stamps_s, *column) for column in columns]
    return [curve if len(curve[0]) > 1 else None for curve in curves]
