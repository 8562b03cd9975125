"""Work of a panel in a process of its own, so that the page stays responsive."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import viser

from app.child import Child, Link
from app.slam.errors import HemislamError
from app.ui.widgets import add_button, show


class Background:
    """One task at a time, with a progress bar and a button that stops it.

    Among the messages of the task, a text says why it failed, and a number is the share that is done.

    Args:
        name, title: as in `Child`. hint: of the button.
    """

    def __init__(self, gui: viser.GuiApi, name: str, title: str, hint: str | None = None) -> None:
        self._name, self._title = name, title
        self._child: Child | None = None
        self._beginning = threading.Lock()
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._stop = add_button(gui, "Stop", lambda _: self.stop(), viser.Icon.PLAYER_STOP, visible=False, hint=hint)

    @property
    def running(self) -> bool:
        return self._child is not None

    def begin(self, main: Callable[..., None], *args: Any) -> None:
        """Begin, unless another page has begun already."""
        with self._beginning:
            if self.running:
                return
            self.show(0.0)
            self._child = Child(_told, main, *args, name=self._name, title=self._title, fork=True, grace_s=0.0)
            self._bar.visible = self._stop.visible = True

    def show(self, share: float) -> None:
        """Show how much is done, 0-1."""
        show(self._bar, 100 * share)

    def messages(self) -> Iterator[Any]:
        """New messages, except shares. There are none once any thread has stopped the work."""
        while (child := self._child) is not None:
            message = child.news()
            if message is None or child is not self._child:
                return
            if isinstance(message, float):
                self.show(message)
            else:
                yield message

    def stop(self) -> None:
        """Stop the work, if there is any."""
        child, self._child = self._child, None
        self._bar.visible = self._stop.visible = False
        if child is not None:
            child.close(0.0)


def _told(owner: Link, main: Callable[..., None], *args: Any) -> None:
    try:
        main(owner, *args)
    except HemislamError as error:
        owner.send(str(error))
