"""The engine's notices: a notification in every browser, and a log for those that connect later."""

from typing import Final, Literal

import viser

from app.server.protocol import Notice, Snapshot
from app.ui.html import BAD, QUIET, WARN, panel

_LOG_LINES: Final = 20
_BORDER: Final = {"info": QUIET, "warning": WARN, "error": BAD}
_TITLE: Final = {"info": "Note", "warning": "Warning", "error": "Error"}
_COLOUR: Final[dict[str, Literal["blue", "yellow", "red"]]] = {"info": "blue", "warning": "yellow", "error": "red"}
_SECONDS: Final = {"info": 6.0, "warning": 12.0, "error": None}
"""An error stays until it is closed."""


def log_html(notices: tuple[Notice, ...]) -> str:
    """The newest notices, newest first."""
    return panel("log", [(notice.text, _BORDER[notice.level]) for notice in reversed(notices[-_LOG_LINES:])])


class NoticePanel:
    """The log in the caller's container."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._log = server.gui.add_html(log_html(()))
        self._told: set[int] = set()

    def draw(self, snapshot: Snapshot) -> None:
        """Notify every browser of what is new since the call before."""
        new = [notice for notice in snapshot.notices if notice.number not in self._told]
        if not new:
            return
        self._told |= {notice.number for notice in new}
        self._log.content = log_html(snapshot.notices)
        for client in self._server.get_clients().values():
            for notice in new:
                client.add_notification(
                    _TITLE[notice.level],
                    notice.text,
                    color=_COLOUR[notice.level],
                    auto_close_seconds=_SECONDS[notice.level],
                )
