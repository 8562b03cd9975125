"""What the recording doctor found, in the page."""

from typing import Final

import viser

from app.sensors.doctor import Finding
from app.server.protocol import Snapshot
from app.ui.html import BAD, GOOD, WARN, panel

_LOOKS: Final = {"fine": ("✓ fine", GOOD), "corrected": ("↻ corrected", WARN), "needs you": ("! needs you", BAD)}


def findings_html(findings: tuple[Finding, ...]) -> str:
    """The findings, those that need the user first."""
    order = list(_LOOKS)[::-1]
    ranked = sorted(findings, key=lambda finding: order.index(finding.verdict))
    return panel("findings", [(finding, *_LOOKS[finding.verdict]) for finding in ranked])


def verdicts(findings: tuple[Finding, ...]) -> list[tuple[str, str]]:
    """How many findings there are of each verdict, in words, and its colour."""
    counts = {verdict: sum(finding.verdict == verdict for finding in findings) for verdict in _LOOKS}
    return [(f"{_LOOKS[verdict][0]} {count}", _LOOKS[verdict][1]) for verdict, count in counts.items() if count]


class DoctorPanel:
    """The findings of the open recording."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html(findings_html(()))

    def draw(self, snapshot: Snapshot) -> None:
        """Show the open recording's findings."""
        self._html.content = findings_html(snapshot.recording.findings if snapshot.recording else ())
