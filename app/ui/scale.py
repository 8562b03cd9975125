"""Everything that depends on a browser's view: its scale bar and compass, and whether ceilings are hidden."""

from typing import Final

import numpy as np
import viser

from app.server.protocol import Snapshot
from app.slam.types import F64
from app.ui.html import panel
from app.ui.widgets import PANEL_PERIOD_S, Changes, Page

_LONGEST: Final = 0.16
"""Longest bar, as a share of the picture's height."""
_STEPS: Final = (1.0, 2.0, 5.0, 10.0)

_SHOWN_DEG, _HIDDEN_DEG = 12.0, 22.0
"""Ceilings appear if the view slopes down by less than the first angle, and vanish if by more than the second."""


def bar(seen_m: float) -> float:
    """The longest bar of 1, 2 or 5 times a power of ten metres that fits; seen_m: the picture's height in the scene."""
    power = 10.0 ** np.floor(np.log10(_LONGEST * seen_m))
    return float(max(step * power for step in _STEPS if step * power <= _LONGEST * seen_m))


def length_text(metres: float) -> str:
    return f"{metres:g} m" if metres >= 1 else f"{100 * metres:g} cm"


def scale_html(position: F64, look_at: F64, fov: float, north: F64 | None = None, *, needle: bool = True) -> str:
    """Scale bar at the point that a camera looks at, and the direction of north in its picture.

    north: (2 or more,), its direction in the map; None: unknown, and the map's x axis is shown instead. needle: whether
    to show a direction; a profile along a bent path has none.
    """
    ahead = look_at - position
    seen_m = 2 * float(np.linalg.norm(ahead)) * float(np.tan(fov / 2))
    if not seen_m > 0:
        return ""
    length = bar(seen_m)
    x, y = (1.0, 0.0) if north is None else north[:2]
    turn = float(np.degrees(np.arctan2(ahead[1], ahead[0]) - np.arctan2(y, x)))  # clockwise from up
    way = "" if not needle else "x" if north is None else "N"
    return panel("scale", f"{100 * length / seen_m:.1f}", length_text(length), round(turn), way)


class ScaleBars:
    """Pieces of HTML that `templates/transport.js` moves into the scene."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._bars: dict[int, tuple[viser.GuiHtmlHandle, Changes]] = {}

    def draw(self, current: Snapshot) -> None:
        """Send changes, at most a few times a second. Called often."""
        clients = self._page.server.get_clients()
        found, needle = current.earth.found, not current.clip.unrolled
        north = np.array(found.reference.rotation)[1] if found is not None else None
        for gone in self._bars.keys() - clients.keys():
            del self._bars[gone]
        for number, client in clients.items():
            camera = client.camera
            html = scale_html(np.array(camera.position), np.array(camera.look_at), camera.fov, north, needle=needle)
            if number not in self._bars:
                self._bars[number] = client.gui.add_html(html), Changes(self._page.now, PANEL_PERIOD_S)
            shown, changes = self._bars[number]
            if changes(html):
                shown.content = html


class Looks:
    """The views of all browsers, which share one scene."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._above = server, True

    @property
    def from_above(self) -> bool:
        """Whether any browser looks from above, where ceilings would hide the rooms."""
        slopes = []
        for client in self._server.get_clients().values():
            back = np.array(client.camera.position) - client.camera.look_at
            slopes.append(float(np.degrees(np.arctan2(back[2], np.hypot(back[0], back[1])))))
        if slopes:
            self._above = max(slopes) > (_SHOWN_DEG if self._above else _HIDDEN_DEG)
        return self._above
