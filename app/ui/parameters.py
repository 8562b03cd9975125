"""The parameter panel, generated from the declaration of the parameters (`app.slam.params.leaves`).

A number has a slider over its range; a vector has one for each component. If a range spans decades, the slider offers
round values, and a box above it takes any other value. M, α, σ and the voxel size come first; the others are in one
folder per section.

Browsers and the engine may both change a value. A value set by a user is sent as a command. Controls then follow the
snapshots, except those touched a moment ago: an older snapshot must not move a slider while the user drags it.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import viser

from app.server.fork import engine_number
from app.server.protocol import LoadParams, Restart, SetParams, Snapshot
from app.slam.params import Leaf, Params, leaves
from app.slam.sections import Effect
from app.slam.types import GROUND, SEED
from app.ui.colours import LABEL_COLOURS
from app.ui.html import heading, number, panel, source
from app.ui.viser_adapter import Bridge
from app.ui.widgets import PANEL_PERIOD_S, Changes, Edit, Page, add_button, as_set, by_user, dialog, show

PRIMARY: Final = {
    "ground.scan_lines": "M scan lines",
    "ground.alpha": "α seed angle",
    "ground.sigma": "σ thickness",
    "ground.voxel_size": "voxel",
}
"""The paper's parameters, shown above all others, and their names on the page."""

MARK: Final[dict[Effect, str]] = {"now": "", "frame": " ▸", "restart": " ↻"}
_MOST_STEPS: Final = 8000
"""Most steps of a linear slider. The IMU's noise spans decades: its usual values would share the first few pixels."""
_DIGITS: Final = 9
"""Most decimal places that a box shows and accepts."""
_COMPONENTS: Final = {
    "sensor.translation": ("translation x", "translation y", "translation z"),
    "sensor.rotation": ("roll", "pitch", "yaw"),
}
_COLOURS: Final = LABEL_COLOURS[GROUND], LABEL_COLOURS[SEED]
_TYPING_S: Final = 0.5
"""A text, or the value of a slider that does not act at once, is sent after this long without a change."""
_MOST_UNDONE: Final = 50
_DRAG_S: Final = 8.0
"""Changes of the same parameters within this time count as one, unless a slider was released between them."""
_NOTHING: Final = ("nothing changed",)
"""The only option of `reset` if nothing changed; `reset` stays visible, so that nothing below it moves."""
_HOLD_S: Final = 1.0
"""A control shows what the user set for this long, whatever older snapshots say."""

TITLES: Final = {
    "recording": "Reading the recording",
    "ground": "Ground, more",
    "scan": "Scan voxel",
    "imu": "IMU",
    "map": "Local map",
    "keyframe": "Keyframes",
    "moving": "Moving points",
    "loops": "Loop search",
}
"""Titles of sections whose own names are not suitable."""


@dataclass(frozen=True, slots=True)
class Widget:
    """A widget of a parameter.

    Attributes:
        handle: viser's. shown: converts the parameter's value to the widget's value. meant: computes the parameter's
            new value from the widget's value and the present value.
    """

    handle: Any
    shown: Callable[[Any], Any] = lambda value: value
    meant: Callable[[Any, Any], Any] = lambda shown, _: shown

    def show(self, value: Any) -> None:
        show(self.handle, self.shown(value))


def spoken(leaf: Leaf) -> str:
    """The name of a parameter on labels and buttons."""
    return PRIMARY.get(leaf.path, leaf.name.replace("_", " "))


def label(leaf: Leaf, name: str = "") -> str:
    """Name, unit, and a mark that says when a change takes effect. name: replaces the parameter's own name."""
    name = name or spoken(leaf)
    unit = {"deg": "°"}.get(leaf.unit, leaf.unit)
    return f"{name} ({unit}){MARK[leaf.effect]}" if unit else f"{name}{MARK[leaf.effect]}"


def add_widgets(gui: viser.GuiApi, leaf: Leaf, value: Any) -> list[Widget]:
    """The widgets of a parameter; the first one accepts any value of it, or of a component."""
    text, hint = label(leaf), leaf.help
    if leaf.choices:
        return [Widget(gui.add_dropdown(text, leaf.choices, initial_value=value, hint=hint))]
    if isinstance(leaf.default, bool):
        return [Widget(gui.add_checkbox(text, value, hint=hint))]
    if isinstance(leaf.default, str):
        return [Widget(gui.add_text(text, value, hint=hint))]
    if isinstance(leaf.default, tuple):
        names = enumerate(_COMPONENTS[leaf.path])
        return [widget for index, name in names for widget in _component(gui, leaf, value, index, name)]
    return _number(gui, leaf, value, text)


def _number(gui: viser.GuiApi, leaf: Leaf, value: float, text: str) -> list[Widget]:
    """A slider over the range, or a box with a slider over round values below it."""
    assert leaf.minimum is not None and leaf.maximum is not None and leaf.step is not None
    kind: Any = int if isinstance(leaf.default, int) else float
    handle: Any
    if leaf.maximum - leaf.minimum <= _MOST_STEPS * leaf.step:
        handle = gui.add_slider(text, kind(leaf.minimum), kind(leaf.maximum), kind(leaf.step), value, hint=leaf.help)
    else:
        handle = gui.add_number(text, value, step=leaf.step, hint=leaf.help)  # the engine reports values out of range
    if kind is float:
        handle.precision = _DIGITS
    widgets = [Widget(handle)]
    if isinstance(handle, viser.GuiNumberHandle):
        stops = round_values(leaf)
        # Without a label, so that `viser_adapter.css` hides the slider's own box, which would show an index of `stops`.
        slider = gui.add_slider("", 0, len(stops) - 1, 1, _nearest(stops, value), hint=leaf.help)
        widgets.append(Widget(slider, lambda value: _nearest(stops, value), lambda place, _: stops[place]))
    return widgets


def _component(gui: viser.GuiApi, leaf: Leaf, vector: tuple[float, ...], index: int, name: str) -> list[Widget]:

    def of_vector(one: Widget) -> Widget:
        return Widget(
            one.handle,
            lambda vector: one.shown(vector[index]),
            lambda shown, vector: (*vector[:index], one.meant(shown, vector[index]), *vector[index + 1 :]),
        )

    return [of_vector(one) for one in _number(gui, leaf, vector[index], label(leaf, name))]


def round_values(leaf: Leaf) -> tuple[float, ...]:
    """1, 2 and 5 times the powers of ten within the range, positive and negative, ascending, with zero."""
    assert leaf.minimum is not None and leaf.maximum is not None and leaf.step is not None
    kind = int if isinstance(leaf.default, int) else float
    least = leaf.minimum if leaf.minimum > 0 else leaf.step
    sizes = [float(f"{digit}e{power}") for power in range(-9, 10) for digit in (1, 2, 5)]
    values = [*(-size for size in reversed(sizes)), 0.0, *sizes]
    return tuple(kind(v) for v in values if leaf.minimum <= v <= leaf.maximum and (not v or abs(v) >= least))


def _nearest(ascending: tuple[float, ...], value: float) -> int:
    """Index of the nearest value; halfway between two values, of the smaller one."""
    return int(np.argmin(np.abs(np.subtract(ascending, value))))


class ParameterHistory:
    """The parameters after each change. Dragging a slider is one change, however slowly the page draws it."""

    def __init__(self) -> None:
        self._states: list[Params] = []
        self._at = -1
        self._left: list[Params] = []  # states left by undo and redo that the engine may not know yet
        self._changed: set[str] = set()  # paths, by the last change
        self._changed_at = -_DRAG_S

    def see(self, params: Params, now: float) -> None:
        """Record the present parameters, whatever changed them."""
        if self._at >= 0 and params == self._states[self._at]:
            self._left.clear()
            return
        if params in self._left:
            return
        self._left.clear()
        changed = set(self._states[self._at].changed(params)) if self._states else set()
        merged = self._at > 0 and changed == self._changed and now - self._changed_at < _DRAG_S
        del self._states[self._at + (0 if merged else 1) :]
        self._changed, self._changed_at = changed, now
        if self._states and self._states[-1] == params:  # dragged back to the old value
            self._changed_at = -_DRAG_S
        else:
            self._states = [*self._states, params][-_MOST_UNDONE:]
        self._at = len(self._states) - 1

    def change(self, by: int) -> dict[str, Any]:
        """Values by dotted name that lead to the previous (-1) or next (1) state; empty if there is none."""
        if not 0 <= self._at + by < len(self._states):
            return {}
        return self._states[self._at].changed(self._states[self._at + by])

    def go(self, by: int) -> None:
        self._left.append(self._states[self._at])
        self._at += by
        self.settle()

    def settle(self) -> None:
        """Do not merge the next change with the last one."""
        self._changed_at = -_DRAG_S


class ParameterPanel:
    """A control for every parameter; `draw` sends typed values and shows the snapshot's values."""

    def __init__(self, page: Page, params: Params) -> None:
        gui = self._gui = page.gui
        self._send = page.send
        self._now = page.now
        self._params = params
        self._edits: dict[str, Edit] = {}
        self._source: tuple[object, ...] = (0, None)  # engine and recording whose parameters are shown
        self._widgets: dict[str, list[Widget]] = {}
        self._resets: dict[str, viser.GuiButtonGroupHandle] = {}
        self._sections: dict[str, dict[str, Leaf]] = {}
        for leaf in leaves():
            group = "primary" if leaf.path in PRIMARY else leaf.section
            self._sections.setdefault(group, {})[leaf.name] = leaf
        self._names = {leaf.path: spoken(leaf) for leaf in leaves()}
        self._histories: defaultdict[tuple[object, ...], ParameterHistory] = defaultdict(ParameterHistory)
        self._history = self._histories[self._source]
        self._released = False  # whether a slider was released whose last value may still be on its way
        self._bridge = Bridge(gui, "sliders", lambda *_: setattr(self, "_released", True))
        self._opened = params
        self._recording: Path | None = None
        self._session = -1  # whose scan lines limit the slider of M
        gui.add_html(heading("Ground segmentation"))
        for path in PRIMARY:
            self._add(self._sections["primary"][path.partition(".")[2]])
        self._ground = gui.add_html("")
        self._share_before = float("nan")  # percent of ground in the scan shown before the sliders moved
        self._ground_changes = Changes(page.now, PANEL_PERIOD_S)
        self._controls_due, self._resets_due = Changes(page.now), Changes(page.now)
        # Below the sliders and always there, so that nothing moves under the mouse.
        self._undo = add_button(gui, "Undo", lambda _: self._step(-1), viser.Icon.ARROW_BACK_UP, disabled=True)
        self._redo = add_button(gui, "Redo", lambda _: self._step(1), viser.Icon.ARROW_FORWARD_UP, disabled=True)
        self._add_reset("primary")
        self._pending = gui.add_html("")
        self._restart = add_button(
            gui, "Restart now", lambda _: self._send(Restart()), viser.Icon.REFRESH, color="orange", visible=False
        )
        for section in Params.model_fields:
            with gui.add_folder(TITLES.get(section, section.title()), expand_by_default=False):
                for leaf in self._sections[section].values():
                    self._add(leaf)
                self._add_reset(section)
        gui.add_html(panel("quiet", "▸ applies from the next frame · ↻ applies on restart"))

    def follow(self, a: Snapshot) -> None:
        """Note the values with which A's recording was opened; `reset` restores them, also in a fork."""
        if (recording := a.recording.path.resolve() if a.recording else None) != self._recording:
            self._recording, self._opened = recording, a.params

    def draw(self, snapshot: Snapshot, tuning: bool = False) -> None:
        """Update the controls from a snapshot. tuning: whether the user is moving ground sliders."""
        now = self._now()
        source = engine_number(snapshot), snapshot.recording.path if snapshot.recording else None
        if snapshot.result is not None and snapshot.session != self._session:
            self._session, slider = snapshot.session, self._widgets["ground.scan_lines"][0].handle
            lines = int(snapshot.result.cloud.ring.max(initial=0)) + 1
            slider.max = lines if lines >= slider.value else slider.max
        if source != self._source:  # these edits were for another engine or recording
            self._source, self._history = source, self._histories[source]
            self._edits.clear()
        for path, edit in list(self._edits.items()):
            if not edit.sent and now - edit.at >= _TYPING_S:
                edit.sent = True
                self._send(SetParams({path: edit.value}))
            elif edit.sent and now - edit.at >= _HOLD_S and snapshot.progress is None:
                self._edits.pop(path, None)
        self._params = snapshot.params
        if self._controls_due(snapshot.params, " ".join(self._edits)):
            for path in self._widgets.keys() - self._edits.keys():
                for widget in self._widgets[path]:
                    widget.show(snapshot.params.value(path))
        self._history.see(snapshot.params, now)
        edits = list(self._edits.items())
        if self._released and all(snapshot.params.value(path) == edit.value for path, edit in edits):
            self._released = False
            self._history.settle()
        for button, verb, by in ((self._undo, "Undo", -1), (self._redo, "Redo", 1)):
            names = self._history.change(by)
            button.disabled = not names
            button.label = f"{verb} {', '.join(self._names[name] for name in list(names)[:2])}".strip()
        if self._resets_due(snapshot.params, self._opened):
            self._show_resets(snapshot.params)
        self._show_ground(snapshot, tuning)
        self._restart.visible = bool(snapshot.pending_restart)
        self._pending.content = panel("pending", snapshot.pending_restart) if snapshot.pending_restart else ""

    def _show_ground(self, snapshot: Snapshot, tuning: bool) -> None:
        ground = snapshot.result.ground if snapshot.result is not None else None
        if not tuning:
            self._share_before = 100 * ground.share if ground is not None else float("nan")
        if self._ground_changes(snapshot.result, tuning, at_once=not snapshot.transport.playing):
            share = number(100 * ground.share, 1) if ground is not None else "–"
            seeds = f"{ground.seeds:,}" if ground is not None else "–"
            was = number(self._share_before, 1) if tuning and np.isfinite(self._share_before) else ""
            why = ground.reason if ground is not None and not ground.found else ""
            self._ground.content = panel("ground_now", _COLOURS, share, was, seeds, why)

    def _step(self, by: int) -> None:
        values = self._history.change(by)
        if values:
            self._history.go(by)
            self._edits.clear()
            self._send(SetParams(values))

    def _add(self, leaf: Leaf) -> None:
        path = leaf.path
        self._widgets[path] = widgets = add_widgets(self._gui, leaf, self._params.value(path))
        # The four primary sliders act while they are dragged. The other sliders also have boxes to type into.
        at_once = path in PRIMARY or isinstance(widgets[0].handle, viser.GuiCheckboxHandle | viser.GuiDropdownHandle)

        def set_by(widget: Widget) -> Callable[[Any, viser.ClientHandle], None]:
            def changed(shown: Any, _: viser.ClientHandle) -> None:
                edit = self._edits.get(path)
                value = widget.meant(shown, edit.value if edit is not None else self._params.value(path))
                self._edits[path] = Edit(value, self._now(), sent=at_once)
                for other in widgets:
                    if other is not widget:
                        other.show(value)
                if at_once:
                    self._send(SetParams({path: value}))

            return changed

        for widget in widgets:
            widget.handle.on_update(as_set(set_by(widget)))

    def _add_reset(self, group: str) -> None:
        """A button for each parameter of the group changed since the recording was opened, and one for all of them."""
        buttons = self._gui.add_button_group(
            "reset", _NOTHING, hint="Restore the value from when the recording was opened."
        )
        self._resets[group] = buttons

        def reset(chosen: str, _: viser.ClientHandle) -> None:
            of_group = self._sections[group]
            leafs = [leaf for leaf in of_group.values() if chosen in ("all", spoken(leaf))]
            values = {leaf.path: self._opened.value(leaf.path) for leaf in leafs}
            for path in values:
                self._edits.pop(path, None)
            if values:
                self._send(SetParams(values))

        buttons.on_click(by_user(reset))

    def _show_resets(self, params: Params) -> None:
        for group, buttons in self._resets.items():
            leafs = self._sections[group].values()
            changed = [spoken(leaf) for leaf in leafs if params.value(leaf.path) != self._opened.value(leaf.path)]
            options = (*changed, "all") if len(changed) > 1 else tuple(changed) or _NOTHING
            if buttons.options != options:
                buttons.options = options


def add_yaml_buttons(page: Page, params: Callable[[], Params]) -> None:
    """Buttons that show the parameters as YAML to copy or download, and that load YAML."""
    add_button(page.gui, "Copy as YAML", lambda client: _show_yaml(client, params()), viser.Icon.COPY)
    add_button(page.gui, "Load YAML", lambda client: _load_yaml(client, page), viser.Icon.CLIPBOARD_TEXT)


def _show_yaml(client: viser.ClientHandle, params: Params) -> None:
    text = params.to_yaml()
    with client.gui.add_modal("Parameters as YAML") as modal:
        client.gui.add_html(panel("yaml_out", text, source("copy.js")))
        client.gui.add_text("yaml", text, multiline=True)
        download = client.gui.add_button("Download", icon=viser.Icon.DOWNLOAD)
        close = client.gui.add_button("Close", color="gray")
    download.on_click(lambda _: client.send_file_download("hemislam.params.yaml", text.encode(), save_immediately=True))
    close.on_click(lambda _: modal.close())


def _load_yaml(client: viser.ClientHandle, page: Page) -> None:
    with dialog(client, "Load parameters") as close:
        client.gui.add_html(panel("text", "Paste YAML or choose a file. Parameters it omits return to their defaults."))
        text = client.gui.add_text("yaml", "", multiline=True)
        upload = client.gui.add_upload_button("Choose a file", icon=viser.Icon.UPLOAD, mime_type=".yaml,.yml,text/yaml")
        add_button(client.gui, "Apply", lambda _: applied(), viser.Icon.CHECK, color=None)

    def applied() -> None:
        Params().merged_yaml(text.value)  # refused here, so that the dialog stays
        page.send(LoadParams(text.value))
        close()

    upload.on_upload(lambda _: show(text, upload.value.content.decode("utf-8", errors="replace")))
