"""Tests app/ui/calibration.py: the calibration panel shows what a process of its own found, and applies it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.server.protocol import Command, OpenedRecording, Restart, SetParams, Snapshot
from app.slam.params import Params
from app.ui import calibration
from app.ui.calibration import CalibrationPanel
from tests.ui.conftest import page_of, user_clicks

FOUND = {"sensor.rotation": [70.0, -50.0, 104.0]}
OPEN = Snapshot(recording=OpenedRecording(Path("walk.mcap"), 0, 30.0, 300, ()))


class Process:
    """Stands for the process; the test says what it sends."""

    def __init__(self, main: Any, *args: Any, **_: Any) -> None:
        self.arguments, self.messages, self.closed = args, [], False

    def receive(self, timeout: float | None = None) -> Any:
        return self.messages.pop(0) if self.messages else None

    def close(self, timeout: float | None = None) -> None:
        self.closed = True


class Calibrating:
    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.panel = CalibrationPanel(page_of(server, self.sent.append, lambda: OPEN))
        self.panel.draw(OPEN)

    def process(self) -> Any:
        return self.panel._child


@pytest.fixture
def page(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> Calibrating:
    monkeypatch.setattr(calibration, "Child", Process)
    return Calibrating(server)


def test_a_click_finds_and_another_applies_what_was_found(page: Calibrating) -> None:
    panel = page.panel
    user_clicks(panel._button)
    process = page.process()
    assert process.arguments == (Path("walk.mcap"), Params())
    process.messages += [0.25, 0.5]
    panel.draw(OPEN)
    assert panel._progress.visible and panel._progress.value == 50 and panel._button.disabled
    process.messages.append(([("rotation of the LiDAR on the IMU", "roll 70.00 ± 0.05 <deg>")], FOUND))
    panel.draw(OPEN)
    assert process.closed and not panel._progress.visible and panel._apply.visible
    assert "roll 70.00 ± 0.05 &lt;deg&gt;" in panel._html.content and page.sent == []
    user_clicks(panel._apply)
    assert page.sent == [SetParams(FOUND), Restart()] and not panel._apply.visible


def test_what_cannot_be_told_is_said_and_nothing_is_offered(page: Calibrating) -> None:
    user_clicks(page.panel._button)
    page.process().messages.append("walk.mcap has 12 usable scans; it takes 50.")
    page.panel.draw(OPEN)
    assert "12 usable scans" in page.panel._html.content and not page.panel._apply.visible
    page.panel.draw(OPEN)
    assert not page.panel._button.disabled


def test_another_recording_ends_it_and_forgets_what_was_found(page: Calibrating) -> None:
    user_clicks(page.panel._button)
    process = page.process()
    assert OPEN.recording is not None
    page.panel.draw(replace(OPEN, recording=replace(OPEN.recording, path=Path("other.mcap"))))
    assert process.closed and page.process() is None and not page.panel._apply.visible


def test_without_a_recording_there_is_nothing_to_calibrate(server: viser.ViserServer) -> None:
    panel = CalibrationPanel(page_of(server, [].append, Snapshot))
    panel.draw(Snapshot())
    assert panel._button.disabled
