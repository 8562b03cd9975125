"""The little that every panel needs from viser's widgets."""

from collections.abc import Callable
from typing import Any

import viser


def show(control: Any, value: Any) -> None:
    """Make a control show `value`. Its callbacks fire with `client=None`; `by_user` leaves those out."""
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
