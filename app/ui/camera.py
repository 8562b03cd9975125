"""Where a browser's camera stands: the whole map, from above or the side, without perspective, and kept views."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from app.slam.types import F64
from app.ui.widgets import Page, by_user

FOV: Final = float(np.radians(60.0))
_NARROW: Final = float(np.radians(2.0))
"""viser has no parallel projection: from far away, through a narrow lens, lines stay parallel to the eye."""
_SHARE: Final = 2.0
"""Percent of the points at each end that a fitted view may leave out."""
_LEAST_M: Final = 4.0
_FAR: Final = 10.0
"""What lies behind the map by so many distances is drawn too."""
FIT, TOP, FRONT, SIDE = "fit", "top", "front", "side"
_WAYS: Final[dict[str, tuple[float, float, float]]] = {
    FIT: (-0.55, -0.55, 0.75),
    TOP: (0.0, -1e-3, 1.0),
    FRONT: (0.0, -1.0, 0.05),
    SIDE: (-1.0, 0.0, 0.05),
}
"""From the map's middle towards the camera."""
_MOST_KEPT: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """Where a camera is and what it looks at, (3,) each, in the map."""

    position: F64
    look_at: F64


def whole(points: F64, way: str = FIT, fov: float = FOV) -> Stand:
    """From where all of (n, 3) points are seen but for a few far ones. fov: rad, of the smaller side of the picture."""
    if not len(points):
        return Stand(np.array([-4.0, -4.0, 9.0]), np.array([0.3, 0.2, -0.6]))
    low, high = np.percentile(points, (_SHARE, 100 - _SHARE), axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, _LEAST_M)
    towards = np.array(_WAYS[way])
    middle = (low + high) / 2
    return Stand(middle + towards / np.linalg.norm(towards) * 1.1 * radius / np.tan(fov / 2), middle)


class CameraPanel:
    """Buttons that move the camera of the browser they are clicked in.

    Args:
        sample: some points of the map, (n, 3). look_freely: stops following the sensor.
    """

    def __init__(
        self, page: Page, sample: Callable[[], F64], look_freely: Callable[[viser.ClientHandle], None]
    ) -> None:
        gui = page.gui
        self._page, self._sample, self._look_freely = page, sample, look_freely
        self._kept: list[Stand] = []
        ways = gui.add_button_group("camera", tuple(_WAYS), hint="G frames the whole map.")
        ways.on_click(by_user(self.look))
        self._parallel = gui.add_checkbox(
            "orthographic", False, hint="Parallel lines stay parallel, and lengths can be compared."
        )
        self._parallel.on_update(by_user(lambda _, client: self._go(client, self._stand(client))))
        keep = gui.add_button("Keep this view", icon=viser.Icon.BOOKMARK, color="gray")
        keep.on_click(by_user(lambda _, client: self._keep(client)))
        self._list = gui.add_button_group("kept views", ("1",), visible=False, hint="Go back to a view that was kept.")
        self._list.on_click(by_user(lambda name, client: self._go(client, self._kept[int(name) - 1])))
        gui.add_command("Frame the whole map", hotkey="G").on_trigger(
            lambda event: self.look(FIT, event.client) if event.client else None
        )

    def look(self, way: str, client: viser.ClientHandle) -> None:
        """Show the whole map from one side."""
        if way != FIT:
            self._look_freely(client)
        self._go(client, whole(self._sample(), way))

    def _stand(self, client: viser.ClientHandle) -> Stand:
        """Where the usual lens would show what this camera shows."""
        camera = client.camera
        back = (np.array(camera.position) - camera.look_at) * np.tan(camera.fov / 2) / np.tan(FOV / 2)
        look_at = np.array(camera.look_at) - self._page.offset()
        return Stand(look_at + back, look_at)

    def _keep(self, client: viser.ClientHandle) -> None:
        self._kept = [*self._kept, self._stand(client)][-_MOST_KEPT:]
        self._list.options = tuple(str(number + 1) for number in range(len(self._kept)))
        self._list.visible = True

    def _go(self, client: viser.ClientHandle, stand: Stand) -> None:
        """Move a camera to a stand that is meant for the usual lens."""
        fov = _NARROW if self._parallel.value else FOV
        offset, back = self._page.offset(), (stand.position - stand.look_at) * np.tan(FOV / 2) / np.tan(fov / 2)
        camera = client.camera
        with client.atomic():
            distance = float(np.linalg.norm(back))
            camera.fov, camera.far, camera.near = fov, _FAR * max(distance, 100.0), distance / 1e4
            camera.position, camera.look_at = stand.look_at + back + offset, stand.look_at + offset
