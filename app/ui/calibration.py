"""Calibrate: find the LiDAR's pose on the IMU from the open recording, in a process of its own, and apply it.

It begins automatically if the mounting is unknown, and after a doubtful run. If no mounting was given, the result is
applied at once, unless the user changed something in the meantime. A resumed session keeps its parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from app.calibration.calibrate import is_mounting_unknown
from app.calibration.words import table, write_beside
from app.child import Link
from app.sensors.presets import calibrated_beside, kept_sidecar, sidecar
from app.sensors.probe import WITHOUT_IMU
from app.server.protocol import LIVE, Calibrated, Restart, SetParams, Snapshot
from app.slam.doubts import IN_DOUBT
from app.slam.errors import HemislamError, refusal
from app.slam.params import Params
from app.ui.background import Background
from app.ui.html import panel
from app.ui.widgets import Page, add_button

_EXPLAINED = (
    "Finds rotation and position of the LiDAR on the IMU, the offset of their clocks, and the errors of each scan "
    "line, from the recording alone. Takes about as long as the recording."
)
_APPLIES = "Use these parameters, save them beside the recording, and read the recording again."
_UNDOES = "Restore the earlier parameters and the files beside the recording, and read the recording again."
_KEEPS = "Save these parameters beside the recording, so that they apply whenever it is opened. Undo reverts this."


@dataclass(frozen=True, slots=True)
class FoundMounting:
    """The result that the process sends at the end.

    Attributes:
        rows: names and values of a table. values: parameters by dotted name. plot: SVG of the residuals.
        contradiction: what is wrong with the parameters used so far, in a sentence; "" if nothing is.
    """

    rows: list[tuple[str, str]]
    values: dict[str, Any]
    plot: str = ""
    contradiction: str = ""


class CalibrationPanel:
    """A button, then the progress, then the result with its uncertainty and a button that applies or undoes it.

    Args:
        unasked: begin automatically where that helps.
        resolve: returns the parameters of a recording, with the calibration stored beside it, or without that
            calibration if `calibrated=False`.
    """

    def __init__(self, page: Page, *, unasked: bool = False, resolve: Callable[..., Params] | None = None) -> None:
        self._page, self._unasked, self._resolve = page, unasked, resolve
        gui = page.gui
        self._button = add_button(gui, "Calibrate", lambda _: self._begin(), color=None, hint=_EXPLAINED, disabled=True)
        self._work = Background(gui, "calibrate", "Calibration", "Earlier results stay.")
        self._html = gui.add_html("")
        self._apply = add_button(gui, "Apply", lambda _: self._apply_or_undo(), color=None, visible=False)
        self._keep = add_button(gui, "Keep", lambda _: self._write(), hint=_KEEPS, visible=False)
        self._plot = gui.add_html("")
        self._found = FoundMounting([], {})
        self._before: dict[str, Any] = {}  # values that the result replaced; empty while it is not applied
        self._files: dict[Path, bytes | None] = {}  # parameter files beside the recording, before they were written
        self._sentence = ""  # for the report, once the values are applied
        self._given = Params()
        self._of: Path | None = None
        self._asked = self._tried = False
        self._notified: set[int] = set()  # browsers that were told about the search
        self._heard = 0  # the newest notice when this recording was opened

    def draw(self, snapshot: Snapshot) -> None:
        recording = snapshot.recording.path if snapshot.recording else None
        if recording != self._of:  # the result belongs to another recording
            self.close()
            self._of, self._found, self._before, self._tried = recording, FoundMounting([], {}), {}, not self._unasked
            self._apply.visible = self._keep.visible = False
            self._html.content = self._plot.content = ""
            self._heard = snapshot.last_notice
        self._button.disabled = self._work.running or recording is None or recording == LIVE
        doubted = any(one.number > self._heard and one.text.startswith(IN_DOUBT) for one in snapshot.notices)
        if not self._tried and not self._button.disabled and (_is_unknown(snapshot) or doubted):
            self._begin(asked=False)
        if self._work.running and not self._asked and _is_unknown(snapshot):
            self._announce()
        for message in self._work.messages():
            self._show(message)
        self._keep.disabled = self._work.running
        self._apply.disabled = self._work.running or not snapshot.engine_alive  # it would lose the parameters

    def close(self) -> None:
        """Stop a calibration in progress."""
        self._work.stop()

    def _show(self, message: Any) -> None:
        self.close()
        found = message if isinstance(message, FoundMounting) else FoundMounting([("", message)], {})
        if found.contradiction:
            found = replace(found, rows=[("", f"{found.contradiction}."), *found.rows])
        self._found, self._before, self._keep.visible = found, {}, False
        self._tell()
        self._plot.content = panel("figure", found.plot)
        self._offer()
        self._sentence = ""
        if found.contradiction and found.values:
            self._sentence = f"{found.contradiction}; this was found in the recording and is used."
        if not self._asked and found.contradiction:
            self._use_or_advise(found.contradiction)

    def _tell(self, *more: tuple[str, str]) -> None:
        """Show the result, and what was done with it."""
        self._html.content = panel("calibration", [*self._found.rows, *more])

    def _use_or_advise(self, contradiction: str) -> None:
        """If no mounting is known, apply a result that nobody asked for; otherwise say how to apply it."""
        snapshot = self._page.snapshot()
        if _is_unknown(snapshot) and snapshot.params == self._given and not _has_edits(snapshot):
            self._use()
            self._keep.visible = True
        else:
            self._page.send(Calibrated(f"{contradiction}. To apply it, see Calibration under Recording."))

    def _announce(self) -> None:
        for number, client in self._page.server.get_clients().items():
            if number not in self._notified:
                self._notified.add(number)
                client.add_notification(
                    "Looking for the pose of the LiDAR on the IMU",
                    "None is given. The map may look wrong until the pose is found; then the map is rebuilt.",
                    auto_close_seconds=20.0,
                )

    def _begin(self, *, asked: bool = True) -> None:
        snapshot = self._page.snapshot()
        if self._work.running or snapshot.recording is None or self._button.disabled:
            return
        recording, params = snapshot.recording.path, snapshot.params
        self._asked, self._tried, self._given = asked, True, params
        self._notified.clear()
        try:
            self._work.begin(find, recording, self._uncalibrated(recording, params))
            self._apply.disabled = self._keep.disabled = True
        except HemislamError as error:
            self._show(str(error))

    def _uncalibrated(self, recording: Path, params: Params) -> Params:
        """These parameters without an earlier result from this recording, which would count the same walk twice."""
        used = params.with_values(self._found.values)
        without = {name: value for name, value in self._before.items() if params.value(name) == used.value(name)}
        if self._resolve is not None and calibrated_beside(recording):
            used, given = self._resolve(recording), self._resolve(recording, calibrated=False)
            beside = used.changed(given).items()
            without = {name: value for name, value in beside if params.value(name) == used.value(name)} | without
        return params.with_values(without)

    def _apply_or_undo(self) -> None:
        if self._before:
            self._undo()
        elif self._found.values:
            self._use()
            self._write()

    def _use(self) -> None:
        """Apply the result."""
        params = self._page.snapshot().params
        self._before = {name: params.value(name) for name in self._found.values}
        self._set(dict(self._found.values), self._sentence)

    def _undo(self) -> None:
        """Restore the earlier values and the earlier parameter file."""
        self._set(self._before, "")
        self._before = {}
        kept, self._keep.visible = not self._keep.visible, False
        self._offer()
        self._tell()
        if kept and self._of is not None:
            try:
                for path, content in self._files.items():
                    if content is None:
                        path.unlink(missing_ok=True)
                    else:
                        path.write_bytes(content)
            except OSError as error:
                self._tell(("kept", f"{refusal(error)} {calibrated_beside(self._of)}".strip()))

    def _write(self) -> None:
        """Save the result beside the recording."""
        assert self._of is not None
        path = sidecar(self._of)
        self._keep.visible = False
        try:
            both = path, kept_sidecar(self._of)
            self._files = {one: one.read_bytes() if one.is_file() else None for one in both}
            write_beside(self._of, self._found.values)
            self._tell(("kept", f"in {path}; applied whenever this recording is opened"))
        except (HemislamError, OSError) as error:
            self._keep.visible = True
            self._tell(("not kept", str(error)))

    def _set(self, values: dict[str, Any], sentence: str) -> None:
        """Set parameters, restart with them, and return to the frame that was shown."""
        self._page.send(SetParams(values))
        self._page.send(Restart(stay=True))
        self._page.send(Calibrated(sentence))
        self._offer()

    def _offer(self) -> None:
        label, hint = ("Undo", _UNDOES) if self._before else ("Apply", _APPLIES)
        self._apply.label, self._apply.hint = label, hint
        self._apply.visible = bool(self._found.values)


def _is_unknown(snapshot: Snapshot) -> bool:
    """Whether there is a usable IMU, and the pose of the LiDAR on it was not given."""
    has_imu = snapshot.recording is not None and WITHOUT_IMU.isdisjoint(snapshot.recording.findings)
    return has_imu and is_mounting_unknown(snapshot.params) and not snapshot.resumed


def _has_edits(snapshot: Snapshot) -> bool:
    """Whether the user made something that belongs to the present frames."""
    s = snapshot
    return bool(s.notes or s.measures or s.painted or s.views or s.loops.undo)


def find(owner: Link, recording: Path, params: Params) -> None:
    """Run in a process of its own: sends the fraction done, and finally the result."""
    from app.calibration.calibrate import calibrate
    from app.evaluation.plots import residual_plot

    found = calibrate(recording, params, progress=lambda fraction: owner.send(float(fraction)))
    owner.send(FoundMounting(table(found), found.found(), residual_plot(found), found.contradiction()))
