"""The Loops tab, and loops in the scene: what is chosen, what is shown, and who is told."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import viser

from app.server.protocol import Command, InspectLoop, Seek, Snapshot
from app.slam.loops.types import LoopEdge, LoopEdit, Pair, SetWeight, Solve, pair_of
from app.slam.types import F64
from app.ui.html import box
from app.ui.loops import ledger
from app.ui.loops.bridge import Bridge
from app.ui.loops.edges import LoopEdges
from app.ui.loops.edits import EditsPanel, Proposal, SolvePanel, VerdictPanel
from app.ui.loops.fly import fly
from app.ui.loops.inspector import CLOSE, FLY, SEEK, Inspector
from app.ui.loops.kinds import Kind
from app.ui.loops.tie import TiePanel
from app.ui.loops.words import worst_factors
from app.ui.view import View
from app.ui.widgets import unchanged

_NONE_YET: Final = box(
    '<span class="hs-quiet">No loops yet. They are looked for where the walk comes back to a place it left at least '
    "15 s before; parameters under <b>Tune</b>, loops.</span>"
)


class LoopsPanel:
    """The tab's content in the caller's container; `tick` draws the scene, `draw` the numbers.

    Args:
        root: scene node of the map, whose position below the scene's origin is `offset`.
        look_freely: stops following the sensor, so that a camera can stay where it is put.
        now: monotonic seconds.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        send: Callable[[Command], None],
        snapshot: Callable[[], Snapshot],
        offset: Callable[[], F64],
        look_freely: Callable[[], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        gui = server.gui
        self._send, self._snapshot, self._offset, self._look_freely = send, snapshot, offset, look_freely
        self._chosen: Pair | None = None
        self._coming: Pair | None = None
        self._session = -1
        self._asked: tuple[object, ...] = ()
        self._shown: frozenset[Kind] = frozenset(Kind) - {Kind.REJECTED}
        self._order = ledger.Order()
        self._told: tuple[object, ...] = ()
        self._edges = LoopEdges(server.scene, f"{root}/loops")
        gui.add_html(ledger.STYLE)
        self._bridge = Bridge(gui, self._act)
        self._ledger = gui.add_html(_NONE_YET)
        self._proposal = Proposal(server, f"{root}/ghost", send, snapshot, self._committed)
        self._folder = gui.add_folder("The chosen loop", visible=False)
        with self._folder:
            self._verdict = VerdictPanel(gui, self._proposal.propose, now)
            self._inspector = Inspector(server, f"{root}/submaps", self._go)
        with gui.add_folder("Tie two keyframes by hand", expand_by_default=False):
            self._tie = TiePanel(server, f"{root}/tie", self._proposal.propose, snapshot, self._fly, now)
        with gui.add_folder("EditList"):
            self._edits = EditsPanel(gui, send, snapshot)
        with gui.add_folder("How well the graph is met", expand_by_default=False):
            self._solve = SolvePanel(gui, self._proposal.propose)
            self._factors = gui.add_html("")
        gui.add_command("Next loop of the ledger", hotkey="J").on_trigger(lambda _: self._step(1))
        gui.add_command("Previous loop of the ledger", hotkey="K").on_trigger(lambda _: self._step(-1))
        server.scene.on_click()(self._clicked)

    @property
    def chosen(self) -> Pair | None:
        return self._chosen

    def seen(self, view: View) -> View:
        """The view, without the map and the scan where two submaps are to be seen alone."""
        alone = self._inspector.alone or self._tie.nudging
        return replace(view, map=False, scan=False, wedge=False, plane=False) if alone else view

    def points_at(self, origin: F64, direction: F64) -> bool:
        """Whether a click's ray in the map is for the loops: at an arch, or while keyframes are picked."""
        return self._tie.picking or self._edges.pick(origin, direction) is not None

    def choose(self, pair: Pair | None) -> None:
        """Show everything there is on a loop; None: on none."""
        if pair != self._chosen:
            self._chosen = pair
            if self._proposal.command is not None and not self._tie.nudging:
                self._proposal.cancel()
            if pair is not None:
                self._tie.suggest_pair(pair)

    def tick(self, snapshot: Snapshot, view: View) -> None:
        """Called by the drawing thread, often: what follows the hand, and the scene."""
        poses = snapshot.keyframe_poses if snapshot.keyframe_poses is not None else np.empty((0, 4, 4))
        if snapshot.session != self._session:
            self._session, self._coming = snapshot.session, None
            self.choose(None)
            self._proposal.cancel()
            self._tie.done()
        edge = self._edge(snapshot)
        self._ask(edge)
        command = self._proposal.command
        self._verdict.draw(edge, command.weight if isinstance(command, SetWeight) else None)
        self._edges.draw(snapshot.loops.edges, poses, self._shown, self._chosen)
        self._tie.draw_scene(snapshot, view)
        self._inspector.draw_scene(snapshot, None if self._tie.nudging else self._chosen, view)
        self._inspector.draw(snapshot, edge)
        self._proposal.draw(snapshot)
        self._edits.draw(snapshot)
        self._solve.draw(snapshot, isinstance(command, Solve))
        self._folder.visible = edge is not None
        self._draw_tables(snapshot)

    def _draw_tables(self, snapshot: Snapshot) -> None:
        loops = snapshot.loops
        told = (loops.edges, loops.residuals, self._shown, self._order, self._chosen)
        if unchanged(self._told, told):
            return
        self._told = told
        if not loops.edges:
            self._ledger.content = _NONE_YET
        else:
            rows = ledger.listed(loops.edges, self._shown, self._order)
            self._ledger.content = self._bridge.live(
                ledger.chips(loops.edges, self._shown) + ledger.table(rows, self._order, self._chosen)
            )
        self._factors.content = self._bridge.live(worst_factors(loops.residuals))

    def _edge(self, snapshot: Snapshot) -> LoopEdge | None:
        """The chosen loop as it is now; nothing is chosen any more when it is gone."""
        chosen = self._chosen
        edge = next((edge for edge in snapshot.loops.edges if edge.pair == chosen), None)
        if edge is not None:
            self._coming = None
        elif chosen is not None and chosen != self._coming:
            self.choose(None)
        return edge

    def _ask(self, edge: LoopEdge | None) -> None:
        """Have the engine show the chosen loop; again when it has become another."""
        asked = (edge.pair, edge.verdict, edge.T_older_newer.tobytes()) if edge is not None else ()
        if asked != self._asked:
            self._asked = asked
            self._send(InspectLoop(edge.pair if edge is not None else None))

    def _act(self, word: str, _: viser.ClientHandle) -> None:
        """A click on HTML."""
        match word.split(" ", 1):
            case ["show", kind] if kind in list(Kind):
                self._shown = self._shown ^ {Kind(kind)}
            case ["sort", column] if column in ledger.COLUMNS:
                self._order = self._order.clicked(column)
            case ["choose", text]:
                named = {f"{edge.older} {edge.newer}": edge.pair for edge in self._snapshot().loops.edges}
                if text in named:
                    self.choose(None if named[text] == self._chosen else named[text])

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        """A click in the scene."""
        origin, direction = np.array(event.ray_origin) - self._offset(), np.array(event.ray_direction)
        if self._tie.picking:
            self._tie.pick(origin, direction)
        elif (pair := self._edges.pick(origin, direction)) is not None:
            self.choose(pair)

    def _step(self, by: int) -> None:
        """To the next loop in the ledger's order, or back."""
        rows = [edge.pair for edge in ledger.listed(self._snapshot().loops.edges, self._shown, self._order)]
        if rows:
            here = rows.index(self._chosen) if self._chosen in rows else (-1 if by > 0 else len(rows))
            self.choose(rows[min(max(here + by, 0), len(rows) - 1)])

    def _go(self, what: str, client: viser.ClientHandle) -> None:
        snapshot, pair = self._snapshot(), self._chosen
        edge = next((edge for edge in snapshot.loops.edges if edge.pair == pair), None)
        if what == CLOSE or edge is None:
            self.choose(None)
        elif what == SEEK:
            frames = {chunk.index: chunk.frame for chunk in snapshot.chunks}
            frame = frames.get(edge.decided_at, frames.get(edge.newer))
            if frame is not None:
                self._send(Seek(frame))
        elif what == FLY and snapshot.keyframe_poses is not None and edge.newer < len(snapshot.keyframe_poses):
            ends = snapshot.keyframe_poses[[edge.older, edge.newer], :3, 3]
            self._fly(client, ends.mean(axis=0), 7.0 + 1.2 * float(np.linalg.norm(ends[1] - ends[0])))

    def _fly(self, client: viser.ClientHandle, place: F64, distance: float) -> None:
        """Take a browser's camera to a place (3,) of the map."""
        self._look_freely()
        fly(client, place + self._offset(), distance)

    def _committed(self, command: LoopEdit) -> None:
        self._tie.done()
        if (pair := pair_of(command)) is not None:
            self._chosen = self._coming = pair  # a loop by hand has yet to arrive
