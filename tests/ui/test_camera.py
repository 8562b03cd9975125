"""The positions of cameras and the shading of points.

Tests app/ui/camera.py, app/ui/scale.py, app/ui/shading.py.
"""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from app.server.keeping import KeepView
from app.server.protocol import Command, Snapshot
from app.slam import lie
from app.ui.camera import (
    FIT,
    FOV,
    FRONT,
    NOTHING,
    OBLIQUE,
    PLAN,
    SIDE,
    TOP,
    CameraPanel,
    Framing,
    Picture,
    Stand,
    whole,
)
from app.ui.colours import INTENSITY, LOOK, Limits, PointSet, colours
from app.ui.scale import Looks, bar, scale_html
from app.ui.shading import light
from tests.ui.conftest import page_of

RANDOM = np.random.default_rng(3)
HALL = RANDOM.uniform((-10, 5, 0), (50, 25, 6), (4000, 3))


WIDE = Picture(shape=1.6, covered=0.08)
"""As on a desk: the transport hides the lowest part."""


def seen(points: np.ndarray, stand: Stand, picture: Picture) -> np.ndarray:
    """(n, 2) where points are in a picture, each axis from -1 to 1, up positive."""
    forward = (stand.look_at - stand.position) / stand.distance
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    off = points - stand.position
    at = np.stack((off @ right / picture.shape, off @ np.cross(right, forward)), axis=1)
    return np.asarray(at / (off @ forward)[:, None] / np.tan(picture.fov / 2))


@pytest.mark.parametrize("picture", [WIDE, Picture(shape=0.6), Picture(fov=0.03)])
@pytest.mark.parametrize("way", [OBLIQUE, TOP, FRONT, SIDE])
def test_all_of_a_hall_but_far_points_just_fills_the_picture(way: str, picture: Picture) -> None:
    def outside(stand: Stand) -> list[float]:
        """The share of points beyond each edge."""
        across, up = seen(HALL, stand, picture).T
        bottom = -1 + 2 * picture.covered
        return [float(np.mean(beyond)) for beyond in (across < -1, across > 1, up < bottom, up > 1)]

    stand = whole(np.concatenate((HALL, [[900.0, 0.0, 0.0]])), way, picture)
    assert max(outside(stand)) < 0.002, "as little as a wall's edge would be seen to be missing"
    nearer = Stand(stand.position + 0.2 * (stand.look_at - stand.position), stand.look_at)
    lost = outside(nearer)
    assert min(lost[:2]) > 0.01 or min(lost[2:]) > 0.01, "it fills the picture, between two edges at least"


def test_from_above_one_looks_down_and_from_the_front_along_the_floor() -> None:
    for way, least, most in ((TOP, 10.0, np.inf), (FRONT, 0.0, 0.1)):
        back = (stand := whole(HALL, way)).position - stand.look_at
        assert least <= back[2] / np.linalg.norm(back[:2]) < most


def test_an_empty_map_is_looked_at_from_above_the_sensor() -> None:
    assert whole(NOTHING).position[2] > 2.0


def plane(normal: int) -> np.ndarray:
    points = RANDOM.uniform(-3, 3, (3000, 3)).astype(np.float32)
    points[:, normal] = 1.0
    return points


def test_floors_are_brighter_than_walls_and_walls_at_right_angles_differ() -> None:
    x, y, floor = (float(np.median(light(plane(axis), np.eye(4)))) for axis in range(3))
    assert floor > y + 0.05 > x + 0.1


def test_a_floor_is_as_bright_however_the_sensor_is_held() -> None:
    turned = lie.transform(lie.exp(np.array([1.1, -0.4, 0.3])), np.zeros(3))
    seen = (plane(2) @ turned[:3, :3]).astype(np.float32)  # in the sensor's frame
    assert np.median(light(seen, turned)) == pytest.approx(np.median(light(plane(2), np.eye(4))), abs=0.01)


def test_points_on_no_surface_are_darker_and_few_points_are_lit_alike() -> None:
    leaves = RANDOM.uniform(-1, 1, (3000, 3)).astype(np.float32)
    assert np.median(light(leaves, np.eye(4))) < np.median(light(plane(2), np.eye(4)))
    assert len(set(light(leaves[:5], np.eye(4)))) == 1 and len(light(leaves[:0], np.eye(4))) == 0


def test_a_wall_is_lit_evenly_however_far_it_is() -> None:
    """Its points lie farther apart with distance, and so the cells grow."""
    near = plane(1) * np.float32(0.5)
    for distance in (1.0, 4.0, 20.0, 60.0):
        assert np.ptp(np.percentile(light(near * np.float32(distance), np.eye(4)), (5, 95))) < 0.02


def test_by_height_and_intensity_what_reflects_more_is_brighter_and_ground_is_tinted() -> None:
    points = np.zeros((3, 3), np.float32)
    labels, intensity = np.array([0, 0, 1], np.uint8), np.array([0, 255, 255], np.float32)
    cloud = PointSet(points, labels, intensity, np.zeros(3, np.uint16), np.eye(4), 0.0)
    dull, shiny, ground = colours(cloud, LOOK, {LOOK: Limits(-1, 3), INTENSITY: Limits(0, 255)}).astype(int)
    assert (shiny > dull).all()
    assert ground[1] - ground[0] > shiny[1] - shiny[0], "towards teal"


class Browser:
    """A browser's camera, which is where it was put unless its user moves it."""

    def __init__(self, position: np.ndarray) -> None:
        self.client_id = 1
        self.camera = SimpleNamespace(
            position=position, look_at=np.zeros(3), fov=FOV, image_width=1600, image_height=1000
        )

    atomic = staticmethod(nullcontext)

    def distance(self) -> float:
        return float(np.linalg.norm(self.camera.position - self.camera.look_at))


class Server:
    def __init__(self) -> None:
        self.initial_camera, self.browsers = SimpleNamespace(), dict[int, Browser]()

    def get_clients(self) -> dict[int, Browser]:
        return self.browsers


Framed = tuple[Framing, Browser, Server]


@pytest.fixture
def framed() -> Framed:
    """A hall that one has begun to see, and a browser."""
    server = Server()
    framing = Framing(server)  # type: ignore[arg-type]
    server.browsers[1] = Browser(server.initial_camera.position)
    framing.see(HALL / 4, at_once=True)
    framing.draw(np.zeros(3))
    return framing, server.browsers[1], server


def settle(framing: Framing) -> int:
    """How many drawings cameras need until they rest."""
    return next(n for n in range(100) if framing.draw(np.zeros(3)))


def test_the_map_stays_in_the_picture_as_it_grows(framed: Framed) -> None:
    framing, browser, server = framed
    near = browser.distance()
    assert browser.camera.position == pytest.approx(whole(HALL / 4, OBLIQUE, WIDE).position)
    framing.see(HALL, at_once=False)
    assert settle(framing) > 5, "it glides"
    assert browser.distance() == pytest.approx(4 * near, rel=0.05)
    assert server.initial_camera.position == pytest.approx(whole(HALL).position), "pages that open now"


def test_the_map_stays_above_what_covers_the_scene(framed: Framed) -> None:
    framing, browser, _ = framed
    framing.cover("cover 30", browser)  # type: ignore[arg-type]
    settle(framing)
    assert browser.camera.position == pytest.approx(whole(HALL / 4, OBLIQUE, Picture(shape=1.6, covered=0.3)).position)
    stood = browser.camera.position
    browser.camera.image_width, browser.camera.image_height = 800, 500
    settle(framing)
    assert browser.camera.position == pytest.approx(stood), "the page draws in pixels of another size"


def test_in_a_picture_that_is_higher_than_wide_all_of_the_map_is_seen_too(framed: Framed) -> None:
    framing, browser, _ = framed
    wide = browser.distance()
    browser.camera.image_width = 580
    settle(framing)
    stand, picture = Stand(browser.camera.position, browser.camera.look_at), Picture(shape=0.58, covered=0.08)
    assert (np.abs(seen(HALL / 4, stand, picture)) < 1).mean() > 0.97 and stand.distance > 1.5 * wide
    browser.camera.image_width = 1600
    settle(framing)
    assert browser.distance() == pytest.approx(wide), "a phone that is turned"


def test_who_moves_the_camera_keeps_it_until_he_asks_for_the_whole_map(framed: Framed) -> None:
    framing, browser, _ = framed
    browser.camera.position = browser.camera.position + 0.5
    mine = browser.camera.position
    framing.see(HALL, at_once=False)
    settle(framing)
    assert (browser.camera.position == mine).all()
    framing.show(browser, TOP, np.zeros(3))  # type: ignore[arg-type]
    assert browser.camera.look_at == pytest.approx(whole(HALL, TOP, WIDE).look_at)
    framing.see(2 * HALL, at_once=False)
    settle(framing)
    assert browser.camera.position == pytest.approx(whole(2 * HALL, TOP, WIDE).position)


def test_a_camera_that_is_sent_elsewhere_stays_there_though_its_browser_is_slow(framed: Framed) -> None:
    framing, browser, _ = framed
    put = browser.camera.position
    framing.leave(browser)  # type: ignore[arg-type]
    browser.camera.position = put  # what the browser says before it knows of the new place
    framing.see(HALL, at_once=False)
    assert framing.draw(np.zeros(3)) and browser.camera.position is put
    framing.show(browser, FIT, np.zeros(3))  # type: ignore[arg-type]
    assert browser.camera.position == pytest.approx(whole(HALL, OBLIQUE, WIDE).position)


def test_following_looks_at_the_sensor_from_nearby(framed: Framed) -> None:
    framing, browser, _ = framed
    framing.show(browser, TOP, np.zeros(3))  # type: ignore[arg-type]
    framing.follow()
    assert (browser.camera.look_at == 0).all() and 5 < browser.distance() < 30


def test_to_fit_keeps_the_plan_and_another_side_ends_it(server: viser.ViserServer, framed: Framed) -> None:
    framing, browser, _ = framed
    panel = CameraPanel(page_of(server), framing, lambda _: None)
    panel.look(PLAN, browser)  # type: ignore[arg-type]
    plan = browser.camera.position.copy()
    browser.camera.position = browser.camera.position + np.array([5.0, 0.0, 0.0])
    panel.look(FIT, browser)  # type: ignore[arg-type]
    assert browser.camera.position == pytest.approx(plan) and browser.camera.fov < 0.1
    panel.look(OBLIQUE, browser)  # type: ignore[arg-type]
    assert browser.camera.fov == FOV


def test_each_browser_has_a_lens_of_its_own(server: viser.ViserServer, framed: Framed) -> None:
    framing, mine, own = framed
    own.browsers[2] = other = Browser(mine.camera.position)
    other.client_id = 2
    panel = CameraPanel(page_of(server), framing, lambda _: None)
    panel.look(PLAN, mine)  # type: ignore[arg-type]
    panel.look(OBLIQUE, other)  # type: ignore[arg-type]
    assert mine.camera.fov < 0.1 and other.camera.fov == FOV
    panel.look(OBLIQUE, mine)  # type: ignore[arg-type]
    assert mine.camera.fov == FOV
    panel._choose_lens("orthographic", mine)  # type: ignore[arg-type]
    panel.look(PLAN, mine)  # type: ignore[arg-type]
    panel.look(OBLIQUE, mine)  # type: ignore[arg-type]
    assert mine.camera.fov < 0.1 and other.camera.fov == FOV, "a lens that a person chose stays"


def test_the_floor_of_a_section_is_above_what_covers_the_scene(server: viser.ViserServer, framed: Framed) -> None:
    framing, browser, _ = framed
    framing.cover("cover 30", browser)  # type: ignore[arg-type]
    panel = CameraPanel(page_of(server), framing, lambda _: None)
    panel.face(browser, np.array([5.0, 2.0, 4.0]), (3.0, 8.0))  # type: ignore[arg-type]
    stand, picture = Stand(browser.camera.position, browser.camera.look_at), Picture(browser.camera.fov, 1.6, 0.3)
    floor, ceiling = seen(np.array([[5.0, 2.0, 0.0], [5.0, 2.0, 8.0]]), stand, picture)[:, 1]
    assert -0.4 < floor < -0.2 and 0.8 < ceiling < 1.0


def test_a_view_is_kept_in_the_session_and_gone_back_to(server: viser.ViserServer, framed: Framed) -> None:
    framing, browser, _ = framed
    browser.camera.position, browser.camera.look_at = np.array([3.0, 4.0, 20.0]), np.array([3.0, 0.0, 1.0])
    sent: list[Command] = []
    kept = ((3.0, 4.0, 20.0), (3.0, 0.0, 1.0))
    panel = CameraPanel(page_of(server, sent.append, lambda: Snapshot(views=(kept,))), framing, lambda _: None)
    panel._keep(browser)  # type: ignore[arg-type]
    assert sent == [KeepView(kept)]
    panel.draw(Snapshot(views=(kept, kept)))
    assert panel._list.visible and panel._list.options == ("1", "2")
    browser.camera.position = np.zeros(3)
    panel._return(browser, 0)  # type: ignore[arg-type]
    assert browser.camera.position == pytest.approx(kept[0]) and browser.camera.look_at == pytest.approx(kept[1])
    panel.draw(Snapshot())
    assert not panel._list.visible, "in another session"


@pytest.mark.parametrize(("seen_m", "bar_m"), [(100.0, 10.0), (40.0, 5.0), (6.4, 1.0), (1.3, 0.2), (4000.0, 500.0)])
def test_the_scale_bar_is_a_round_length_that_fits(seen_m: float, bar_m: float) -> None:
    assert bar(seen_m) == pytest.approx(bar_m)
    assert 0.06 < bar(seen_m) / seen_m <= 0.16


def test_the_bar_measures_the_middle_of_the_picture_and_the_needle_points_along_x() -> None:
    down = scale_html(np.array([0.0, -1e-3, 50.0]), np.zeros(3), FOV)  # 57.7 m are seen, y is up in the picture
    assert ">5 m<" in down and "width:8.7vh" in down and "rotate(90)" in down
    assert "rotate(0)" in scale_html(np.array([-30.0, 0.0, 1.0]), np.zeros(3), FOV), "looking along x, it is ahead"
    profile = scale_html(np.array([0.0, -50.0, 0.0]), np.zeros(3), FOV, needle=False)
    assert ">5 m<" in profile and "svg" not in profile, "a path bends, so that no direction is north"


def test_ceilings_go_where_one_looks_from_above_and_come_back_inside() -> None:
    server = Server()
    looks = Looks(server)  # type: ignore[arg-type]
    assert looks.from_above, "so that a map opens without them"
    seen = []
    for degrees in (60, 15, 5, 15, 30):
        back = np.array([np.cos(np.radians(degrees)), 0.0, np.sin(np.radians(degrees))])
        server.browsers[1] = Browser(9 * back)
        seen.append(looks.from_above)
    assert seen == [True, True, False, False, True], "not to and fro in between"
