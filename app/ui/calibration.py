"""Calibrate: how the LiDAR sits on the IMU by the open recording, found in a process of its own, applied by a click."""

from pathlib import Path
from typing import Any

from app.child import Child, ChildDied, Link
from app.server.protocol import LIVE, Restart, SetParams, Snapshot
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.ui.html import panel
from app.ui.widgets import Page

_EXPLAINED = (
    "Finds the rotation and position of the LiDAR on the IMU and the offset of their clocks from the recording alone. "
    "Takes about as long as the recording."
)


class CalibrationPanel:
    """A button, then the progress, then what was found with its uncertainty and a button that applies it."""

    def __init__(self, page: Page) -> None:
        self._page = page
        gui = page.gui
        self._button = gui.add_button("Calibrate", hint=_EXPLAINED, disabled=True)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._html = gui.add_html("", visible=False)
        self._apply = gui.add_button("Apply", hint="Undo it like any parameter.", visible=False)
        self._button.on_click(lambda _: self._begin())
        self._apply.on_click(lambda _: self._use())
        self._child: Child | None = None
        self._found: dict[str, Any] = {}
        self._of: Path | None = None

    def draw(self, snapshot: Snapshot) -> None:
        recording = snapshot.recording.path if snapshot.recording else None
        if recording != self._of:  # what was found belongs to another one
            self.close()
            self._of, self._found = recording, {}
            self._html.visible = self._apply.visible = False
        self._button.disabled = self._child is not None or recording is None or recording == LIVE
        while self._child is not None:
            try:
                message = self._child.receive(0.0)
            except ChildDied as error:
                message = str(error)
            if message is None:
                return
            self._show(message)

    def close(self) -> None:
        """End what is under way."""
        if self._child is not None:
            self._child.close(0.0)
        self._child, self._progress.visible = None, False

    def _show(self, message: Any) -> None:
        if isinstance(message, float):
            self._progress.value = 100 * message  # type: ignore[misc]  # mypy overlooks viser's setter
            return
        self.close()
        rows, self._found = message if isinstance(message, tuple) else ([("", message)], {})
        self._html.content, self._html.visible = panel("calibration", rows), True
        self._apply.visible = bool(self._found)

    def _begin(self) -> None:
        snapshot = self._page.snapshot()
        if self._child is not None or snapshot.recording is None or self._button.disabled:
            return
        self._progress.value = 0.0  # type: ignore[misc]  # as above
        self._progress.visible, self._apply.visible = True, False
        arguments = (snapshot.recording.path, snapshot.params)
        self._child = Child(find, *arguments, name="calibrate", title="Calibration", fork=True)

    def _use(self) -> None:
        if self._found:
            self._page.send(SetParams(dict(self._found)))
            self._page.send(Restart())
            self._apply.visible = False


def find(owner: Link, recording: Path, params: Params) -> None:
    """In a process of its own: sends fractions done, then rows of a table with the parameters found, or a sentence."""
    from app.calibration.calibrate import calibrate
    from app.calibration.words import table

    try:
        found = calibrate(recording, params, progress=lambda fraction: owner.send(float(fraction)))
    except HemislamError as error:
        owner.send(str(error))
        return
    owner.send((table(found), found.found()))
