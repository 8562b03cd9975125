"""Two settings side by side: fork the session, see what differs, then swap, keep or discard.

`Sides` decides which of the two the parameters act on; `ComparePanel` shows both.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import viser

from app.server.follower import same_recording
from app.server.fork import Workspace
from app.server.protocol import Command, Snapshot
from app.slam.errors import HemislamError
from app.slam.types import U8, StepResult
from app.ui.compare_maths import A_COLOUR, B_COLOUR, Difference, Ground, difference, ground_difference, thinned
from app.ui.compare_scene import CompareScene
from app.ui.compare_words import legend, numbers, status
from app.ui.html import box, css, heading
from app.ui.readouts import plot
from app.ui.view import View
from app.ui.widgets import by_user, same, show, unchanged

_SCENE_PERIOD_S: Final = 1 / 15
_PANEL_PERIOD_S: Final = 1 / 4
_RECENT: Final = 16
"""Frames of A that are kept for B to come to."""
_SWAP, _KEEP, _DISCARD = "swap", "keep", "discard"
_NO_POINTS: Final[U8] = np.empty(0, dtype=np.uint8)


class Sides:
    """The choice, in the caller's container, whose parameters are seen and set; unseen while there is no fork."""

    def __init__(self, gui: viser.GuiApi, forks: Workspace) -> None:
        self._forks = forks
        self._choice = gui.add_dropdown(
            "act on", ("A", "B"), initial_value="A", visible=False, hint="Whose parameters these are. T changes it."
        )
        gui.add_command("Parameters of A or of its fork B", hotkey="T").on_trigger(lambda _: self._other())

    @property
    def on_b(self) -> bool:
        return self._choice.value == "B" and self._forks.other is not None

    def choose(self, side: str) -> None:
        """A or B."""
        show(self._choice, side)

    def tick(self, b: Snapshot | None) -> None:
        if self._choice.visible != (b is not None):
            self._choice.visible = b is not None

    def tuned(self, a: Snapshot) -> Snapshot:
        """The snapshot whose parameters are to be seen."""
        other = self._forks.other
        return other if other is not None and self.on_b else a

    def send(self, command: Command) -> None:
        """To the side chosen."""
        if self.on_b:
            self._forks.send_other(command)
        else:
            self._forks.send(command)

    def _other(self) -> None:
        self.choose("A" if self._choice.value == "B" or self._forks.other is None else "B")


class ComparePanel:
    """Everything about the fork in the caller's container, and what differs in space.

    Args:
        root: the map's scene node. sides: told which side a new fork's parameters are on. now: monotonic seconds.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        forks: Workspace,
        sides: Sides,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        gui = server.gui
        self._forks = forks
        self._sides = sides
        self._now = now
        self._scene = CompareScene(server.scene, root)
        self._recent: dict[tuple[int, int], StepResult] = {}
        self._pair: tuple[StepResult, StepResult] | None = None
        self._covering = False
        self._ground: U8 = _NO_POINTS
        self._in_scene: tuple[Any, ...] = ()
        self._in_panel: tuple[Any, ...] = ()
        self._scene_at = self._panel_at = -1e9

        self._status = gui.add_html(status(None, None, ("", ""), -1))
        self._name = gui.add_text("name", "", hint="Of the fork, and of its file when it is kept.")
        self._fork = gui.add_button(
            "Fork here", icon=viser.Icon.GIT_BRANCH, hint="Go on from this frame with other parameters, side by side."
        )
        self._open = gui.add_button(
            "Open as B…", icon=viser.Icon.FOLDER_OPEN, color="gray", hint="A kept fork or an older session, beside A."
        )
        self._what = gui.add_button_group(
            "fork", (_SWAP, _KEEP, _DISCARD), visible=False, hint="X swaps. Keep: as a file that can be opened again."
        )
        self._by_ground = gui.add_checkbox(
            "ground: A against B", True, visible=False, hint="Colours the scan by who calls its points ground."
        )
        self._legend = gui.add_html(legend(), visible=False)
        self._numbers = gui.add_html("", visible=False)
        a, b, both = (css(A_COLOUR), 1.5, ""), (css(B_COLOUR), 1.5, ""), ("#b8c0cc", 1.5, "")
        nothing = (np.zeros(1), np.zeros(1))
        self._plots: list[tuple[viser.GuiHtmlHandle, viser.GuiUplotHandle]] = []
        for title, lines in (
            ("A to B, cm", [both]),
            ("A to B, °", [both]),
            ("Frame time, ms (peaks cut)", [a, b]),
            ("Position error to truth, cm", [a, b]),
        ):
            named = gui.add_html(heading(title), visible=False)
            chart = plot(gui, (*nothing, *nothing[1:] * (len(lines) - 1)), lines)
            chart.visible = False
            self._plots.append((named, chart))
        self._fork.on_click(by_user(lambda _, client: self._act("", client)))
        self._open.on_click(by_user(lambda _, client: self._choose(client)))
        self._what.on_click(by_user(self._act))
        gui.add_command("Swap A and its fork B", hotkey="X").on_trigger(lambda _: self._swap_if_any())

    def seen(self, view: View) -> View:
        """The view less the scan, while it is drawn here in other colours."""
        return replace(view, scan=False) if self._covering else view

    def tick(self, a: Snapshot, view: View) -> None:
        """Called by the drawing thread, often, with the view that all others leave."""
        now, b = self._now(), self._forks.other
        self._show_controls(b)
        if b is None:
            self._recent.clear()
        elif a.result is not None:
            self._recent[(a.session, a.result.index)] = a.result
            while len(self._recent) > _RECENT:
                del self._recent[next(iter(self._recent))]
        look = (view.point_size, view.scan, view.path, self._by_ground.value)
        if not same(self._in_scene, (a, b, look), 2) and (now - self._scene_at >= _SCENE_PERIOD_S or b is None):
            self._in_scene, self._scene_at = (a, b, look), now
            self._draw_scene(a, b, view)
        told = (a, b, self._scene_at)  # the scene finds the frame that both have, maybe after the panel was drawn
        if not same(self._in_panel, told, 2) and (now - self._panel_at >= _PANEL_PERIOD_S or b is None):
            self._in_panel, self._panel_at = told, now
            self._draw_panel(a, b)

    # --- what is drawn ---------------------------------------------------------------------------
    def _draw_scene(self, a: Snapshot, b: Snapshot | None, view: View) -> None:
        comparable = b is not None and same_recording(a, b)
        positions = b.trajectory if b is not None and comparable else None
        at = positions[-1] if positions is not None and len(positions) else None
        part = positions[max(self._forks.forked_at, 0) :] if positions is not None else None
        self._scene.draw_b(part, at, view.path)
        pair = self._matching(a, b) if b is not None and comparable else None
        if pair is not None and not unchanged(self._pair or (), pair):
            self._ground = ground_difference(pair[0].cloud, pair[1].cloud)
        self._pair = pair
        self._covering = pair is not None and view.scan and bool(self._by_ground.value) and len(pair[0].cloud) > 0
        self._scene.draw_ground(pair[0] if pair and self._covering else None, self._ground, view.point_size)

    def _matching(self, a: Snapshot, b: Snapshot) -> tuple[StepResult, StepResult] | None:
        """The newest frame that both have: A's own, or while it plays one of a moment ago."""
        if b.result is None:
            return None
        ours = self._recent.get((a.session, b.result.index))
        return (ours, b.result) if ours is not None and ours.stamp_ns == b.result.stamp_ns else None

    def _draw_panel(self, a: Snapshot, b: Snapshot | None) -> None:
        self._status.content = status(a, b, self._forks.names, self._forks.forked_at)
        if b is None or not same_recording(a, b):
            self._numbers.content = ""
            self._show_plots([None] * 4)
            return
        found = difference(a, b, self._forks.forked_at)
        counts = np.bincount(self._ground, minlength=len(Ground)) if self._pair is not None else None
        self._numbers.content = numbers(found, counts)
        self._show_plots(_curves(found))

    def _show_plots(self, curves: "list[tuple[Any, ...] | None]") -> None:
        for (title, chart), curve in zip(self._plots, curves, strict=True):
            if chart.visible != (curve is not None):
                title.visible = chart.visible = curve is not None
            if curve is not None:
                chart.data = curve

    def _show_controls(self, b: Snapshot | None) -> None:
        self._sides.tick(b)
        forked = b is not None
        if self._what.visible != forked:
            self._fork.visible = self._open.visible = not forked
            for control in (self._what, self._by_ground, self._legend, self._numbers):
                control.visible = forked

    # --- what is asked for -----------------------------------------------------------------------
    def _act(self, what: Any, client: viser.ClientHandle) -> None:
        try:
            match what:
                case "swap":
                    self._forks.swap()
                case "keep":
                    path = self._forks.keep(self._name.value)
                    client.add_notification("Kept", f"The fork is {path}; hemislam serve opens it again.")
                case "discard":
                    self._forks.discard()
                case Path():
                    self._forks.open(what)
                case _:
                    self._forks.fork(self._name.value)
                    self._sides.choose("B")
        except HemislamError as error:
            client.add_notification("Error", str(error), color="red", auto_close_seconds=None)

    def _choose(self, client: viser.ClientHandle) -> None:
        """A dialog with the sessions that B can be opened on."""
        kept = self._forks.kept()
        with client.gui.add_modal("Open a session as B") as modal:
            if not kept:
                client.gui.add_html(box("There is no other session of this recording yet; fork, and keep it."))
            buttons = [(path, client.gui.add_button(path.stem, color="gray")) for path in kept]
            cancel = client.gui.add_button("Cancel", color="gray")
        cancel.on_click(lambda _: modal.close())

        def chosen(path: Path, _: object) -> None:
            modal.close()
            self._act(path, client)

        for path, button in buttons:
            button.on_click(partial(chosen, path))

    def _swap_if_any(self) -> None:
        if self._forks.other is not None:
            try:
                self._forks.swap()
            except HemislamError:
                return  # B has no frame yet: its status says so


def _curves(found: Difference) -> "list[tuple[Any, ...] | None]":
    """Of the plots in their order; None for one that has nothing to show."""
    (ms_a, ms_b), (error_a, error_b) = found.total_ms, found.error_m
    if len(found):  # the first frames' peaks would leave nothing of all others
        most = 4 * np.nanmedian(np.concatenate(found.total_ms))
        ms_a, ms_b = np.minimum(ms_a, most), np.minimum(ms_b, most)
    columns = [(100 * found.position_m,), (found.turn_deg,), (ms_a, ms_b), (100 * error_a, 100 * error_b)]
    curves = [thinned(found.stamps_s, *column) for column in columns]
    return [curve if len(curve[0]) > 1 else None for curve in curves]
