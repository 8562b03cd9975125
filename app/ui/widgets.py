"""What every panel needs: the page it is on, and helpers for viser's widgets."""

import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import numpy as np
import viser

from app.server.protocol import Command, Snapshot
from app.slam.types import F64

ROOT: Final = "/map"
"""Scene node of the map. It is moved while the sensor is followed; everything in the map's frame hangs below it."""


@dataclass(frozen=True, slots=True)
class Page:
    """The page that a panel is part of.

    Attributes:
        send: enqueues a command for the engine. snapshot: the newest one. now: monotonic seconds.
        offset: (3,) m, where the map's origin is in the scene.
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


def poses_of(snapshot: Snapshot) -> F64:
    """(k, 4, 4) T_map_imu of the keyframes."""
    return snapshot.keyframe_poses if snapshot.keyframe_poses is not None else np.empty((0, 4, 4))


_PLAIN: Final = (str, int, float, Enum, frozenset)


def unchanged(before: tuple[object, ...], now: tuple[object, ...]) -> bool:
    """Whether all parts are still the same objects, or equal words and numbers.

    Parts of a snapshot that did not change are the same objects in the next one.
    """
    return len(before) == len(now) and all(
        a is b or (isinstance(a, _PLAIN) and a == b) for a, b in zip(before, now, strict=True)
    )


def show(control: Any, value: Any) -> None:
    """Make a control show `value`. Its callbacks then run with `client=None`; `by_user` ignores those."""
    if control.value != value:
        control.value = value


def by_user(act: Callable[[Any, viser.ClientHandle], None]) -> Callable[[viser.GuiEvent[Any]], None]:
    """A callback that is called with the new value and the browser, and only when a person changed it.

    viser also calls back when code sets a value. Sending those on would make the page and the engine
    answer each other for ever.
    """

    def callback(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            act(event.target.value, event.client)

    return callback


def as_set(
    act: Callable[[Any, viser.ClientHandle], None],
) -> Callable[[viser.GuiEvent[Any]], Coroutine[Any, Any, None]]:
    """As `by_user`, for controls that code sets too. `act` must only note or enqueue: viser's event loop waits for it.

    viser calls a coroutine the moment it receives the value, but a plain function later, from a thread. By then a
    snapshot's older value may be in the control, and that would be read.
    """

    async def callback(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            act(event.target.value, event.client)

    return callback


def chart(
    gui: viser.GuiApi, data: tuple[F64, ...], lines: list[dict[str, Any]], height: int = 110, **options: Any
) -> viser.GuiUplotHandle:
    """A small chart over `data[0]`. lines: uPlot's series, without the first one."""
    axes: Any = tuple({"font": "10px sans-serif", "ticks": {"size": 3}, "gap": 2, "size": size} for size in (22, 38))
    settings: dict[str, Any] = {"scales": {"x": {"time": False}}, "cursor": {"show": False}} | options
    series: Any = ({"label": "x"}, *({"points": {"show": False}} | line for line in lines))
    return gui.add_uplot(
        data, series, axes=axes, legend={"show": False}, height=height, padding=(6, 10, 0, 0), **settings
    )
