"""The head of the page: which recording is open, and what is going on."""

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import FrameStatus
from app.ui.doctor import verdicts
from app.ui.html import BAD, GOOD, QUIET, WARN, panel


def status(snapshot: Snapshot) -> tuple[str, str]:
    """What is going on, in a word or two, and its colour."""
    transport, result = snapshot.transport, snapshot.result
    if not snapshot.engine_alive:
        return "engine stopped", BAD
    if snapshot.progress is not None:
        return "busy", WARN
    if snapshot.recording is None:
        return "no recording", QUIET
    if result is not None and result.status is FrameStatus.LOST:
        return "lost", BAD
    if transport.finished:
        return "finished", QUIET
    if result is not None and result.status is FrameStatus.INITIALISING:
        return "initialising", WARN
    return ("playing", GOOD) if transport.playing else ("paused", QUIET)


def title(snapshot: Snapshot) -> str:
    """The recording's name, the status, the doctor's verdicts and, before the first frame, what to do."""
    recording = snapshot.recording
    hint = first = ""
    if not snapshot.engine_alive:
        hint = "dead"
    elif recording is None and snapshot.progress is None:
        hint = "none"
    elif recording is not None and snapshot.transport.frame < 0 and snapshot.progress is None:
        first = "live" if snapshot.live is not None and snapshot.transport.playing else "file"
    name = recording.path.name if recording else "hemislam"
    return panel("header", name, *status(snapshot), hint, verdicts(recording.findings if recording else ()), first)


class HeaderPanel:
    """Title, status and, during long work, what it is and how far it got."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._title = gui.add_html("")
        self._work = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the snapshot's recording, status and progress."""
        self._title.content = title(snapshot)
        progress = snapshot.progress
        self._work.visible = self._bar.visible = progress is not None
        if progress is not None:
            known = bool(np.isfinite(progress.fraction))
            percent = 100 * min(max(progress.fraction, 0.0), 1.0) if known else 100.0
            self._work.content = panel("text", progress.title + (f" · {percent:.0f} %" if known else " …"))
            self._bar.value = percent  # type: ignore[misc]  # mypy overlooks viser's setter
