"""What the server logs, on stderr: for people, or one JSON object a line for machines that collect."""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Any, Final

from app.server.fork import Engine

_LEVEL: Final = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}
_OWN: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "taskName"}

log = logging.getLogger(__name__)


class JsonLines(logging.Formatter):
    """time (UTC), level, logger, message, `extra` and, if there is one, the traceback."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: value for name, value in vars(record).items() if name not in _OWN}
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


def start_logging(*, json_lines: bool) -> None:
    """Log this process to stderr; as JSON everything, else what is a warning."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if json_lines else logging.Formatter("hemislam: %(message)s"))
    root = logging.getLogger("app")
    root.handlers = [handler]
    root.setLevel(logging.INFO if json_lines else logging.WARNING)
    root.propagate = False
    if json_lines:
        logging.getLogger().handlers = [handler]
    else:
        log.setLevel(logging.CRITICAL)  # people read the engine's notices in the page


def log_notices(engine: Engine) -> None:
    """For ever: what the engine tells the page is logged too, as news. For a thread."""
    told: set[int] = set()
    revision = -1
    while True:
        snapshot = engine.wait(revision, 1.0)
        revision = snapshot.revision
        for notice in snapshot.notices:
            if notice.number not in told:
                told.add(notice.number)
                frame = snapshot.transport.frame
                log.log(_LEVEL[notice.level], notice.text, extra={"notice": notice.number, "frame": frame})
