"""Play, pause, step, speed and the time slider; the same by keyboard."""

import math
from datetime import UTC, datetime
from typing import Any, Final

import viser

from app.server.protocol import Command, Pause, Play, Restart, Seek, SetSpeed, Snapshot, StepFrame
from app.ui.html import number, panel
from app.ui.widgets import Page, as_set, by_user, show

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
_BACK, _STEP, _RESTART = "◂ back", "step ▸", "from start ↺"
_FRAME_COMMANDS: Final[dict[str, Command]] = {_BACK: StepFrame(-1), _STEP: StepFrame(), _RESTART: Restart()}
_DRAG_REST_S: Final = 0.2
"""The slider seeks after resting this long: frames on the way may have to be processed."""
_SEEK_HOLD_S: Final = 1.0
_PLAYING_PERIOD_S: Final = 1 / 4
"""How often the slider and the numbers follow while playing."""


class TransportPanel:
    """The controls; `tick` seeks to where the slider was dragged and shows where the engine is."""

    def __init__(self, page: Page) -> None:
        gui, send = page.gui, page.send
        self._send = page.send
        self._snapshot = page.snapshot
        self._now = page.now
        self._dragged: tuple[int, float] | None = None
        self._sought: tuple[int, float] | None = None
        self._followed_at = -1e9
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY_FILLED, hint="space")
        self._frames = gui.add_button_group("frame", (_BACK, _STEP, _RESTART), hint="← and → step one frame.")
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
        """Play or pause; at the end, play from the beginning."""
        transport = self._snapshot().transport
        if transport.finished and not transport.playing:
            self._send(Restart())
        self._send(Pause() if transport.playing else Play())

    def tick(self, snapshot: Snapshot) -> None:
        """Called by the drawing thread, often."""
        transport, now = snapshot.transport, self._now()
        dragged = self._dragged
        if dragged is not None and now - dragged[1] >= _DRAG_REST_S:
            self._dragged, self._sought = None, (dragged[0], now)
            self._send(Seek(dragged[0]))
        if self._sought is not None:
            target, since = self._sought
            if transport.frame == target or (now - since > _SEEK_HOLD_S and snapshot.progress is None):
                self._sought = None
        last = max(snapshot.recording.frames - 1, 1) if snapshot.recording else 1
        if self._slider.max != last:
            self._slider.max = last
        if not transport.playing or now - self._followed_at >= _PLAYING_PERIOD_S:
            self._followed_at = now
            if self._dragged is None and self._sought is None:
                show(self._slider, min(max(transport.frame, 0), last))
            self._where.content = where(snapshot)
        live = snapshot.live is not None
        self._play.disabled = snapshot.recording is None
        # A live source has no past and its own pace. viser cannot disable a group of buttons.
        self._slider.disabled = self._speed.disabled = live or snapshot.recording is None
        self._frames.visible = not live
        playing = transport.playing
        if (self._play.label == "Pause") != playing:
            self._play.label = "Pause" if playing else "Play"
            self._play.icon = viser.Icon.PLAYER_PAUSE_FILLED if playing else viser.Icon.PLAYER_PLAY_FILLED
        show(self._speed, speed_name(transport.speed))

    def _drag(self, frame: int, _: Any) -> None:
        self._dragged = (frame, self._now())


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
