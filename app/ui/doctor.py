"""What the recording doctor found, in the page."""

from html import escape
from typing import Final

import viser

from app.sensors.doctor import Finding
from app.server.protocol import Snapshot
from app.ui.html import BAD, GOOD, WARN, box, chip

_LOOKS: Final = {"fine": ("✓ fine", GOOD), "corrected": ("↻ corrected", WARN), "needs you": ("! needs you", BAD)}


def findings_html(findings: tuple[Finding, ...]) -> str:
    """The findings with what needs the user first."""
    if not findings:
        return box('<span class="hs-quiet">Open a recording: what it holds is examined here.</span>')
    order = list(_LOOKS)[::-1]
    items = []
    for finding in sorted(findings, key=lambda finding: order.index(finding.verdict)):
        text, colour = _LOOKS[finding.verdict]
        option = f"<div><code>{escape(finding.option)}</code></div>" if finding.option else ""
        items.append(
            f'<div class="hs-item" style="border-color:{colour}"><div class="hs-row">'
            f"<b>{escape(finding.subject)}</b>{chip(text, colour)}</div>{escape(finding.text)}{option}</div>"
        )
    return box(*items)


def verdicts(findings: tuple[Finding, ...]) -> str:
    """One line of chips that sums the findings up."""
    counts = {verdict: sum(finding.verdict == verdict for finding in findings) for verdict in _LOOKS}
    return " ".join(chip(f"{_LOOKS[verdict][0]} {n}", _LOOKS[verdict][1]) for verdict, n in counts.items() if n)


class DoctorPanel:
    """The findings of the open recording."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html(findings_html(()))

    def draw(self, snapshot: Snapshot) -> None:
        self._html.content = findings_html(snapshot.recording.findings if snapshot.recording else ())
