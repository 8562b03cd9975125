"""How every process of the program logs, to stderr: sentences for people, or one JSON object a line for machines."""

import contextlib
import json
import logging
import os
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, Final

_OWN: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "taskName"}
_VARIABLE: Final = "HEMISLAM_LOG_JSON"
"""Environment variable by which child processes log in the same format."""

log = logging.getLogger(__name__)


class JsonLines(logging.Formatter):
    """Writes time (UTC), level, process, logger, message, `extra` and, if there is one, the traceback."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: value for name, value in vars(record).items() if name not in _OWN}
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


class AtMost(logging.Filter):
    """Lets a few warnings of one kind through each minute, so that nobody can fill the log from outside."""

    PER_MINUTE: Final = 5

    def __init__(self) -> None:
        super().__init__()
        self._counts: Counter[tuple[str, str]] = Counter()
        self._minute = 0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        minute = int(record.created // 60)
        if minute != self._minute:
            self._minute = minute
            self._counts.clear()
        kind = (record.name, str(record.msg))
        self._counts[kind] += 1
        if self._counts[kind] == self.PER_MINUTE:
            record.msg = f"{record.msg} (more of these within this minute are not logged)"
        return self._counts[kind] <= self.PER_MINUTE


def start_logging(*, json_lines: bool) -> None:
    """Log this process, the server: everything as JSON, or only warnings as sentences."""
    os.environ[_VARIABLE] = "1" if json_lines else "0"
    _log_to_stderr("server", json_lines)


@contextlib.contextmanager
def process_logs(process: str) -> Iterator[None]:
    """Log this child process as its owner logs. An exception that ends it is the last thing logged."""
    _log_to_stderr(process, os.environ.get(_VARIABLE) == "1")
    try:
        yield
    except Exception as error:
        log.critical("The process ends: %s: %s", type(error).__name__, error, exc_info=error)
        sys.exit(1)


def _log_to_stderr(process: str, json_lines: bool) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines(process) if json_lines else logging.Formatter("hemislam: %(message)s"))
    handler.addFilter(AtMost())
    own = logging.getLogger("app")
    own.handlers = [handler]
    own.setLevel(logging.INFO if json_lines else logging.WARNING)
    own.propagate = False
    logging.getLogger().handlers = [handler]  # of the libraries: warnings
    if json_lines:
        logging.captureWarnings(True)
        threading.excepthook = _thread_ended


def _thread_ended(ended: threading.ExceptHookArgs) -> None:
    if ended.exc_value is not None and not isinstance(ended.exc_value, SystemExit):
        name = ended.thread.name if ended.thread else "?"
        log.error("The thread %s ends: %s", name, ended.exc_value, exc_info=ended.exc_value)
