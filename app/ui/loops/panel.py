"""The Loops tab, and loops in the scene: which loop is chosen, and which are shown."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import viser

from app.server.protocol import InspectLoop, Seek, Snapshot
from app.slam.errors import HemislamError
from app.slam.loops.edits import Accept, LoopEdit, Reject, SetWeight, Solve
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.types import F64
from app.ui.colours import Rgb
from app.ui.html import panel
from app.ui.loops.add_loop import AddLoopPanel
from app.ui.loops.edges import CHOSEN, LoopEdges
from app.ui.loops.edits import EditsPanel, Proposal, VerdictPanel, decided
from app.ui.loops.inspector import CLOSE, FLY, SEEK, Inspector
from app.ui.loops.table import COLUMNS, Order, chips, listed, table
from app.ui.loops.words import BRIDGE, KINDS, NEWER, OLDER, forecast, kind_of, largest_factors, name
from app.ui.viser_adapter import Bridge
from app.ui.widgets import ROOT, Changes, Page, View, add_button, add_command

_STEPS: Final = 14
_STEP_S: Final = 0.03
_LEAST_SLOPE: Final = 0.9
"""Least downward slope of the view (vertical over horizontal), to see into a building."""
_SOLVE_HINT: Final = (
    "Levenberg-Marquardt over all factors, instead of one keyframe after another. First shows what would change."
)
_NONE_YET: Final = (
    "No loops yet. They are searched for where the trajectory returns to a place that it left at least 15 s before; "
    "for the settings, see Parameters, Loop search."
)


class LoopsPanel:
    """The tab's content in the caller's container, and the loops in the scene.

    Args:
        look_freely: stops following the sensor, so that a camera stays where it is put.

    Attributes:
        chosen: the loop that is inspected.
    """

    def __init__(self, page: Page, look_freely: Callable[[viser.ClientHandle], None]) -> None:
        gui = page.gui
        self._page, self._look_freely = page, look_freely
        self.chosen: Pair | None = None
        self._coming: Pair | None = None
        self._opener: viser.GuiHtmlHandle | None = None  # HTML that last opened this tab in one browser
        self._session = -1
        self._asked: tuple[object, ...] = ()
        self._shown: frozenset[str] = frozenset(KINDS) - {"rejected"}
        self._order = Order()
        self._changes = Changes()
        self._edges = LoopEdges(page.scene, f"{ROOT}/loops")
        self._bridge = Bridge(gui, BRIDGE, self._act)
        self._table = gui.add_html(panel("quiet", _NONE_YET))
        self._folder = gui.add_folder("The chosen loop", visible=False)
        with self._folder:
            self._verdict = VerdictPanel(
                page, lambda edit: self._proposal.apply(edit), lambda edit: self._proposal.propose(edit)
            )
        # Below the verdict's buttons, so that these stay under the mouse.
        self._proposal = Proposal(page, self._applied)
        self._evidence_folder = gui.add_folder("Evidence", visible=False)
        with self._evidence_folder:
            self._inspector = Inspector(page, self._go)
        with gui.add_folder("Add a loop manually", expand_by_default=False):
            self._add_loop = AddLoopPanel(page, self._proposal.propose, self._fly)
        self._edits_folder = gui.add_folder("Manual edits", visible=False)
        with self._edits_folder:
            self._edits = EditsPanel(page)
        self._residuals_folder = gui.add_folder("Graph residuals", expand_by_default=False, visible=False)
        with self._residuals_folder:
            self._solve = add_button(
                gui,
                "Solve all at once…",
                lambda _: self._proposal.propose(Solve()),
                viser.Icon.MATH_FUNCTION,
                hint=_SOLVE_HINT,
            )
            self._solving = gui.add_html(
                panel("text", "The changes that it would make are shown above, under “Before you decide”."),
                visible=False,
            )
            self._factors = gui.add_html("")
        add_command(gui, "Next loop in the table", lambda _: self._step(1), hotkey="J")
        add_command(gui, "Previous loop in the table", lambda _: self._step(-1), hotkey="K")

    def seen(self, view: View) -> View:
        """The view; without the map and the scan while two submaps are shown alone."""
        alone = self._inspector.alone or self._add_loop.nudging
        return replace(view, map=False, scan=False, wedge=False, plane=False) if alone else view

    def keys(self, snapshot: Snapshot, light: bool) -> list[tuple[Rgb, str]]:
        """Colours and names for the legend of the loops in the scene."""
        found = {kind_of(edge).name for edge in snapshot.loops.edges}
        arches = [(kind.colour, f"{key} loop") for key, kind in KINDS.items() if key in found & self._shown]
        arches += self._proposal.ghost.key
        if (chosen := self.chosen) is None:
            return arches
        arches = [(CHOSEN[light], f"chosen loop {name(chosen)}"), *arches]
        if not self._inspector.shown:
            return arches
        return [(OLDER, f"keyframe {chosen[0]}"), (NEWER, f"keyframe {chosen[1]}"), *arches]

    def choose(self, pair: Pair | None) -> None:
        """Choose a loop to inspect, or None."""
        if pair != self.chosen:
            self.chosen = pair
            self._inspector.hide_map()
            if not self._add_loop.nudging:
                self._proposal.cancel()
            if pair is not None:
                self._add_loop.suggest_pair(pair)

    def draw(self, snapshot: Snapshot, view: View) -> None:
        poses = snapshot.keyframe_poses
        if snapshot.session != self._session:
            self._session, self._coming = snapshot.session, None
            self.choose(None)
            self._proposal.cancel()
            self._add_loop.done()
        edge = self._edge(snapshot)
        self._ask(edge)
        command = self._proposal.command
        self._proposal.see(snapshot)
        if self._proposal.last is None:
            self._inspector.hide_map()
        undo = edge is not None and edge.pair in map(decided, snapshot.loops.undo[-1:])
        other = None
        if edge is not None and not undo:
            other = (Reject if edge.verdict is Verdict.ACCEPTED else Accept)(*edge.pair)
        self._proposal.draw(snapshot, other, self.chosen, view.light)
        words = ""
        if edge is not None and self._proposal.happened and self._proposal.about == edge.pair:
            words = self._proposal.happened
        elif other is not None and command is None:
            words = forecast(other, self._proposal.preview, poses, snapshot.loops.residuals)
        self._verdict.draw(edge, command.weight if isinstance(command, SetWeight) else None, words, undo)
        self._edges.draw(snapshot.loops.edges, poses, self._shown, self.chosen, view.light)
        self._add_loop.draw_scene(snapshot, view)
        self._inspector.draw_scene(snapshot, None if self._add_loop.nudging else self.chosen, view)
        self._inspector.draw(snapshot, edge)
        self._edits.draw(snapshot)
        loops = snapshot.loops
        self._solving.visible = isinstance(command, Solve)
        self._solve.disabled = Solve() in loops.undo or not any(edge.counts for edge in loops.edges)
        self._folder.visible = edge is not None
        considered = command.pair if command is not None else None
        self._evidence_folder.visible = edge is not None and considered in (None, edge.pair)
        self._edits_folder.visible = len(poses) > 1
        self._residuals_folder.visible = bool(loops.edges)
        self._draw_tables(snapshot)

    def _draw_tables(self, snapshot: Snapshot) -> None:
        loops = snapshot.loops
        if not self._changes(loops.edges, loops.residuals, self._shown, self._order, *(self.chosen or ())):
            return
        if not loops.edges:
            self._table.content = panel("quiet", _NONE_YET)
        else:
            rows = table(listed(loops.edges, self._shown, self._order), self._order, self.chosen)
            self._table.content = self._bridge.live(chips(loops.edges, self._shown) + rows)
        self._factors.content = self._bridge.live(largest_factors(loops.residuals))

    def _edge(self, snapshot: Snapshot) -> LoopEdge | None:
        """The present state of the chosen loop. If it no longer exists, the choice is cleared."""
        chosen = self.chosen
        edge = next((edge for edge in snapshot.loops.edges if edge.pair == chosen), None)
        if edge is not None:
            self._coming = None
        elif chosen is not None and chosen != self._coming:
            self.choose(None)
        return edge

    def _ask(self, edge: LoopEdge | None) -> None:
        """Ask the engine for the chosen loop's details, and again when the loop has changed."""
        asked = (edge.pair, edge.verdict, edge.T_older_newer.tobytes()) if edge is not None else ()
        if asked != self._asked:
            self._asked = asked
            self._page.send(InspectLoop(edge.pair if edge is not None else None))

    def _act(self, word: str, _: viser.ClientHandle) -> None:
        match word.split(" ", 1):
            case ["show", kind] if kind in KINDS:
                self._shown = self._shown ^ {kind}
            case ["sort", column] if column in COLUMNS:
                self._order = self._order.clicked(column)
            case ["choose", text]:
                named = {f"{edge.older} {edge.newer}": edge.pair for edge in self._page.snapshot().loops.edges}
                if text in named:
                    self.choose(None if named[text] == self.chosen else named[text])

    def clicked(self, event: viser.SceneClickEvent) -> bool:
        """Handle a click on an arch in the scene, or while keyframes are picked. Returns whether it did."""
        ray = self._page.in_map(event)
        if self._add_loop.picking:
            self._add_loop.pick(*ray)
            return True
        if (pair := self._edges.pick(*ray)) is None:
            return False
        self.choose(pair)
        if self._opener is not None:
            self._opener.remove()
        self._opener = event.client.gui.add_html(panel("open_tab", "Loops"))
        return True

    def _step(self, by: int) -> None:
        rows = [edge.pair for edge in listed(self._page.snapshot().loops.edges, self._shown, self._order)]
        if not rows:
            raise HemislamError("The table of loops is empty.")
        here = rows.index(self.chosen) if self.chosen in rows else (-1 if by > 0 else len(rows))
        self.choose(rows[min(max(here + by, 0), len(rows) - 1)])

    def _go(self, what: str, client: viser.ClientHandle) -> None:
        snapshot, pair = self._page.snapshot(), self.chosen
        edge = next((edge for edge in snapshot.loops.edges if edge.pair == pair), None)
        if what == CLOSE or edge is None:
            self.choose(None)
        elif what == SEEK:
            frames = {chunk.index: chunk.frame for chunk in snapshot.chunks}
            frame = frames.get(edge.decided_at, frames.get(edge.newer))
            if frame is not None:
                self._page.send(Seek(frame))
        elif what == FLY and edge.newer < len(poses := snapshot.keyframe_poses):
            ends = poses[[edge.older, edge.newer], :3, 3]
            self._fly(client, ends.mean(axis=0), 7.0 + 1.2 * float(np.linalg.norm(ends[1] - ends[0])))

    def _fly(self, client: viser.ClientHandle, place: F64, distance: float) -> None:
        self._look_freely(client)
        fly(client, place + self._page.offset(), distance)

    def _applied(self, command: LoopEdit) -> None:
        self._add_loop.done()
        self._inspector.show_map()
        if (pair := command.pair) is not None:
            self.chosen = self._coming = pair  # a loop added manually arrives later


def stand(position: F64, look_at: F64, target: F64, distance: float) -> F64:
    """(3,) camera position that views `target` from `distance` (m), from the same side as before."""
    back = position - look_at
    flat = back[:2] if np.linalg.norm(back[:2]) > 1e-6 else np.array([-1.0, -1.0])
    flat = flat / np.linalg.norm(flat)
    slope = max(float(back[2] / max(np.linalg.norm(back[:2]), 1e-6)), _LEAST_SLOPE)
    way = np.array([*flat, min(slope, 3.0)])
    return np.asarray(target + distance * way / np.linalg.norm(way))


def fly(client: viser.ClientHandle, target: F64, distance: float) -> None:
    """Move one browser's camera to `target` (3,), in the scene's frame, within half a second."""
    camera = client.camera
    position, look_at = np.array(camera.position), np.array(camera.look_at)
    there = stand(position, look_at, target, distance)
    for step in range(1, _STEPS + 1):
        share = step / _STEPS
        share = share * share * (3 - 2 * share)
        with client.atomic():
            camera.position = (1 - share) * position + share * there
            camera.look_at = (1 - share) * look_at + share * target
        time.sleep(_STEP_S)
