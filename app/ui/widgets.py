"""Shared by all panels: the page, the view, and helpers for viser's widgets."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, TypeVar

import numpy as np
import viser

from app.export.box import Box
from app.server.protocol import Command, Snapshot
from app.slam import lie
from app.slam.errors import HemislamError, refusal
from app.slam.types import F64
from app.ui.colours import LOOK, Limits
from app.ui.map_numbers import MapNumbers

SCENE_PERIOD_S: Final = 1 / 15
PANEL_PERIOD_S: Final = 1 / 4
"""Least periods between two drawings of the scene and of the panels."""
ROOT: Final = "/map"
"""Scene node of the map: the parent of everything in the map's frame. It moves while the sensor is followed."""


_STANDING_BACK: Final = 0.35
"""Size of the map's points while parameters are tuned, as a share of the usual size."""


@dataclass(frozen=True, slots=True)
class View:
    """How the session is displayed: the same in every browser, unknown to the engine.

    Attributes:
        colour_by: a name of `app.ui.colours.COLOUR_BY`. point_size: m. follow: keep the sensor in the middle.
        ceilings, moving: show ceilings, and points on moving objects.
        map, scan, wedge, plane, path, grid, notes: whether shown.
        light: a light background. tuning: the map is dimmed behind the present scan, which shows its labels.
        ends: of the colour map, if the user chose them. clip: points outside this box are hidden.
        slab: m, width of the profile along the walk that is shown instead of the map; 0: no profile.
        numbers: the points' numbers that `colour_by` shows, if these depend on the whole map.
    """

    colour_by: str = LOOK
    point_size: float = 0.04
    follow: bool = False
    ceilings: bool = False
    moving: bool = False
    map: bool = True
    scan: bool = True
    wedge: bool = True
    plane: bool = True
    path: bool = True
    grid: bool = True
    notes: bool = True
    light: bool = False
    tuning: bool = False
    ends: Limits | None = None
    clip: Box | None = None
    slab: float = 0.0
    numbers: MapNumbers | None = None

    @property
    def map_point_size(self) -> float:
        return self.point_size * (_STANDING_BACK if self.tuning else 1.0)


@dataclass(frozen=True, slots=True)
class Page:
    """The page to which a panel belongs.

    Attributes:
        send: enqueues a command for the engine. snapshot: the newest one. now: monotonic seconds.
        offset: (3,) m, position of the map's origin in the scene.
    """

    server: viser.ViserServer
    send: Callable[[Command], None]
    snapshot: Callable[[], Snapshot]
    now: Callable[[], float] = time.monotonic
    offset: Callable[[], F64] = lambda: np.zeros(3)

    @property
    def gui(self) -> viser.GuiApi:
        return self.server.gui

    @property
    def scene(self) -> viser.SceneApi:
        return self.server.scene

    def in_map(self, event: viser.SceneClickEvent) -> tuple[F64, F64]:
        """A click's ray in the map: origin and direction, (3,) each."""
        return np.array(event.ray_origin) - self.offset(), np.array(event.ray_direction)

    def in_picture(self, client: viser.ClientHandle, points: F64) -> F64:
        """(n, 2) positions of (n, 3) points of the map in a browser's picture, 0-1 from its top left.

        NaN for points behind the camera.
        """
        camera = client.camera
        w, x, y, z = (float(value) for value in camera.wxyz)
        seen = (points + self.offset() - np.asarray(camera.position)) @ lie.matrix(np.array([x, y, z, w]))
        depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan) * np.tan(camera.fov / 2)
        return np.asarray(seen[:, :2] / np.stack((depth * camera.aspect, depth), axis=1) / 2 + 0.5)

    def notify_error(self, error: object) -> None:
        """Show every browser why something failed."""
        for client in self.server.get_clients().values():
            notify_error(client, error)


Callback = Callable[[viser.GuiEvent[Any]], Coroutine[Any, Any, None]]
_THREADS: Final = ThreadPoolExecutor(32, "page")
"""Threads that run callbacks, as many as viser has. Some wait minutes for pictures."""
_NumberBox = TypeVar("_NumberBox", bound=viser.GuiNumberHandle[Any] | viser.GuiVector3Handle)
_RANGE: Final[Any] = {"min": {"pad": 0.1, "soft": 0.0, "mode": 3}, "max": {"pad": 0.1, "soft": 0.01, "mode": 1}}
"""Of a chart's values: uPlot's default, but up to 0.01 at least, since ticks have at most three decimals."""
_PLAIN: Final = (str, int, float, Enum, frozenset, View, Limits)


class Changes:
    """Decides whether to draw again: if the inputs differ from the last time, and a period has passed.

    Inputs are compared by identity, since unchanged parts of a snapshot are the same objects in the next one; texts and
    numbers are compared by value.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic, period_s: float = 0.0) -> None:
        self._now, self._period = now, period_s
        self._drawn: tuple[object, ...] = ()
        self._at = -1e9

    def __call__(self, *parts: object, at_once: bool = False) -> bool:
        """Whether to draw `parts` now. at_once: do not wait for the period."""
        now, drawn = self._now(), self._drawn
        if not at_once and now - self._at < self._period:
            return False
        if len(drawn) == len(parts) and all(map(_same, drawn, parts)):
            return False
        self._drawn, self._at = parts, now
        return True


@dataclass(slots=True)
class Edit:
    """A value that a user set, its time, and whether it was sent to the engine. Older snapshots must not undo it."""

    value: Any
    at: float
    sent: bool = False


def _same(before: object, now: object) -> bool:
    return before is now or (isinstance(before, _PLAIN) and before == now)


def show(control: Any, value: Any) -> None:
    """Make a control show `value`. If that is new, its callbacks run with `client=None`; `by_user` ignores those.

    mypy overlooks viser's setter.
    """
    control.value = value


def limited(box: _NumberBox) -> _NumberBox:
    """A number box that enforces its limits: a typed value beyond a limit becomes the limit.

    viser applies the limits only to the arrows. Its event loop waits for this callback before it calls later ones.
    """
    low, high = (-np.inf if box.min is None else box.min), (np.inf if box.max is None else box.max)

    async def keep_within(_: object) -> None:
        show(box, np.clip(box.value, low, high))

    box.on_update(keep_within)
    return box


def choose_next(dropdown: viser.GuiDropdownHandle[str]) -> None:
    """Choose the next option; after the last one, the first."""
    options = dropdown.options
    show(dropdown, options[(options.index(dropdown.value) + 1) % len(options)])


@contextmanager
def dialog(client: viser.ClientHandle, title: str) -> Iterator[Callable[[], None]]:
    """A dialog in one browser, filled by the caller, with a Cancel button at the end; yields a function to close it."""
    with client.gui.add_modal(title) as modal:
        yield modal.close
        cancel = client.gui.add_button("Cancel", color="gray")
    cancel.on_click(lambda _: modal.close())


def ask_text(
    client: viser.ClientHandle, title: str, label: str, text: str, confirm: str, act: Callable[[str], None]
) -> None:
    """A dialog in one browser with a text to edit. If `act` raises HemislamError, it is shown and the dialog stays.

    Args:
        label: of the field. text: its initial content. confirm: label of the button that calls `act` with the text.
    """

    def confirmed(_: viser.ClientHandle) -> None:
        act(field.value)
        close()

    with dialog(client, title) as close:
        field = client.gui.add_text(label, text)
        add_button(client.gui, confirm, confirmed, viser.Icon.CHECK, color=None)


def notify_error(client: viser.ClientHandle, error: object) -> None:
    """Show one browser why something was refused, until the notification is closed."""
    client.add_notification("Error", str(error), color="red", auto_close_seconds=None)


def by_user(act: Callable[[Any, viser.ClientHandle], None]) -> Callback:
    """Calls `act` in a thread with the new value and the browser, but only if a user changed the value.

    A HemislamError or OSError from `act` is shown in that browser. viser also calls back when code sets a value; if
    those calls were passed on, the page and the engine would answer each other for ever.

    viser calls a coroutine as soon as it receives the value, but a plain function later, from a thread. By then the
    control may hold another value, which would be mistaken for the one that was set.
    """

    def tried(value: Any, client: viser.ClientHandle) -> None:
        try:
            act(value, client)
        except HemislamError as error:
            notify_error(client, error)
        except OSError as error:
            notify_error(client, refusal(error))

    async def callback(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            loop = asyncio.get_running_loop()
            await loop.run_in_executor(_THREADS, tried, event.target.value, event.client)

    return callback


def add_button(
    gui: viser.GuiApi,
    text: str,
    act: Callable[[viser.ClientHandle], None],
    icon: viser.IconName | None = None,
    **options: Any,
) -> viser.GuiButtonHandle:
    """A button that calls `act` with the browser in which it is clicked; see `by_user`.

    It is gray by default; `color=None` is the theme's colour.
    """
    button = gui.add_button(text, icon=icon, **({"color": "gray"} | options))
    button.on_click(by_user(lambda _, client: act(client)))
    return button


def add_command(gui: viser.GuiApi, text: str, act: Callable[[viser.ClientHandle], None], **key: Any) -> None:
    """A command in the page's list, and its key; `act` is called with the browser that used it.

    A HemislamError from `act`, which means that there is nothing to do, is shown there for a while.
    """

    def given(event: viser.CommandEvent) -> None:
        if event.client is not None:
            try:
                act(event.client)
            except HemislamError as error:
                event.client.add_notification("Note", str(error), auto_close_seconds=6.0)

    gui.add_command(text, **key).on_trigger(given)


def as_set(act: Callable[[Any, viser.ClientHandle], None]) -> Callback:
    """As `by_user`, but at once, in viser's event loop: for controls that code also sets, or if `act` reads others.

    `act` must only store or enqueue something, since viser's event loop waits for it.
    """

    async def callback(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            act(event.target.value, event.client)

    return callback


def chart(gui: viser.GuiApi, lines: list[dict[str, Any]], height: int = 110) -> viser.GuiUplotHandle:
    """A small chart, still without data. lines: uPlot's series except the first one, over which they are drawn."""
    axes: Any = tuple({"font": "10px sans-serif", "ticks": {"size": 3}, "gap": 2, "size": size} for size in (22, 38))
    series: Any = ({"label": "x"}, *({"points": {"show": False}} | line for line in lines))
    return gui.add_uplot(
        (np.zeros(1),) * len(series), series, axes=axes, legend={"show": False},
        scales={"x": {"time": False}, "y": {"range": _RANGE}},
        cursor={"show": False}, height=height, padding=(6, 10, 0, 0),
    )  # fmt: skip
