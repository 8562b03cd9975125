"""Why did it drift: strips of what was measured at every frame of the recording; a click goes there."""

import json
from typing import Any, Final

from app.server.protocol import Seek, Snapshot
from app.ui.html import BAD, GOOD, QUIET, panel, source
from app.ui.strips import History, limits, message
from app.ui.viser_adapter import Bridge
from app.ui.widgets import Page, unchanged

_PERIOD_S: Final = 0.5
_WIDE_FROM_PX: Final = 700
"""Where the scene is at least this wide, the strips lie along its lower edge; else under the transport."""


class TimelinePanel:
    """The strips in the caller's container."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._history = History()
        self._drawn: tuple[Any, ...] = ()
        self._latest: Snapshot | None = None
        self._drawn_at = -1e9
        self._bridge = Bridge(gui, "timeline", lambda word, _: self._asked(word))
        colours = {"bad": BAD, "good": GOOD, "quiet": QUIET}
        gui.add_html(self._bridge.live(panel("timeline", colours, _WIDE_FROM_PX, source("timeline.js"))))
        self._data = gui.add_html(panel("timeline_data", ""))
        gui.add_command("Go to the next problem", hotkey="N").on_trigger(lambda _: self._jump(1))
        gui.add_command("Go to the previous problem", hotkey="B").on_trigger(lambda _: self._jump(-1))

    def draw(self, snapshot: Snapshot) -> None:
        """Called often; sends what changed, at most twice a second."""
        now, latest = self._page.now(), self._latest
        if latest is not None and snapshot.transport.frame < latest.transport.frame:
            self._history.see(latest)  # the last frames before going back
        self._latest = snapshot
        shown = (snapshot.result, snapshot.loops.edges, snapshot.notes, snapshot.recording, snapshot.params.imu)
        if now - self._drawn_at < _PERIOD_S or unchanged(self._drawn, shown):
            return
        self._drawn, self._drawn_at = shown, now
        self._history.see(snapshot)
        text = json.dumps(message(self._history, snapshot), separators=(",", ":")) if snapshot.result else ""
        self._data.content = panel("timeline_data", text)

    def _asked(self, word: str) -> None:
        """What the page's script sends: "seek 812"."""
        verb, _, frame = word.partition(" ")
        if verb == "seek" and frame.isdecimal():
            self._page.send(Seek(int(frame)))

    def _jump(self, by: int) -> None:
        """To the next frame, or the one before, at which a problem begins."""
        snapshot = self._page.snapshot()
        here, frames = snapshot.transport.frame, self._history.troubles(limits(snapshot))
        there = next((frame for frame in frames[::by] if (frame - here) * by > 0), None)
        if there is not None:
            self._page.send(Seek(there))
