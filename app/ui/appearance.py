"""The controls for the look of the scene, and the legend that explains its colours."""

from dataclasses import replace
from typing import Final

import viser

from app.ui.colours import COLOUR_BY, LABEL, Key, Limits, Rgb, key, legend
from app.ui.html import panel
from app.ui.scale import Looks
from app.ui.widgets import View, add_command, choose_next, show

_ACCENTS: Final = {False: (38, 166, 154), True: (13, 110, 102)}
"""Colours on a dark and on a light background."""
_LAYERS: Final = (
    ("map", "map", "Points of the keyframes."),
    (
        "moving",
        "moving points",
        "Points on people and other moving objects, found once later keyframes see through them.",
    ),
    ("scan", "scan", "Points of the newest frame."),
    ("wedge", "seed wedge", "Where the engine looks for seeds: within α of straight down, on the M outermost lines."),
    ("plane", "ground plane", "The plane through the seeds."),
    ("path", "path, truth", "The sensor's trajectory, and the truth when it is loaded."),
    ("notes", "notes", "Pinned where the sensor was at that frame. A click goes to the frame."),
    ("grid", "grid", "1 m cells on the ground below the sensor."),
)

_BY_ITSELF, _SHOWN, _HIDDEN = "hidden from above", "shown", "hidden"


def apply_theme(gui: viser.GuiApi, *, light: bool) -> None:
    gui.configure_theme(dark_mode=not light, show_logo=False, show_share_button=False, brand_color=_ACCENTS[light])


class AppearancePanel:
    """Widgets whose values form the `View`; the engine does not know about them.

    looks: how browsers look at the scene. legend: what `templates/transport.js` copies into the scene.
    """

    def __init__(self, gui: viser.GuiApi, legend: viser.GuiHtmlHandle, looks: Looks) -> None:
        default = View()
        self._looks = looks
        self._legend = legend
        self._limits: Limits | None = None  # ends of all values
        self._lines: list[tuple[Rgb, str]] = []  # colours and names of what is drawn beside the points
        self._ends: dict[str, Limits] = {}  # by colour mode, as the user chose them
        self._colour_by = gui.add_dropdown(
            "colour by", COLOUR_BY, initial_value=default.colour_by, hint="Meaning of the colours. C: next mode."
        )
        self._light = gui.add_checkbox("light theme", False, hint="For bright rooms and for print.")
        self._light.on_update(lambda _: apply_theme(gui, light=self._light.value))
        self._follow = gui.add_checkbox(
            "follow",
            default.follow,
            hint="Keep the sensor in the middle; orbit and zoom as you like. F toggles; G shows the whole map again.",
        )
        self._point_size = gui.add_slider(
            "points (cm)",
            0.5,
            15.0,
            0.5,
            100 * default.point_size,
            hint="Diameter of points, which are drawn at least 1.5 and at most 12 pixels wide.",
        )
        with gui.add_folder("Layers", expand_by_default=True):
            self._ceilings = gui.add_dropdown(
                "ceilings",
                (_BY_ITSELF, _SHOWN, _HIDDEN),
                hint="Seen from above, ceilings hide the rooms below them. Ceilings labelled ground always stay.",
            )
            self._layers = {
                name: gui.add_checkbox(text, getattr(default, name), hint=hint) for name, text, hint in _LAYERS
            }
        self._count = gui.add_html("")
        following = "Follow the sensor or move freely"
        add_command(gui, following, lambda _: show(self._follow, not self._follow.value), hotkey="F")
        add_command(gui, "Next colour mode", lambda _: choose_next(self._colour_by), hotkey="C")

    @property
    def view(self) -> View:
        return View(
            colour_by=self._colour_by.value,
            point_size=self._point_size.value / 100,
            follow=self._follow.value,
            light=self._light.value,
            ends=self._ends.get(self._colour_by.value),
            clip=None,
            slab=0.0,
            numbers=None,
            ceilings=self._ceilings.value == _SHOWN
            or (self._ceilings.value == _BY_ITSELF and not self._looks.from_above),
            **{name: layer.value for name, layer in self._layers.items()},
        )

    @property
    def key(self) -> Key:
        """What the colours mean at present, those of lines included."""
        points = key(self._colour_by.value, self._limits, self._ends.get(self._colour_by.value))
        return replace(points, names=(*points.names, *self._lines))

    def colour_by(self, mode: str) -> None:
        """Choose a colour mode, and let the colours span all its values again."""
        self._ends.pop(mode, None)
        show(self._colour_by, mode)

    def choose_ends(self, word: str) -> None:
        """Let the colours span a part of all values, "ends 0 80" in percent; after "ends 0 100", all values again."""
        all_ = self._limits
        match word.split():
            case ["ends", "0", "100"]:
                self._ends.pop(self._colour_by.value, None)
            case ["ends", low, high] if low.isdecimal() and high.isdecimal() and int(low) < int(high) <= 100 and all_:
                width = (all_.high - all_.low) / 100
                self._ends[self._colour_by.value] = Limits(all_.low + int(low) * width, all_.low + int(high) * width)

    def look_freely(self, client: viser.ClientHandle) -> None:
        """Stop following the sensor, and notify the user if following was on."""
        if self._follow.value:
            show(self._follow, False)
            client.add_notification("Follow is off", "The view stays here. F follows the sensor again.")

    def draw(
        self, view: View, limits: Limits | None, lines: list[tuple[Rgb, str]], points: int, moving: int, budget: int
    ) -> None:
        """Explain the colours as drawn; say how many points the page holds, and how many lie on moving objects.

        lines: colours and names of what else is drawn. While neither map nor scan is, their colours need no key.
        """
        self._limits, self._lines = limits, lines
        by = LABEL if view.tuning else view.colour_by
        colours = legend(by, limits, view.ends) if view.map or view.scan else ""
        self._legend.content = panel("legend", colours, lines, view.grid)
        words = f"{points:,} map points are drawn; of more than {budget:,}, mainly those near the camera."
        about = f" {moving:,} moving points are {'shown' if view.moving else 'hidden'}." if moving else ""
        self._count.content = panel("note", f"{words} The engine keeps the whole map.{about}")
