"""The head of the page: which recording, what is going on, and what one can do."""

from html import escape
from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import FrameStatus
from app.ui.doctor import verdicts
from app.ui.html import BAD, GOOD, QUIET, WARN, box, chip, heading, key

HELP: Final = (
    heading("What to do here")
    + box(
        "<b>Replay</b> a recording and watch the map grow. <b>Tune</b> M, α, σ and the voxel size while it plays "
        "or is paused: the frame you see is labelled anew at once, the engine uses the values from the next frame on. "
        "<b>Read</b> on the left how well ground and motion are found."
    )
    + heading("Why did it drift")
    + box(
        "The strips show every frame of the recording: hover to read, click or drag to go there. Red is beyond what is "
        "good; what you went back over stays, paler. The white line is the present frame. "
        "<b>Pause when</b> stops playing where a condition begins to hold; Play goes on from there."
    )
    + heading("One frame under study")
    + box(
        "Pause, and under <b>Study</b> colour the scan by ring, angle to down, distance to the ground plane, or by how "
        "far its points lie from the map's planes. Click a point to see its numbers, its neighbours and their plane "
        "(pink) and the map's plane nearby (blue); click beside it to end that. <b>PLY</b> and <b>PCD</b> hold the "
        "frame with all its points carry, and these numbers."
    )
    + heading("Loops")
    + box(
        "Where the walk comes back, a <b>loop</b> ties two keyframes together and straightens the map. Arches show "
        "them: green counts, amber waits for others that agree, red was turned down, violet is your word. Of loops "
        "next to one another the thick one is in the graph for all. Click an arch, or a row under <b>Loops</b> on the "
        "left, to see both submaps (blue the older, orange the newer) and why it was judged so. <b>Accept</b>, "
        "<b>reject</b>, weigh or add one: a pale ghost shows the walk as it would become, then commit or cancel. Every "
        "word can be undone; <b>Save edits</b> keeps them for <code>hemislam run --loops</code>."
    )
    + heading("Two settings side by side")
    + box(
        "<b>Fork here</b> under <b>A/B</b> on the left goes on from this frame twice: A (pink) as it is, and B "
        "(blue) with what you then set under Tune, where <b>act on</b> says whose parameters you see. B goes where A "
        "goes, and pauses where A does; the scan tells who calls a point ground. <b>Swap</b> shows B whole; "
        "<b>keep</b> leaves a session file that can be opened again. B is a second engine: it doubles memory and "
        "work, and first has to come to this frame by itself."
    )
    + heading("Live")
    + box(
        "With <code>serve --live</code> the map is made of what a sensor sends. Scans are taken as they come, so there "
        "is no slider and no speed; <b>Pause</b> lets them wait, and when too many do, the oldest are dropped, as the "
        "strips show. <b>Recording</b> on the left tells rates, losses and clocks. To go back, open what "
        "<code>--record</code> wrote."
    )
    + heading("Keys")
    + box(
        f"{key('space')} play or pause<br>{key('←')} {key('→')} one frame back or on<br>"
        f"{key('F')} follow the sensor or look freely<br>{key('C')} next colouring<br>"
        f"{key('N')} {key('B')} next trouble on the strips, or the one before<br>"
        f"{key('V')} next colouring of the frame under study<br>"
        f"{key('J')} {key('K')} next or previous loop<br>"
        f"{key('X')} swap A and B {key('T')} tune A or B<br>"
        f"{key('Ctrl')} {key('Z')} undo your word on a loop, with {key('Shift')} redo<br>"
        f"{key('Ctrl')} {key('K')} all commands"
    )
    + heading("Mouse")
    + box("left drag: orbit · right drag: move · wheel: zoom<br>W A S D Q E: fly")
    + heading("Colours")
    + box(
        "The amber wedge is where seeds are looked for: within α of straight down, on the M outermost scan lines. "
        "The teal disc is the plane they gave; points nearer to it than σ · range are ground."
    )
)

_WELCOME: Final = (
    "Press <b>Play</b> or " + key("space") + " to map it; " + key("→") + " goes one frame. Then move the sliders below."
)
_WAITS: Final = "Mapping begins with the first scan, as soon as IMU samples have come for it."


def status(snapshot: Snapshot) -> tuple[str, str]:
    """What is going on in a word or two, and its colour."""
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
    text, colour = status(snapshot)
    recording = snapshot.recording
    name = escape(recording.path.name) if recording else "hemislam"
    parts = [f'<div class="hs-row"><span class="hs-title">{name}</span>{chip(text, colour)}</div>']
    if not snapshot.engine_alive:
        parts.append("The engine's process has ended; it is started again.")
    elif recording is None and snapshot.progress is None:
        parts.append("Maps what a handheld hemispherical LiDAR saw. Open a recording under <b>Files</b> below.")
    elif recording is not None:
        parts.append(f"<div>{verdicts(recording.findings)}</div>")
        if snapshot.transport.frame < 0 and snapshot.progress is None:
            words = _WAITS if snapshot.live is not None and snapshot.transport.playing else _WELCOME
            parts.append(f'<div style="margin-top:6px">{words}</div>')
    return box(*parts)


class HeaderPanel:
    """Title, status and, while something takes long, what that is and how far it got."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._title = gui.add_html("")
        self._work = gui.add_html("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)

    def draw(self, snapshot: Snapshot) -> None:
        self._title.content = title(snapshot)
        progress = snapshot.progress
        self._work.visible = self._bar.visible = progress is not None
        if progress is not None:
            known = bool(np.isfinite(progress.fraction))
            percent = 100 * min(max(progress.fraction, 0.0), 1.0) if known else 100.0
            self._work.content = box(escape(progress.title) + (f" · {percent:.0f} %" if known else " …"))
            self._bar.value = percent  # type: ignore[misc]  # mypy overlooks viser's setter
