"""Measures by clicks in the scene: a point, a distance, an angle; each is named, kept in the session, and drawn."""

import itertools
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import viser

from app.georeference.reference import GeoReference
from app.mapping.kept import Measure, Spot
from app.server.keeping import EditMeasure, KeepMeasure
from app.server.protocol import Snapshot
from app.slam.errors import HemislamError
from app.slam.types import F64
from app.ui.corners import snapped
from app.ui.html import panel
from app.ui.measure_maths import Numbers, as_csv, load, meet, numbers, places, words
from app.ui.nodes import add_exact_points, add_lines, clear, label_text, segments
from app.ui.viser_adapter import Bridge
from app.ui.widgets import ROOT, Changes, Page, View, add_button, ask_text, by_user, show

POINT, DISTANCE, ANGLE, STOP = "point", "distance", "angle", "stop"
_SPOTS: Final = {POINT: 1, DISTANCE: 2, ANGLE: 3}
_WIDTH: Final = 0.01
"""Largest distance of a point from a click, as a share of the picture's height."""
_COLOURS: Final = {False: (255, 205, 80), True: (150, 90, 0)}
"""Colours on a dark and on a light background."""
_CHOSEN: Final = "● "
"""Marks the tool that takes clicks."""
_SIZE_M: Final = 0.08

Taker = Callable[[tuple[Spot, ...], Snapshot], None]


class MeasurePanel:
    """Widgets in the caller's container, and the measures in the scene, below the map's node.

    Attributes:
        spots: clicked so far, of the unfinished measure. client: the browser of the newest click.
    """

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._changes = Changes()
        self._tool: tuple[str, Taker | None] = STOP, None  # both at once: pages change them while clicks are taken
        self._where: GeoReference | None = None
        self._click: tuple[F64, F64, float] | None = None  # newest click: its ray in the map, and its angular radius
        self.spots: tuple[Spot, ...] = ()
        self.client: viser.ClientHandle | None = None
        self._session = -1  # session of these spots
        self._nodes: list[Any] = []
        self._measured: list[tuple[Measure, F64, Numbers]] = []
        self._map: tuple[object, object] = None, None  # chunks and poses of the drawn measures
        self._light = False
        self._kinds = gui.add_button_group("measure", tuple(_SPOTS), hint="Then click points of the map.")
        self._kinds.on_click(by_user(lambda kind, _: self.begin(kind.removeprefix(_CHOSEN))))
        self._asked = gui.add_html("")
        self._bridge = Bridge(gui, "measures", self._act)
        self._list = gui.add_html("")
        self._name = gui.add_text("name", "", hint="Name of the next measure; empty: a number.")
        self._snap = gui.add_checkbox(
            "snap to corners",
            False,
            hint="A click near a corner picks the point where surfaces meet; else a point on an edge.",
        )
        self._save = add_button(gui, "Download as CSV", self._download, viser.Icon.DOWNLOAD, visible=False)

    @property
    def picking(self) -> bool:
        """Whether this panel takes clicks in the scene."""
        return self._tool[0] != STOP

    @property
    def taker(self) -> Taker | None:
        """The panel that gets the spots in place of a measure."""
        return self._tool[1]

    def begin(self, kind: str, taker: Taker | None = None) -> None:
        """Take clicks for measures of this kind. taker: gets the spots of the first one, which then is the last."""
        load()
        self._tool, self.spots = (kind, taker), ()

    def draw(self, current: Snapshot, view: View) -> None:
        """Handle the newest click, and show the session's measures."""
        poses = current.keyframe_poses
        frames = {chunk.index: chunk.frame for chunk in current.chunks} if current.measures or self.spots else {}
        if current.session != self._session or places(Measure("", self.spots), poses, frames) is None:
            self._session, self.spots = current.session, ()  # the spots lie on what is not in the map now
        click, self._click = self._click, None
        kind, taker = tool = self._tool
        if click is not None and kind != STOP and view.map:
            spot = meet(current.chunks, poses, *click, ceilings=view.ceilings, moving=view.moving, clip=view.clip)
            if spot is not None and self._snap.value:
                spot = snapped(current.chunks, poses, spot)
            if spot is not None and tool == self._tool:  # meanwhile the user may have chosen another
                self._take(tool, spot, current)
                kind, taker = self._tool
        begun = self.spots if taker is None else ()
        kept = [(measure, places(measure, poses, frames)) for measure in current.measures]
        where = [(measure, at) for measure, at in kept if at is not None]
        drawn = str([at.round(3).tolist() for _, at in where])
        self._where = current.earth.found.reference if current.earth.found is not None else None
        later = len(kept) - len(where)
        due = current.measures, kind, taker, str(begun), drawn, later, current.session, self._where
        if self._changes(*due, view.light, view.map):
            self._light = view.light
            map_ = current.chunks, current.keyframe_poses
            same = all(before is now for before, now in zip(self._map, map_, strict=True))
            known = {measure: found for measure, _, found in self._measured} if same else {}
            self._map = map_
            self._measured = [
                (measure, at, known.get(measure) or numbers(at, current.chunks, poses)) for measure, at in where
            ]
            self._draw_scene(places(Measure("", begun), poses, frames) if begun else None)
            self._draw_list(later, view.map)

    def _take(self, tool: tuple[str, Taker | None], spot: Spot, current: Snapshot) -> None:
        kind, taker = tool
        self.spots = (*self.spots, spot)
        if len(self.spots) < _SPOTS[kind]:
            return
        spots, self.spots = self.spots, ()
        if taker is not None:
            self.begin(STOP)
            taker(spots, current)
            return
        taken = {measure.name for measure in current.measures}
        numbered = (f"{kind} {number}" for number in itertools.count(1))
        name = self._name.value.strip() or next(name for name in numbered if name not in taken)
        self._page.send(KeepMeasure(Measure(name, spots)))
        show(self._name, "")

    def _draw_scene(self, begun: F64 | None) -> None:
        clear(self._nodes)
        scene = self._page.scene
        colour = _COLOURS[self._light]
        every = [(at, _label(measure.name, at, found)) for measure, at, found in self._measured]
        for number, (at, text) in enumerate([*every, *([(begun, "")] if begun is not None else [])]):
            name, exact = f"{ROOT}/measures/{number}", at.astype(np.float32)
            colours = np.tile(np.array(colour, np.uint8), (len(at), 1))
            self._nodes.append(add_exact_points(scene, f"{name}/points", exact, colours, _SIZE_M))
            if len(at) > 1:
                self._nodes.append(add_lines(scene, f"{name}/lines", segments(exact), colour, 2.5))
            if text:
                self._nodes.append(scene.add_label(f"{name}/label", text, position=at.mean(axis=0)))
        for number, place in enumerate(begun if begun is not None else ()):  # a label is visible through other objects
            self._nodes.append(scene.add_label(f"{ROOT}/measures/begun/{number}", f"{number + 1}", position=place))

    def _draw_list(self, later: int, map_shown: bool) -> None:
        """later: number of measures on keyframes that do not exist now, for example after going back."""
        kind, taker = self._tool
        own = kind if taker is None else STOP
        left = _SPOTS[own] - len(self.spots) if own != STOP else 0
        self._kinds.options = (
            *(_CHOSEN + kind if kind == own else kind for kind in _SPOTS),
            *([STOP] if kind != STOP else []),
        )
        points = f"{left}{' more' if self.spots else ''} point{'s' if left > 1 else ''}"
        asked = f"{kind.capitalize()}: click {points} of the map." if left else ""
        if kind != STOP and not map_shown:
            asked = "The map is hidden; show it to click on points."
        self._asked.content = panel("text", asked) if asked else ""
        rows = [(measure.name, words(at, found, self._where)) for measure, at, found in self._measured]
        waiting = f"{later} more on keyframes that are not in the map now." if later else ""
        self._list.content = self._bridge.live(panel("measures", rows, waiting)) if rows or later else ""
        self._save.visible = bool(rows)

    def clicked(self, event: viser.SceneClickEvent) -> bool:
        """Take a click in the scene while measuring; `draw` uses it. Returns whether it was taken."""
        if not self.picking:
            return False
        self.client = event.client
        self._click = (*self._page.in_map(event), _WIDTH * event.client.camera.fov)
        return True

    def _act(self, word: str, client: viser.ClientHandle) -> None:
        """Handle what the list sends: "delete 3 door", with index and name as that browser shows them."""
        for place, (measure, *_) in enumerate(self._measured):
            if word == f"delete {place} {measure.name}":
                self._page.send(EditMeasure(measure, ""))
            elif word == f"rename {place} {measure.name}":
                self._ask_name(measure, client)

    def _ask_name(self, measure: Measure, client: viser.ClientHandle) -> None:
        def rename(name: str) -> None:
            if not name.strip():
                raise HemislamError("The name is empty; write one, or cancel.")
            self._page.send(EditMeasure(measure, name.strip()))

        ask_text(client, "Rename measure", "name", measure.name, "Rename", rename)

    def _download(self, client: viser.ClientHandle) -> None:
        recording = self._page.snapshot().recording
        name = f"{recording.path.stem if recording else 'map'}-measures.csv"
        client.send_file_download(name, as_csv(self._measured, self._where).encode(), save_immediately=True)


def _label(name: str, at: F64, found: Numbers) -> str:
    """Text of a label in the scene. A distance or angle has its number; a point's coordinates would cover the map."""
    short = label_text(name)
    return short if len(at) == 1 else f"{short}: {words(at, found).split(': ')[0]}"
