"""The little that every panel needs from viser's widgets."""

from collections.abc import Callable, Coroutine
from typing import Any

import viser


def show(control: Any, value: Any) -> None:
    """Make a control show `value`. Its callbacks fire with `client=None`; `by_user` leaves those out."""
    if control.value != value:
        control.value = value


def unchanged(before: tuple[object, ...], now: tuple[object, ...]) -> bool:
    """Whether all parts are the same objects still: what has not changed is not made anew from snapshot to snapshot."""
    return len(before) == len(now) and all(a is b for a, b in zip(before, now, strict=True))


def same(before: tuple[object, ...], now: tuple[object, ...], objects: int) -> bool:
    """Whether the first so many parts are the same objects still, and the others equal."""
    return unchanged(before[:objects], now[:objects]) and before[objects:] == now[objects:]


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
    """As `by_user`, for controls that code sets as well. `act` must only note or enqueue: the page's server waits.

    viser calls this back the moment it has taken the new value in, and not by way of its threads. On that
    way a snapshot's older value may be shown over the new one, and it is the older that would be read.
    """

    async def callback(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            act(event.target.value, event.client)

    return callback
