"""Where playing is to pause: a switch for each condition, and a limit where there is one."""

from dataclasses import dataclass
from typing import Any, Final

from app.server.breakpoints import Breakpoints
from app.server.protocol import SetBreakpoints, Snapshot
from app.ui.widgets import Page, as_set, show

_SWITCHES: Final = (
    ("loop_found", "loop found", "A loop was accepted."),
    ("loop_rejected", "loop rejected", "A loop candidate was rejected."),
    ("no_ground", "no ground", "The seeds gave no plane; the notice says why."),
    ("degenerate", "degenerate", "The scan does not constrain one direction."),
    ("dropped", "scan dropped", "A scan was left out."),
)


@dataclass(frozen=True, slots=True)
class _Limit:
    """A number on the page is `scale` times the breakpoint's own."""

    name: str
    text: str
    unit: str
    scale: float
    default: float
    step: float
    hint: str


_LIMITS: Final = (
    _Limit("planarity", "λ3/λ2 over", "", 1.0, 0.3, 0.01, "The seeds are less flat than this."),
    _Limit("residual", "residual over", "mm", 1000.0, 50.0, 1.0, "RMS distance of the points to the map's planes."),
    _Limit("frame_ms", "frame over", "ms", 1.0, 100.0, 1.0, "Time the engine took for the frame."),
    _Limit("error", "error over", "cm", 100.0, 50.0, 1.0, "Distance to the truth, where there is one."),
)


class BreakpointPanel:
    """The controls in the caller's container; `tick` shows what is set."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._send = page.send
        self._shown = Breakpoints()
        self._switches = {name: gui.add_checkbox(text, False, hint=hint) for name, text, hint in _SWITCHES}
        self._limits = {}
        for limit in _LIMITS:
            switch = gui.add_checkbox(limit.text, False, hint=limit.hint)
            number = gui.add_number(limit.unit or "limit", limit.default, min=0.0, step=limit.step)
            number.visible = False
            self._limits[limit.name] = switch, number
        for control in (*self._switches.values(), *(part for pair in self._limits.values() for part in pair)):
            control.on_update(as_set(lambda _value, _client: self._changed()))

    def tick(self, snapshot: Snapshot) -> None:
        """Called by the drawing thread, often."""
        now = snapshot.breakpoints
        if now == self._shown:  # a control just set stays until the engine has heard of it
            return
        self._shown = now
        for name, switch in self._switches.items():
            show(switch, getattr(now, name))
        for limit in _LIMITS:
            switch, number = self._limits[limit.name]
            value = getattr(now, limit.name)
            show(switch, value is not None)
            number.visible = value is not None
            if value is not None:
                show(number, round(limit.scale * value, 6))

    def _changed(self) -> None:
        chosen: dict[str, Any] = {name: switch.value for name, switch in self._switches.items()}
        for limit in _LIMITS:
            switch, number = self._limits[limit.name]
            chosen[limit.name] = max(number.value, 0.0) / limit.scale if switch.value else None
        self._send(SetBreakpoints(Breakpoints(**chosen)))
