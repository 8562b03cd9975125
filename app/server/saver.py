"""Writes results beside the frame loop, one save after the other."""

import logging
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from app.server.protocol import Saved
from app.slam.errors import HemislamError

log = logging.getLogger(__name__)


class Saver:
    """A queue of saves and the thread that works on it."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="save")
        self._under_way: deque[tuple[Path, Future[None]]] = deque()

    @property
    def busy(self) -> bool:
        return bool(self._under_way)

    def start(self, folder: Path, save: Callable[[], None]) -> None:
        self._under_way.append((folder, self._thread.submit(save)))

    def ended(self) -> Saved | None:
        """The next save that has ended, once each, or None."""
        if not self._under_way or not self._under_way[0][1].done():
            return None
        folder, future = self._under_way.popleft()
        error = future.exception()
        if error is None:
            return Saved(folder)
        if not isinstance(error, HemislamError):
            log.error("Saving to %s failed", folder, exc_info=error)
        return Saved(folder, str(error) or type(error).__name__)

    def wait(self) -> None:
        """Until no save is under way: what they read may be closed then."""
        for _, future in self._under_way:
            future.exception()

    def close(self) -> None:
        self._thread.shutdown(wait=True)
