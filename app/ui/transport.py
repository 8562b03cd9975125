"""Play, pause, step, speed and the time slider, the same by keyboard; where playing pauses; notes on frames."""

import math
from datetime import UTC, datetime
from typing import Any, Final

import viser

from app.mapping.breakpoints import BREAKPOINTS, Breakpoints
from app.server.protocol import (
    AddNote,
    Command,
    Pause,
    Play,
    Seek,
    SetBreakpoints,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.ui.html import number, panel
from app.ui.widgets import PANEL_PERIOD_S, Changes, Edit, Page, as_set, by_user, show

SPEEDS: Final = {
    "0.1×": 0.1,
    "0.25×": 0.25,
    "0.5×": 0.5,
    "1×": 1.0,
    "2×": 2.0,
    "5×": 5.0,
    "10×": 10.0,
    "as fast as it can": math.inf,
}
_SWITCHES: Final = tuple(one for one in BREAKPOINTS if one.limit is None)
_LIMITS: Final = tuple((one, one.limit) for one in BREAKPOINTS if one.limit is not None)
_BACK, _STEP, _START = "◂ back", "step ▸", "to start"
_FRAME_COMMANDS: Final[dict[str, Command]] = {_BACK: StepFrame(-1), _STEP: StepFrame(), _START: Seek(0)}
_DRAG_REST_S: Final = 0.2
"""The slider seeks after resting this long: frames on the way may have to be processed."""
_SEEK_HOLD_S: Final = 1.0
_SHOWN_NOTES: Final = 30


class TransportPanel:
    """The controls; `draw` seeks to where the slider was dragged and shows where the engine is."""

    def __init__(self, page: Page) -> None:
        gui, send = page.gui, page.send
        self._send = page.send
        self._snapshot = page.snapshot
        self._now = page.now
        self._edit: Edit | None = None  # of the slider
        self._follows = Changes(page.now, PANEL_PERIOD_S)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY_FILLED, hint="space")
        self._frames = gui.add_button_group(
            "frame", (_BACK, _STEP, _START), hint="Keys: ← and →. Going back loses nothing."
        )
        self._slider = gui.add_slider("time (frame)", 0, 1, 1, 0, hint="Drag to go to a frame, back or forward.")
        self._where = gui.add_html("")
        self._speed = gui.add_dropdown(
            "speed", tuple(SPEEDS), initial_value="1×", hint="Times real time; the engine never skips a frame."
        )
        self._play.on_click(lambda _: self.toggle())
        self._frames.on_click(by_user(lambda chosen, _: send(_FRAME_COMMANDS[chosen])))
        self._speed.on_update(as_set(lambda chosen, _: send(SetSpeed(SPEEDS[chosen]))))
        self._slider.on_update(as_set(self._drag))
        gui.add_command("Play or pause", hotkey="space").on_trigger(lambda _: self.toggle())
        gui.add_command("Step one frame", hotkey="arrowright").on_trigger(lambda _: send(StepFrame()))
        gui.add_command("Step one frame back", hotkey="arrowleft").on_trigger(lambda _: send(StepFrame(-1)))

    def toggle(self) -> None:
        self._send(Pause() if self._snapshot().transport.playing else Play())

    def draw(self, snapshot: Snapshot) -> None:
        transport, now, edit = snapshot.transport, self._now(), self._edit
        if edit is not None and not edit.sent and now - edit.at >= _DRAG_REST_S:
            self._edit = Edit(edit.value, now, sent=True)
            self._send(Seek(edit.value))
        elif edit is not None and edit.sent:
            refused = now - edit.at > _SEEK_HOLD_S and snapshot.progress is None
            self._edit = None if refused or transport.frame == edit.value else edit
        self._slider.max = last = max(snapshot.recording.frames - 1, 1) if snapshot.recording else 1
        if self._follows(snapshot, self._edit is None, at_once=not transport.playing):
            self._where.content = where(snapshot)
            if self._edit is None:
                show(self._slider, min(max(transport.frame, 0), last))
        live = snapshot.live is not None
        self._play.disabled = snapshot.recording is None
        # A live source has no past and its own pace. viser cannot disable a group of buttons.
        self._slider.disabled = self._speed.disabled = live or snapshot.recording is None
        self._frames.visible = not live
        self._play.label = "Pause" if transport.playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE_FILLED if transport.playing else viser.Icon.PLAYER_PLAY_FILLED
        show(self._speed, speed_name(transport.speed))

    def _drag(self, frame: int, _: Any) -> None:
        self._edit = Edit(frame, self._now())


def speed_name(factor: float) -> str:
    """The offered speed that is nearest to `factor`."""
    if math.isinf(factor):
        return "as fast as it can"
    finite = {name: value for name, value in SPEEDS.items() if math.isfinite(value)}
    return min(finite, key=lambda name: abs(math.log(finite[name] / max(factor, 1e-3))))


def where(snapshot: Snapshot) -> str:
    """Frame, seconds into the recording, and the stamp in UTC; of a live source, why there is no way back."""
    recording, transport = snapshot.recording, snapshot.transport
    if recording is None:
        return panel("quiet", "No recording is open.")
    frame, stamp, rate = f"{transport.frame:,}", _utc(transport.stamp_ns), number(transport.frames_per_second, 1)
    if snapshot.live is not None:
        forward = "A live session only goes forward. To go back, record it (--record) and open the file."
        if transport.frame < 0:
            return panel("quiet", f"Waiting for the first scan. {forward}")
        dropped = f"{transport.dropped:,} scans dropped" if transport.dropped else "no scan dropped"
        return panel("where", frame, ", live", "", dropped, stamp, rate, forward)
    if transport.frame < 0:
        return panel("quiet", f"{recording.frames:,} frames, {recording.duration_s:.1f} s")
    seconds = number((transport.stamp_ns - recording.start_ns) * 1e-9)
    of, duration = f" of {recording.frames:,}", f" of {number(recording.duration_s, 1)} s"
    return panel("where", frame, of, seconds, duration, stamp, rate)


def _utc(stamp_ns: int) -> str:
    clock = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC)
    return f"{clock:%Y-%m-%d %H:%M:%S}.{stamp_ns // 1_000_000 % 1000:03d} UTC"


class BreakpointPanel:
    """Where playing is to pause: a switch for each condition, and a limit where there is one."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._send = page.send
        self._shown = Breakpoints()
        self._switches = {one.name: gui.add_checkbox(one.title, False, hint=one.hint) for one in _SWITCHES}
        self._limits = {}
        for one, limit in _LIMITS:
            switch = gui.add_checkbox(one.title, False, hint=one.hint)
            number = gui.add_number(limit.unit or "limit", limit.default, min=0.0, step=limit.step)
            number.visible = False
            self._limits[one.name] = switch, number
        for control in (*self._switches.values(), *(part for pair in self._limits.values() for part in pair)):
            control.on_update(as_set(lambda _value, _client: self._changed()))

    def draw(self, snapshot: Snapshot) -> None:
        now = snapshot.breakpoints
        if now == self._shown:  # a control just set stays until the engine has heard of it
            return
        self._shown = now
        for name, switch in self._switches.items():
            show(switch, now[name])
        for one, limit in _LIMITS:
            switch, number = self._limits[one.name]
            value = now[one.name]
            show(switch, value is not None)
            number.visible = value is not None
            if value is not None:
                show(number, round(limit.scale * value, 6))

    def _changed(self) -> None:
        chosen: dict[str, Any] = {name: switch.value for name, switch in self._switches.items()}
        for one, limit in _LIMITS:
            switch, number = self._limits[one.name]
            chosen[one.name] = max(number.value, 0.0) / limit.scale if switch.value else None
        self._send(SetBreakpoints(Breakpoints(**chosen)))


class NotesPanel:
    """A field for a note on the present frame, and the notes made so far."""

    def __init__(self, page: Page) -> None:
        self._send = page.send
        self._text = page.gui.add_text("note", "", hint="On the frame that is shown; kept in the session.")
        self._add = page.gui.add_button("Add note", icon=viser.Icon.NOTE, color="gray")
        self._list = page.gui.add_html("", visible=False)
        self._add.on_click(by_user(lambda _value, _client: self._note()))

    def draw(self, snapshot: Snapshot) -> None:
        self._list.content = panel("notes", snapshot.notes[-_SHOWN_NOTES:][::-1])
        self._list.visible = bool(snapshot.notes)

    def _note(self) -> None:
        if self._text.value.strip():
            self._send(AddNote(self._text.value))
            self._text.value = ""  # type: ignore[misc]  # mypy overlooks viser's setter
