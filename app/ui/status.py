"""The head of the page, the recording doctor's findings, and the engine's notices."""

import shlex
from typing import Final, Literal

import viser

from app.sensors.doctor import Finding
from app.sensors.presets import PRESETS
from app.server.protocol import Notice, Restart, SetParams, Snapshot
from app.slam.errors import HemislamError
from app.slam.params import Params, leaves
from app.slam.types import FrameStatus
from app.ui.html import BAD, GOOD, QUIET, WARN, heading, panel
from app.ui.viser_adapter import Bridge
from app.ui.widgets import Changes, Page

_LOG_LINES: Final = 20
_LOOKS: Final = {"fine": ("✓ fine", GOOD), "corrected": ("↻ corrected", WARN), "needs you": ("! needs attention", BAD)}
_LEVELS: Final[dict[str, tuple[str, str, Literal["blue", "yellow", "red"], float | None]]] = {
    "info": ("Note", QUIET, "blue", 6.0),
    "warning": ("Warning", WARN, "yellow", 12.0),
    "error": ("Error", BAD, "red", None),
}
"""Title, colour in the log, colour of the notification, and seconds until it closes. An error stays open."""


def status(snapshot: Snapshot) -> tuple[str, str]:
    """The status in a word or two, and its colour."""
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
    """The recording's name, the status and the doctor's verdicts; without a recording, what to do."""
    recording = snapshot.recording
    hint = ""
    if not snapshot.engine_alive:
        hint = "dead"
    elif recording is None and snapshot.progress is None:
        hint = "none"
    name = recording.path.name if recording else "hemislam"
    return panel("header", name, *status(snapshot), hint, verdicts(recording.findings if recording else ()))


class HeaderPanel:
    """Title and status. The transport bar shows the progress of long work; if shown here, it would move the sliders."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._title = gui.add_html("")

    def draw(self, snapshot: Snapshot) -> None:
        self._title.content = title(snapshot)


def settled(params: Params, option: str) -> Params | None:
    """The parameters with a finding's command-line option applied; None if the option is not a parameter."""
    try:
        words = shlex.split(option)
        if words[:1] == ["--set"] and len(words) == 2:
            return params.with_assignments(words[1:])
        if words[:1] == ["--preset"] and len(words) == 2:
            return params.merged(PRESETS[words[1]])
    except (HemislamError, KeyError, ValueError):  # an option that the user must complete: "[x, y, z]"
        pass
    return None


def findings_html(findings: tuple[Finding, ...], params: Params) -> str:
    """The findings, those that need the user first, with a button if an option would help; passed ones are folded."""

    def row(finding: Finding) -> tuple[Finding, str, str, str, bool]:
        needed = finding.verdict == "needs you"
        after = settled(params, finding.option) if finding.verdict != "fine" else None
        change = "" if after in (None, params) else "Settle it" if needed else "Use this instead"
        return finding, *_LOOKS[finding.verdict], change, needed and after is None

    rows = {verdict: [row(finding) for finding in findings if finding.verdict == verdict] for verdict in _LOOKS}
    return panel("findings", rows["needs you"] + rows["corrected"], rows["fine"])


def verdicts(findings: tuple[Finding, ...]) -> tuple[str, str] | None:
    """A summary of all findings in a few words, and the colour of the worst."""
    if not findings:
        return None
    counts = {verdict: sum(finding.verdict == verdict for finding in findings) for verdict in _LOOKS}
    parts = [f"{counts['fine']} check{'s' * (counts['fine'] != 1)} passed"]
    parts += [f"{counts['corrected']} corrected"] * bool(counts["corrected"])
    needing = counts["needs you"]
    parts += [f"{needing} need{'s' * (needing == 1)} attention"] * bool(needing)
    return ", ".join(parts), BAD if needing else WARN if counts["corrected"] else GOOD


def log_html(notices: tuple[Notice, ...], recording: str = "") -> str:
    """The newest notices, newest first; those that came while another recording was open name it."""
    lines = [
        (
            one.text if one.recording in ("", recording) else f"{one.recording}: {one.text.removeprefix('Live: ')}",
            _LEVELS[one.level][1],
        )
        for one in reversed(notices[-_LOG_LINES:])
    ]
    return panel("log", lines)


class DoctorPanel:
    """The findings of the open recording, with buttons that apply their options."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._changes = Changes()
        self._bridge = Bridge(gui, "doctor", lambda word, _: self._settle(word.removeprefix("settle ")))
        self._html = gui.add_html("")

    def draw(self, snapshot: Snapshot) -> None:
        if not self._changes(snapshot.recording, snapshot.params):
            return
        findings = snapshot.recording.findings if snapshot.recording else ()
        html = heading("Checks of this recording") + self._bridge.live(findings_html(findings, snapshot.params))
        self._html.content = html if findings else ""

    def _settle(self, option: str) -> None:
        """Apply a finding's option; if it affects how the recording is read, read it again."""
        snapshot = self._page.snapshot()
        known = {finding.option for finding in (snapshot.recording.findings if snapshot.recording else ())}
        after = settled(snapshot.params, option) if option in known else None
        if after is None:
            return
        changed = snapshot.params.changed(after)
        self._page.send(SetParams(changed))
        if any(leaf.effect == "restart" for leaf in leaves() if leaf.path in changed):
            self._page.send(Restart())


class NoticePanel:
    """The engine's notices: a notification in every browser, and a log for browsers that connect later."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._log = server.gui.add_html("")
        self._shown: set[int] = set()
        self._changes = Changes()

    def draw(self, snapshot: Snapshot) -> None:
        """Notify every browser of new notices since the previous call."""
        recording = snapshot.recording.path.name if snapshot.recording else ""
        if not snapshot.notices or not self._changes(snapshot.notices, recording):
            return
        new = [notice for notice in snapshot.notices if notice.number not in self._shown]
        self._shown |= {notice.number for notice in new}
        self._log.content = heading("Messages") + log_html(snapshot.notices, recording)
        for client in self._server.get_clients().values():
            for notice in new:
                title, _, colour, seconds = _LEVELS[notice.level]
                client.add_notification(title, notice.text, color=colour, auto_close_seconds=seconds)
