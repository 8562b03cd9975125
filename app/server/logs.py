"""The engine's notices in the server's log."""

import logging
from typing import Final

from app.server.worker import RunningEngine

_LEVEL: Final = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}

log = logging.getLogger(__name__)


def log_notices(engine: RunningEngine) -> None:
    """Log the notices that the engine publishes, without end. For a thread of its own."""
    if not log.isEnabledFor(logging.INFO):
        return  # people read them on the page
    logged: set[int] = set()
    revision = -1
    while True:
        snapshot = engine.wait(revision, 1.0)
        revision = snapshot.revision
        for notice in snapshot.notices:
            if notice.number not in logged:
                logged.add(notice.number)
                frame = snapshot.transport.frame
                log.log(_LEVEL[notice.level], notice.text, extra={"notice": notice.number, "frame": frame})
