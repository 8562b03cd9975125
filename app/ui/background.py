"""Work of a panel in a process of its own, so that the page stays quick."""

from collections.abc import Callable, Iterator
from typing import Any

from app.child import Child, Link
from app.slam.errors import HemislamError


class Background:
    """One piece of work at a time. A text among its messages says why it failed. name, title: as in `Child`."""

    def __init__(self, name: str, title: str) -> None:
        self._name, self._title = name, title
        self._child: Child | None = None

    @property
    def running(self) -> bool:
        return self._child is not None

    def begin(self, main: Callable[..., None], *args: Any) -> None:
        self._child = Child(_told, main, *args, name=self._name, title=self._title, fork=True, grace_s=0.0)

    def messages(self) -> Iterator[Any]:
        """Those that have come; no more once the work was stopped, by whatever thread."""
        while (child := self._child) is not None:
            message = child.news()
            if message is None or child is not self._child:
                return
            yield message

    def stop(self) -> None:
        """End the work, if there is any."""
        child, self._child = self._child, None
        if child is not None:
            child.close(0.0)


def _told(owner: Link, main: Callable[..., None], *args: Any) -> None:
    try:
        main(owner, *args)
    except HemislamError as error:
        owner.send(str(error))
