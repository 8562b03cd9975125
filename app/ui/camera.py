"""Where a browser's camera stands: the whole map, from above or the side, without perspective, and kept views."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import viser

from app.server.protocol import KeepView, Snapshot
from app.slam.types import F64
from app.ui.widgets import Changes, Page, by_user, show

FOV: Final = float(np.radians(60.0))
_NARROW: Final = float(np.radians(2.0))
"""viser has no parallel projection: from far away, through a narrow lens, lines stay parallel to the eye."""
_SHARE: Final = 2.0
"""Percent of the points at each end that a fitted view may leave out."""
_LEAST_M: Final = 4.0
_FAR: Final = 10.0
"""What lies behind the map by so many distances is drawn too."""
FIT, PLAN, TOP, FRONT, SIDE = "fit", "plan", "top", "front", "side"
_WAYS: Final[dict[str, tuple[float, float, float]]] = {
    FIT: (-0.55, -0.55, 0.75),
    PLAN: (0.0, -1e-3, 1.0),
    TOP: (0.0, -1e-3, 1.0),
    FRONT: (0.0, -1.0, 0.05),
    SIDE: (-1.0, 0.0, 0.05),
}
"""From the map's middle towards the camera."""
_EASE: Final = 0.2
"""Share of the way to the newest extent of the map that cameras go per drawing, so that they glide as it grows."""
_ARRIVED: Final = 0.01
"""So near, as a share of the map's size, cameras rest."""
_PUT: Final = 300
"""Places of cameras that are remembered: a slow browser says late where its camera was put."""
_FOLLOWED_FROM_M: Final = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """Where a camera is and what it looks at, (3,) each, in the map."""

    position: F64
    look_at: F64


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """A ball around a map: middle (3,) and radius, m."""

    middle: F64
    radius: float

    def towards(self, other: "Extent", share: float) -> "Extent":
        return Extent(
            self.middle + share * (other.middle - self.middle), self.radius + share * (other.radius - self.radius)
        )

    def apart(self, other: "Extent") -> float:
        """How far the other one is off, as a share of this one's size."""
        return float(np.linalg.norm(other.middle - self.middle) + abs(other.radius - self.radius)) / self.radius


_MAP: Final = np.eye(3)
NOTHING: Final = Extent(np.array([0.3, 0.2, -0.6]), 5.0)
"""What is looked at before there is a map: around the sensor."""


def extent(points: F64) -> Extent:
    """The ball around all of (n, 3) points but a few far ones."""
    if not len(points):
        return NOTHING
    low, high = np.percentile(points, (_SHARE, 100 - _SHARE), axis=0)
    return Extent((low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, _LEAST_M))


def whole(map_: Extent, way: str = FIT, fov: float = FOV, axes: F64 = _MAP) -> Stand:
    """From where all of it is seen. fov: rad, of the picture's smaller side. axes: (3, 3) columns, those of a way."""
    towards = axes @ _WAYS[way]
    distance = 1.05 * map_.radius / np.tan(fov / 2)
    return Stand(map_.middle + towards / np.linalg.norm(towards) * distance, map_.middle)


class Framing:
    """Keeps the whole map in the picture of every browser while it grows, until its user looks elsewhere."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.north = np.array([0.0, 1.0])  # in the map, which is up in plans
        self._ways: dict[int, str] = {}  # from which side browsers look; FIT unless it was chosen
        self._put: deque[F64] = deque(maxlen=_PUT)
        self._wanted = self._shown = NOTHING
        self._at_once = False
        self._pictures = self.pictures
        server.initial_camera.fov = FOV
        self._begin(np.zeros(3))

    def see(self, points: F64, *, at_once: bool) -> None:
        """Take in some points of the map, (n, 3); at_once: it is another map."""
        self._wanted, self._at_once = extent(points), at_once

    @property
    def pictures(self) -> frozenset[tuple[int, float]]:
        """Number and width over height of each browser's picture."""
        return frozenset((number, _shape(client)) for number, client in self._server.get_clients().items())

    def draw(self, offset: F64) -> bool:
        """Move the cameras on; False while they are on their way. offset: (3,) m, of the map in the scene."""
        before, self._pictures = self._pictures, self.pictures
        if not self._at_once and self._shown.apart(self._wanted) < _ARRIVED and self._pictures == before:
            return True
        self._shown = self._wanted if self._at_once else self._shown.towards(self._wanted, _EASE)
        self._at_once = False
        clients = {number: client for number, client in self._server.get_clients().items() if self._untouched(client)}
        self._begin(offset)
        for number, client in clients.items():
            self._place(client, self._ways.get(number, FIT), offset)
        return False

    def show(self, client: viser.ClientHandle, way: str, offset: F64) -> None:
        """Let a browser look at the whole map from one side, and keep doing so."""
        self._shown = self._wanted
        self._ways[client.client_id] = way
        self._place(client, way, offset)

    def follow(self) -> None:
        """Let every browser look at the sensor, which is kept at the scene's origin."""
        for client in self._server.get_clients().values():
            camera = client.camera
            back = np.array(camera.position) - camera.look_at
            back *= min(1.0, _FOLLOWED_FROM_M / max(float(np.linalg.norm(back)), 1e-6))
            with client.atomic():
                camera.position, camera.look_at = back, np.zeros(3)

    def _begin(self, offset: F64) -> None:
        """Where pages that open later look from."""
        stand, camera = whole(self._shown), self._server.initial_camera
        camera.position, camera.look_at = stand.position + offset, stand.look_at + offset
        self._put.append(camera.position)

    def _place(self, client: viser.ClientHandle, way: str, offset: F64) -> None:
        camera = client.camera
        x, y = self.north
        north_up = np.array([[y, x, 0.0], [-x, y, 0.0], [0.0, 0.0, 1.0]])
        narrow = 2 * np.arctan(np.tan(camera.fov / 2) * min(_shape(client), 1.0))
        stand = whole(self._shown, way, float(narrow), north_up if way in (PLAN, TOP) else _MAP)
        move(client, Stand(stand.position + offset, stand.look_at + offset))
        self._put.append(stand.position + offset)

    def _untouched(self, client: viser.ClientHandle) -> bool:
        """Whether the browser's camera is where it was put."""
        off = np.linalg.norm(np.array(self._put) - client.camera.position, axis=1)
        return bool(off.min() < 1e-3 * self._shown.radius)


def _shape(client: viser.ClientHandle) -> float:
    """Width over height of a browser's picture."""
    camera = client.camera
    return round(max(camera.image_width, 1) / max(camera.image_height, 1), 2) or 0.01


def move(client: viser.ClientHandle, stand: Stand) -> None:
    """Put a browser's camera somewhere in the scene, and its clipping planes around what it sees."""
    camera, distance = client.camera, float(np.linalg.norm(stand.position - stand.look_at))
    with client.atomic():
        camera.far, camera.near = _FAR * max(distance, 100.0), max(distance / 1e4, 0.01)
        camera.position, camera.look_at = stand.position, stand.look_at


class CameraPanel:
    """Buttons that move the camera of the browser they are clicked in.

    Args:
        framing: keeps the whole map in the picture. look_freely: stops following the sensor.
    """

    def __init__(self, page: Page, framing: Framing, look_freely: Callable[[viser.ClientHandle], None]) -> None:
        gui = page.gui
        self._page, self._framing, self._look_freely = page, framing, look_freely
        self._changes = Changes()
        ways = gui.add_button_group(
            "camera",
            tuple(_WAYS),
            hint="The whole map, also while it grows; G fits it. A plan is orthographic, north up.",
        )
        ways.on_click(by_user(self.look))
        self._parallel = gui.add_checkbox(
            "orthographic", False, hint="Parallel lines stay parallel, and lengths can be compared."
        )
        self._parallel.on_update(by_user(lambda _, client: self._go(client, self._stand(client))))
        keep = gui.add_button("Keep this view", icon=viser.Icon.BOOKMARK, color="gray")
        keep.on_click(by_user(lambda _, client: self._keep(client)))
        self._list = gui.add_button_group(
            "kept views", ("1",), visible=False, hint="Go back to a view that was kept in this session."
        )
        self._list.on_click(by_user(lambda name, client: self._return(client, int(name) - 1)))
        gui.add_command("Frame the whole map", hotkey="G").on_trigger(
            lambda event: self.look(FIT, event.client) if event.client else None
        )

    def look(self, way: str, client: viser.ClientHandle) -> None:
        """Show the whole map from one side, also as it grows."""
        self._look_freely(client)
        if way == PLAN:
            show(self._parallel, True)
            client.camera.fov = _NARROW
        self._framing.show(client, way, self._page.offset())

    def face(self, client: viser.ClientHandle, middle: F64, size: tuple[float, float], axes: F64 = _MAP) -> None:
        """Look at something from its front, without perspective.

        Args:
            middle: (3,) m, map. size: m, width and height. axes: (3, 3), its own, as columns.
        """
        self._look_freely(client)
        show(self._parallel, True)
        half = 0.6 * max(size[1], size[0] / _shape(client), 1.0)
        self._go(client, Stand(middle - axes[:, 1] * half / np.tan(FOV / 2), middle))

    def _stand(self, client: viser.ClientHandle) -> Stand:
        """Where the usual lens would show what this camera shows."""
        camera = client.camera
        back = (np.array(camera.position) - camera.look_at) * np.tan(camera.fov / 2) / np.tan(FOV / 2)
        look_at = np.array(camera.look_at) - self._page.offset()
        return Stand(look_at + back, look_at)

    def draw(self, snapshot: Snapshot) -> None:
        """Offer the views that the session keeps."""
        found = snapshot.earth.found
        north = np.array(found.reference.rotation)[1, :2] if found is not None else np.array([0.0, 1.0])
        self._framing.north = north / np.linalg.norm(north)
        if self._changes(snapshot.views):
            self._list.visible = bool(snapshot.views)
            self._list.options = tuple(str(number + 1) for number in range(len(snapshot.views))) or ("1",)

    def _keep(self, client: viser.ClientHandle) -> None:
        stand = self._stand(client)
        x, y, z = stand.position.tolist()
        at_x, at_y, at_z = stand.look_at.tolist()
        self._page.send(KeepView(((x, y, z), (at_x, at_y, at_z))))

    def _return(self, client: viser.ClientHandle, number: int) -> None:
        views = self._page.snapshot().views
        if number < len(views):
            self._look_freely(client)
            self._go(client, Stand(*map(np.array, views[number])))

    def _go(self, client: viser.ClientHandle, stand: Stand) -> None:
        """Move a camera to a stand that is meant for the usual lens."""
        fov = _NARROW if self._parallel.value else FOV
        offset, back = self._page.offset(), (stand.position - stand.look_at) * np.tan(FOV / 2) / np.tan(fov / 2)
        client.camera.fov = fov
        move(client, Stand(stand.look_at + back + offset, stand.look_at + offset))
