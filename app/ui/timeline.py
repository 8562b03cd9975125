"""Why did it drift: strips of what was measured at every frame of the recording; a click goes there."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import viser

from app.server.protocol import Command, Seek, Snapshot
from app.ui.loops.bridge import Bridge
from app.ui.strips import History, limits, message
from app.ui.timeline_script import STYLE, data, shell

_PERIOD_S: Final = 0.5


class TimelinePanel:
    """The strips in the caller's container.

    Args:
        send: enqueues a command. snapshot: the newest one. now: monotonic seconds.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        send: Callable[[Command], None],
        snapshot: Callable[[], Snapshot],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._send = send
        self._snapshot = snapshot
        self._now = now
        self._history = History()
        self._drawn: Snapshot | None = None
        self._latest: Snapshot | None = None
        self._drawn_at = -1e9
        self._bridge = Bridge(gui, lambda word, _: self._said(word))
        gui.add_html(STYLE + self._bridge.live(shell()))
        self._data = gui.add_html(data(""))
        gui.add_command("Go to the next trouble", hotkey="N").on_trigger(lambda _: self._jump(1))
        gui.add_command("Go to the trouble before", hotkey="B").on_trigger(lambda _: self._jump(-1))

    def draw(self, snapshot: Snapshot) -> None:
        """Called often; sends what changed, at most twice a second."""
        now, drawn, latest = self._now(), self._drawn, self._latest
        if latest is not None and snapshot.transport.frame < latest.transport.frame:
            self._history.see(latest)  # the last frames before going back
        self._latest = snapshot
        if now - self._drawn_at < _PERIOD_S or (drawn is not None and not _differs(drawn, snapshot)):
            return
        self._drawn = replace(snapshot, trajectory=None, keyframe_poses=None, chunks=())  # large, and not compared
        self._drawn_at = now
        self._history.see(snapshot)
        if snapshot.result is None:
            self._data.content = data("")
        else:
            self._data.content = data(json.dumps(message(self._history, snapshot), separators=(",", ":")))

    def _said(self, word: str) -> None:
        """What the page's script says: "seek 812"."""
        verb, _, frame = word.partition(" ")
        if verb == "seek" and frame.isdecimal():
            self._send(Seek(int(frame)))

    def _jump(self, by: int) -> None:
        """To the next frame on, or back, where something begins to be bad."""
        snapshot = self._snapshot()
        here, frames = snapshot.transport.frame, self._history.troubles(limits(snapshot))
        there = next((frame for frame in frames[::by] if (frame - here) * by > 0), None)
        if there is not None:
            self._send(Seek(there))


def _differs(drawn: Snapshot, current: Snapshot) -> bool:
    """Whether there is anything else to draw."""
    return (
        drawn.result is not current.result
        or drawn.loops.edges is not current.loops.edges
        or drawn.notes != current.notes
        or drawn.recording is not current.recording
        or drawn.params.imu != current.params.imu
    )
