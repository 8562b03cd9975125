"""The camera of each browser: views of the whole map, from above or the side, orthographic views, and kept views."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import viser

from app.server.keeping import MOST_VIEWS, KeepView
from app.server.protocol import Snapshot
from app.slam.types import F64
from app.ui.widgets import Changes, Page, add_button, add_command, by_user

FOV: Final = float(np.radians(60.0))
_NARROW: Final = float(np.radians(2.0))
"""viser has no orthographic projection; a narrow field of view from far away looks nearly the same."""
_LENSES: Final = {"perspective": FOV, "orthographic": _NARROW}
_LEFT_OUT: Final = 0.1
"""Percent of the points that may lie beyond each edge of a fitted view: a few far points would shrink the rest."""
_LEAST_M: Final = 4.0
_SOME: Final = 20_000
"""Points of the map that a view is fitted to."""
_BAR: Final = 8
"""Percent of the scene's height, at its lower edge, that the transport covers until the page reports it."""
_FAR: Final = 10.0
"""The far clipping plane, as a multiple of the distance to the middle of the map."""
FIT, OBLIQUE, PLAN, TOP, FRONT, SIDE = "fit", "3D", "plan", "top", "front", "side"
"""FIT keeps the direction of the present view."""
_WAYS: Final[dict[str, tuple[float, float, float]]] = {
    OBLIQUE: (-0.55, -0.55, 0.75),
    PLAN: (0.0, -1e-3, 1.0),
    TOP: (0.0, -1e-3, 1.0),
    FRONT: (0.0, -1.0, 0.05),
    SIDE: (-1.0, 0.0, 0.05),
}
"""Directions from the map's middle towards the camera."""
_EASE: Final = 0.2
"""Share of the way to the newest fitted view that cameras move per drawing, so that they glide as the map grows."""
_ARRIVED: Final = 0.01
"""A camera that is nearer to its goal than this share of the distance to the map has arrived."""
_PUT: Final = 300
"""How many camera positions are remembered: a slow browser reports late where its camera was put."""
_FOLLOWED_FROM_M: Final = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """Position of a camera and the point that it looks at, (3,) each, in the map."""

    position: F64
    look_at: F64

    @property
    def distance(self) -> float:
        return float(np.linalg.norm(self.position - self.look_at))

    def towards(self, other: "Stand", share: float) -> "Stand":
        """A stand this share of the way to another one, or the other one itself if little is left."""
        ways = other.position - self.position, other.look_at - self.look_at
        if max(float(np.linalg.norm(way)) for way in ways) < _ARRIVED * other.distance:
            return other
        return Stand(self.position + share * ways[0], self.look_at + share * ways[1])


@dataclass(frozen=True, slots=True)
class Picture:
    """The picture in which a browser shows the scene.

    Attributes:
        fov: rad, vertical field of view. shape: width over height. covered: share of its height hidden at the bottom.
    """

    fov: float = FOV
    shape: float = 1.0
    covered: float = 0.0


_MAP: Final = np.eye(3)
NOTHING: Final[F64] = np.array([0.3, 0.2, -0.6]) + 2.5 * np.array(list(product((-1.0, 1.0), repeat=3)))
"""Points around the sensor, to look at before there is a map."""


def whole(points: F64, way: str = OBLIQUE, picture: Picture = Picture(), axes: F64 = _MAP) -> Stand:
    """The stand from which nearly all of (n, 3) points just fill a picture. axes: (3, 3), to which `way` refers."""
    towards = axes @ _WAYS[way] / np.linalg.norm(_WAYS[way])
    right = np.cross((0.0, 0.0, 1.0), towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    middle = np.median(points, axis=0)
    x, y, z = ((points - middle) @ axis for axis in (right, up, towards))
    high = float(np.tan(picture.fov / 2))
    wide, hidden = high * picture.shape, 2 * high * picture.covered
    across, back_x = _between(x, z, wide, wide)
    upwards, back_y = _between(y, z, high, high - hidden)
    distance = 1.05 * max(back_x, back_y, _LEAST_M / min(high, wide))
    look_at = middle + across * right + (upwards - hidden / 2 * (distance - back_y)) * up
    return Stand(look_at + distance * towards, look_at)


def _between(across: F64, near: F64, one: float, other: float) -> tuple[float, float]:
    """Position of a camera's axis and the camera's distance, so that points lie between two edges of its picture.

    Args:
        across, near: (n,) m, to one side and towards the camera. one, other: tangents of that side's edge and of the
            opposite one.
    """
    first, second = (float(np.percentile(near + at, 100 - _LEFT_OUT)) for at in (across / one, -across / other))
    return (first - second) * one * other / (one + other), (first * one + second * other) / (one + other)


class Framing:
    """Keeps the whole growing map in the picture of every browser, until its user looks elsewhere."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.north = np.array([0.0, 1.0])  # direction in the map; it points up in plans
        self._ways: dict[int, str] = {}  # directions from which browsers look; OBLIQUE unless chosen
        self._put: deque[F64] = deque(maxlen=_PUT)
        self._points, self._at_once = NOTHING, False
        self._fitted: dict[tuple[object, ...], Stand] = {}
        self._stands: dict[int, Stand] = {}  # of each browser, as last shown
        self._left: set[int] = set()  # browsers whose cameras were sent elsewhere
        self._covered: dict[int, int] = {}  # percent hidden of the height of each browser's scene
        server.initial_camera.fov = FOV
        self._begin(np.zeros(3))

    def see(self, points: F64, *, at_once: bool) -> None:
        """Take some points of the map, (n, 3). at_once: jump, since this is another map."""
        self._points = points[:: len(points) // _SOME + 1] if len(points) else NOTHING
        self._at_once |= at_once
        self._fitted.clear()

    @property
    def pictures(self) -> frozenset[tuple[int, Picture]]:
        """Number and picture of each browser."""
        return frozenset((number, self.picture(client)) for number, client in self._server.get_clients().items())

    def draw(self, offset: F64) -> bool:
        """Move the cameras. Returns False while they are on their way. offset: (3,) m, of the map in the scene."""
        at_once, self._at_once = self._at_once, False
        clients = self._server.get_clients()
        moving = False
        for number, client in clients.items():
            wanted = self._whole(client)
            shown = self._stands.get(number)
            if shown is not wanted and number not in self._left and self._untouched(client):
                there = wanted if shown is None or at_once else shown.towards(wanted, _EASE)
                self._place(client, there, offset)
                moving = True
        self._begin(offset)
        return not moving

    def show(self, client: viser.ClientHandle, way: str, offset: F64) -> None:
        """Let a browser look at the whole map from one side, also as the map grows."""
        if way != FIT:
            self._ways[client.client_id] = way
        self._left.discard(client.client_id)
        self._place(client, self._whole(client), offset)

    def leave(self, client: viser.ClientHandle) -> None:
        """Leave a browser's camera alone, since it is sent elsewhere; a slow browser may still report its old place."""
        self._left.add(client.client_id)

    def cover(self, word: str, client: viser.ClientHandle) -> None:
        """Keep the map above what hides the lower edge of a browser's scene, "cover 12" percent of its height."""
        if (percent := word.removeprefix("cover ")).isdecimal():
            self._covered[client.client_id] = int(percent)

    def picture(self, client: viser.ClientHandle) -> Picture:
        """The picture in which a browser shows the scene."""
        camera = client.camera
        width, height = max(camera.image_width, 1), max(camera.image_height, 1)
        shape = round(width / height, 2) or 0.01
        covered = self._covered.get(client.client_id, _BAR) / 100
        return Picture(camera.fov, shape, min(covered, 0.4))

    def follow(self) -> None:
        """Let every browser look at the sensor, which is kept at the scene's origin."""
        for client in self._server.get_clients().values():
            camera = client.camera
            back = np.array(camera.position) - camera.look_at
            back *= min(1.0, _FOLLOWED_FROM_M / max(float(np.linalg.norm(back)), 1e-6))
            with client.atomic():
                camera.position, camera.look_at = back, np.zeros(3)

    def _begin(self, offset: F64) -> None:
        """Set the view of pages that open later."""
        stand, camera = self._fit(OBLIQUE, Picture()), self._server.initial_camera
        position = stand.position + offset
        if not self._put or not np.array_equal(position, camera.position):
            camera.position, camera.look_at = position, stand.look_at + offset
            self._put.append(position)

    def _whole(self, client: viser.ClientHandle) -> Stand:
        return self._fit(self._ways.get(client.client_id, OBLIQUE), self.picture(client))

    def _fit(self, way: str, picture: Picture) -> Stand:
        """The fitted view: the same object as long as the map is the same."""
        x, y = self.north.tolist()
        key = way, picture, x, y
        if key not in self._fitted:
            north_up = np.array([[y, x, 0.0], [-x, y, 0.0], [0.0, 0.0, 1.0]])
            self._fitted[key] = whole(self._points, way, picture, north_up if way in (PLAN, TOP) else _MAP)
        return self._fitted[key]

    def _place(self, client: viser.ClientHandle, stand: Stand, offset: F64) -> None:
        self._stands[client.client_id] = stand
        move(client, Stand(stand.position + offset, stand.look_at + offset))
        self._put.append(stand.position + offset)

    def _untouched(self, client: viser.ClientHandle) -> bool:
        """Whether the browser's camera is where it was put."""
        off = np.linalg.norm(np.array(self._put) - client.camera.position, axis=1)
        return bool(off.min() < 1e-3 * np.linalg.norm(np.array(client.camera.position) - client.camera.look_at))


def move(client: viser.ClientHandle, stand: Stand) -> None:
    """Move a browser's camera in the scene, and set its clipping planes to fit what it sees."""
    camera, distance = client.camera, stand.distance
    with client.atomic():
        camera.far, camera.near = _FAR * max(distance, 100.0), max(distance / 1e4, 0.01)
        camera.position, camera.look_at = stand.position, stand.look_at


class CameraPanel:
    """Buttons that move the camera of the browser they are clicked in.

    Args:
        framing: keeps the whole map in the picture. look_freely: allows the camera to go elsewhere and stay there.
    """

    def __init__(self, page: Page, framing: Framing, look_freely: Callable[[viser.ClientHandle], None]) -> None:
        gui = page.gui
        self._page, self._framing, self._look_freely = page, framing, look_freely
        self._changes = Changes()
        self._made_parallel: set[int] = set()  # browsers that a plan or a section made orthographic
        ways = gui.add_button_group(
            "camera",
            (FIT, *_WAYS),
            hint="Show the whole map, even as it grows; G fits it from the same side. Plan: orthographic, north up.",
        )
        ways.on_click(by_user(self.look))
        lenses = gui.add_button_group(
            "lens", tuple(_LENSES), hint="Orthographic: parallel lines stay parallel, and lengths can be compared."
        )
        lenses.on_click(by_user(self._choose_lens))
        hint = f"Saved in the session, which keeps the newest {MOST_VIEWS}."
        add_button(gui, "Keep this view", self._keep, viser.Icon.BOOKMARK, hint=hint)
        self._list = gui.add_button_group(
            "kept views", ("1",), visible=False, hint="Return to a view that was saved in this session."
        )
        self._list.on_click(by_user(lambda name, client: self._return(client, int(name) - 1)))
        add_command(gui, "Frame the whole map", lambda client: self.look(FIT, client), hotkey="G")

    def look(self, way: str, client: viser.ClientHandle) -> None:
        """Show the whole map from one side, also as the map grows."""
        self._look_freely(client)
        if way == PLAN:
            self._make_parallel(client)
        elif way != FIT and client.client_id in self._made_parallel:
            self._made_parallel.remove(client.client_id)
            client.camera.fov = FOV
        self._framing.show(client, way, self._page.offset())

    def face(self, client: viser.ClientHandle, middle: F64, size: tuple[float, float], axes: F64 = _MAP) -> None:
        """Look at something from its front, in orthographic view.

        Args:
            middle: (3,) m, map. size: m, width and height. axes: (3, 3), the object's own axes as columns.
        """
        self._look_freely(client)
        self._make_parallel(client)
        picture = self._framing.picture(client)
        half = 0.6 * max(size[1] / (1 - picture.covered), size[0] / picture.shape, 1.0)
        look_at = middle - axes[:, 2] * half * picture.covered  # in the middle of the uncovered part
        self._go(client, Stand(look_at - axes[:, 1] * half / np.tan(FOV / 2), look_at))

    def _choose_lens(self, name: str, client: viser.ClientHandle) -> None:
        self._made_parallel.discard(client.client_id)
        stand = self._stand(client)
        client.camera.fov = _LENSES[name]
        self._go(client, stand)

    def _make_parallel(self, client: viser.ClientHandle) -> None:
        """Make the view orthographic until another side is chosen; if the user chose this lens, it stays."""
        if client.camera.fov > FOV / 2:
            self._made_parallel.add(client.client_id)
            client.camera.fov = _NARROW

    def _stand(self, client: viser.ClientHandle) -> Stand:
        """The stand from which the usual lens would show what this camera shows."""
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
        """Move a camera to a stand given for the usual lens."""
        back = (stand.position - stand.look_at) * np.tan(FOV / 2) / np.tan(client.camera.fov / 2)
        offset = self._page.offset()
        move(client, Stand(stand.look_at + back + offset, stand.look_at + offset))
