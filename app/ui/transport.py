"""The bar at the scene's lower edge: play, step, speed and time; the same by keyboard; and the breakpoints."""

import json
import math
from datetime import UTC, datetime
from typing import Any, Final

import viser

from app.mapping.breakpoints import BREAKPOINTS, Breakpoints
from app.server.protocol import (
    Pause,
    Play,
    Progress,
    Seek,
    SetBreakpoints,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.ui.html import number, panel
from app.ui.viser_adapter import Bridge
from app.ui.widgets import PANEL_PERIOD_S, Changes, Page, add_command, as_set, limited, show

SPEEDS: Final = {
    "0.1×": 0.1,
    "0.25×": 0.25,
    "0.5×": 0.5,
    "1×": 1.0,
    "2×": 2.0,
    "5×": 5.0,
    "10×": 10.0,
    "maximum": math.inf,
}


class TransportPanel:
    """The bar, which `templates/transport.js` draws; the strips of `app.ui.timeline` unfold above it."""

    def __init__(self, page: Page) -> None:
        gui, send = page.gui, page.send
        self._send, self._snapshot = page.send, page.snapshot
        self._changes = Changes(page.now, PANEL_PERIOD_S)
        self._bridge = Bridge(gui, "transport", self._asked)
        self._state = gui.add_html("")
        add_command(gui, "Play or pause", lambda _: self.toggle(), hotkey="space")
        # Their keys are in `viser_adapter.js`: the list of commands would show them as "arrowright".
        add_command(gui, "Step one frame (→)", lambda _: send(StepFrame()))
        add_command(gui, "Step one frame back (←)", lambda _: send(StepFrame(-1)))

    def toggle(self) -> None:
        self._send(Pause() if self._snapshot().transport.playing else Play())

    def draw(self, snapshot: Snapshot) -> None:
        if self._changes(
            snapshot.transport,
            snapshot.recording,
            snapshot.live,
            snapshot.progress,
            at_once=not snapshot.transport.playing,
        ):
            self._state.content = panel("transport_state", json.dumps(state(snapshot)))

    def _asked(self, word: str, _: viser.ClientHandle) -> None:
        """Handle what the script sends: "play", "pause", "resume", "step -1", "seek 812", "speed 2×"."""
        match word.split(" ", 1):
            case ["play"]:
                self.toggle()
            case ["pause"]:
                self._send(Pause())
            case ["resume"]:
                self._send(Play())
            case ["step", ("1" | "-1") as frames]:
                self._send(StepFrame(int(frames)))
            case ["seek", frame] if frame.isdecimal():
                self._send(Seek(int(frame)))
            case ["speed", name] if name in SPEEDS:
                self._send(SetSpeed(SPEEDS[name]))


def state(snapshot: Snapshot) -> dict[str, Any]:
    """Values for the bar, ready for JSON. A live source cannot go back and has its own pace."""
    recording, transport = snapshot.recording, snapshot.transport
    return {
        "open": recording is not None,
        "live": snapshot.live is not None,
        "playing": transport.playing,
        "frame": max(transport.frame, 0),
        "last": max(recording.frames - 1, 1) if recording else 1,
        "speed": speed_name(transport.speed),
        "words": where(snapshot),
        "done": done(snapshot.progress),
    }


def speed_name(factor: float) -> str:
    """The offered speed that is nearest to `factor`."""
    if math.isinf(factor):
        return "maximum"
    finite = {name: value for name, value in SPEEDS.items() if math.isfinite(value)}
    return min(finite, key=lambda name: abs(math.log(finite[name] / max(factor, 1e-3))))


def where(snapshot: Snapshot) -> str:
    """Frame, seconds into the recording, and the stamp in UTC; for a live source, why it cannot go back."""
    recording, transport = snapshot.recording, snapshot.transport
    if snapshot.progress is not None:
        return panel("quiet", working(snapshot.progress))
    if recording is None:
        return panel("quiet", "No recording is open.")
    frame, stamp, rate = (
        f"{transport.frame:,}",
        _utc(transport.stamp_ns),
        number(transport.frames_per_second, 1) if transport.playing else "",
    )
    if snapshot.live is not None:
        back = "start with --record" if snapshot.live.recorded is None else "open the recording once it has ended"
        forward = f"A live session only goes forward. To go back, {back}."
        if transport.frame < 0:
            return panel("quiet", f"Waiting for the first scan. {forward}")
        dropped = f"{transport.dropped:,} scans dropped" if transport.dropped else "no scan dropped"
        if not transport.playing and snapshot.live.backlog:
            dropped = f"{snapshot.live.backlog:,} scans wait"
            forward = "If too many scans wait, the oldest are dropped. Play continues with the rest."
        return panel("where", frame, ", live", "", dropped, stamp, rate, forward)
    if transport.frame < 0:
        return panel(
            "quiet", f"{recording.frames:,} frames, {recording.duration_s:.1f} s. Press Play, or → for one frame."
        )
    seconds = number((transport.stamp_ns - recording.start_ns) * 1e-9)
    of, end = f" of 0–{recording.frames - 1:,}", f" of {number(recording.end_s, 1)} s"
    return panel("where", frame, of, seconds, end, stamp, rate)


def done(progress: Progress | None) -> float:
    """The share of long work that is done; 0 while that is unknown, or without such work."""
    share = progress.fraction if progress is not None else 0.0
    return min(max(share, 0.0), 1.0) if math.isfinite(share) else 0.0


def working(progress: Progress) -> str:
    """The title of long work, and its progress."""
    return progress.title + (f" · {100 * done(progress):.0f} %" if math.isfinite(progress.fraction) else " …")


def _utc(stamp_ns: int) -> str:
    clock = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC)
    return f"{clock:%Y-%m-%d %H:%M:%S}.{stamp_ns // 1_000_000 % 1000:03d} UTC"


class BreakpointPanel:
    """The breakpoints: a checkbox for each condition, and its limit if it has one."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._send = page.send
        self._shown = Breakpoints()
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        self._numbers: dict[str, viser.GuiNumberHandle[float]] = {}  # of conditions with a limit
        for one in BREAKPOINTS:
            self._switches[one.name] = gui.add_checkbox(one.title, False, hint=one.hint)
            if (limit := one.limit) is not None:
                self._numbers[one.name] = limited(
                    gui.add_number(limit.unit or "limit", limit.default, min=0.0, step=limit.step, visible=False)
                )
        controls: list[Any] = [*self._switches.values(), *self._numbers.values()]
        for control in controls:
            control.on_update(as_set(lambda _value, _client: self._changed()))

    def draw(self, snapshot: Snapshot) -> None:
        now = snapshot.breakpoints
        if now == self._shown:  # a control just set stays until the engine confirms it
            return
        self._shown = now
        for one in BREAKPOINTS:
            show(self._switches[one.name], one.name in now.chosen)
            if one.limit is not None:
                self._numbers[one.name].visible = one.name in now.chosen
                if one.name in now.chosen:
                    show(self._numbers[one.name], round(one.limit.scale * now.chosen[one.name], 6))

    def _changed(self) -> None:
        chosen: dict[str, Any] = {name: switch.value for name, switch in self._switches.items()}
        for one in BREAKPOINTS:
            if one.limit is not None:
                value = max(self._numbers[one.name].value, 0.0) / one.limit.scale
                chosen[one.name] = value if chosen[one.name] else None
        self._send(SetBreakpoints(Breakpoints(**chosen)))
