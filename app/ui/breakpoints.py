"""Where playing is to pause: a switch for each condition, and a limit where there is one."""

from typing import Any, Final

from app.mapping.breakpoints import BREAKPOINTS, Breakpoints
from app.server.protocol import SetBreakpoints, Snapshot
from app.ui.widgets import Page, as_set, show

_SWITCHES: Final = tuple(one for one in BREAKPOINTS if one.limit is None)
_LIMITS: Final = tuple((one, one.limit) for one in BREAKPOINTS if one.limit is not None)


class BreakpointPanel:
    """The controls in the caller's container; `tick` shows what is set."""

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

    def tick(self, snapshot: Snapshot) -> None:
        """Called by the drawing thread, often."""
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
