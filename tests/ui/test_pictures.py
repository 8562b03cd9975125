"""Pictures and flights. Tests app/ui/pictures.py, app/ui/picture_maths.py."""

import io
import itertools
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from PIL import Image
from scipy.spatial.transform import Rotation

from app.server.protocol import OpenedRecording, Snapshot
from app.ui.camera import FOV
from app.ui.colours import HEIGHT, LOOK, Key, Limits, key
from app.ui.picture_maths import BACKGROUND, composed, flight, looking
from app.ui.pictures import PicturesPanel
from app.ui.widgets import by_user
from tests.ui.conftest import finish, page_of

CORNER = np.array([[0.0, 0.0, 1.5], [20.0, 0.0, 1.5], [20.0, 10.0, 1.5]])


def ahead_of(wxyz: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(wxyz, -1)).apply([0.0, 0.0, 1.0])


def test_a_flight_goes_evenly_along_the_path_and_looks_ahead() -> None:
    stations = flight(CORNER, 31, 0.0, 0.0)
    positions = np.array([one.position for one in stations])
    assert positions[0] == pytest.approx(CORNER[0], abs=0.7) and positions[-1] == pytest.approx(CORNER[-1], abs=0.7)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert len(stations) == 31 and steps == pytest.approx(np.full(30, 1.0), abs=0.25)
    assert ahead_of(stations[5].wxyz) == pytest.approx([1, 0, 0], abs=0.02)
    assert ahead_of(stations[-1].wxyz) == pytest.approx([0, 1, 0], abs=0.1)
    turns = [
        np.degrees(np.arccos(np.clip(ahead_of(a.wxyz) @ ahead_of(b.wxyz), -1, 1)))
        for a, b in itertools.pairwise(stations)
    ]
    assert max(turns) < 25, "the corner is rounded"


def test_a_camera_behind_and_above_looks_down_at_the_path() -> None:
    first, *_ = flight(CORNER, 5, 5.0, 3.0)
    assert first.position == pytest.approx([-5.0, 0.0, 4.5], abs=0.7)
    assert ahead_of(first.wxyz)[2] < -0.2 and ahead_of(first.wxyz)[0] > 0.9


def test_somebody_who_stands_still_or_climbs_is_flown_along_too() -> None:
    for path in (np.zeros((5, 3)), np.column_stack([np.zeros((9, 2)), np.arange(9.0)])):
        assert all(np.isfinite(one.position).all() and np.isfinite(one.wxyz).all() for one in flight(path, 7, 5.0, 3.0))


def test_cameras_are_upright_also_where_they_look_straight_down() -> None:
    for ahead in ([1.0, 2.0, -0.5], [0.0, 0.0, -1.0]):
        R = looking(np.array(ahead))
        assert pytest.approx(np.eye(3)) == R @ R.T and np.linalg.det(R) == pytest.approx(1.0)
        assert R[2, 0] == pytest.approx(0.0) and R[2, 1] <= 0.0, "x is level, y points down"


def transparent(width: int, height: int) -> np.ndarray:
    picture = np.zeros((height, width, 4), np.uint8)
    picture[height // 2, width // 2] = (10, 200, 30, 255)
    return picture


@pytest.mark.parametrize("light", [False, True])
def test_a_picture_has_its_colour_bar_and_a_scale_on_the_page_s_background(light: bool) -> None:
    found = key(HEIGHT, Limits(-2, 7))
    picture = np.asarray(composed(transparent(900, 600), found, light=light, seen_m=30.0))
    assert picture.shape == (600, 900, 3)
    assert tuple(picture[300, 450]) == (10, 200, 30) and tuple(picture[5, 5]) == BACKGROUND[light]
    ink = 236 if not light else 24
    bar = np.flatnonzero((picture[500:, 700:, 0] == ink).any(axis=0))
    assert np.ptp(bar) + 1 == pytest.approx(600 / 30 * 2, abs=2), "2 m, of 30 m in 600 pixels"
    legend = {tuple(pixel) for pixel in picture[400:, :300].reshape(-1, 3).tolist()}
    assert {tuple(found.stops[0].tolist()), tuple(found.stops[-1].tolist())} <= legend
    plain = np.asarray(composed(transparent(900, 600), Key(), light=light))
    assert len(np.unique(plain @ [1, 1 << 8, 1 << 16])) == 2


def test_labels_are_named_in_the_picture() -> None:
    found = key(LOOK, Limits(0, 1))
    picture = np.asarray(composed(transparent(900, 600), found, light=False))
    seen = {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}
    assert {rgb for rgb, _ in found.names} <= seen


# --- the panel -----------------------------------------------------------------------------------
class Browser:
    """Renders a picture of one point."""

    client_id = 0

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.files: dict[str, bytes] = {}
        self.told: list[str] = []
        self.problem: Exception | None = None
        self.camera = SimpleNamespace(position=(0.0, -10.0, 0.0), look_at=(0.0, 0.0, 0.0), wxyz=(1, 0, 0, 0), fov=FOV)

    def get_render(self, height: int, width: int, **asked: Any) -> np.ndarray:
        if self.problem is not None:
            raise self.problem
        self.asked.append(asked)
        return transparent(width, height)

    def send_file_download(self, name: str, content: bytes, **_: Any) -> None:
        self.files[name] = content

    def add_notification(self, _title: str, body: str, **_: Any) -> None:
        self.told.append(body)


WALKED = Snapshot(recording=OpenedRecording(Path("walk.mcap"), 0, 60.0, 600, ()), trajectory=CORNER)


class Bench:
    def __init__(self, server: viser.ViserServer, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.browser = Browser()
        monkeypatch.setattr(server, "get_clients", lambda: {0: self.browser})
        page = page_of(server, snapshot=lambda: WALKED, offset=lambda: np.array([0.0, 0.0, 100.0]))
        self.panel = PicturesPanel(page, folder, lambda: (key(HEIGHT, Limits(0, 1)), False))
        self.panel._width.value, self.panel._height.value = 320, 200
        self.panel.draw(WALKED)

    def do(self, act: Any) -> None:
        button = SimpleNamespace(client=self.browser, target=SimpleNamespace(value=True))
        finish(by_user(lambda _, client: act(client))(button))  # type: ignore[arg-type]
        self.panel.draw(WALKED)


@pytest.fixture
def bench(server: viser.ViserServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(server, tmp_path, monkeypatch)


def test_a_picture_has_the_size_asked_for_and_shows_what_the_camera_sees(bench: Bench) -> None:
    bench.do(bench.panel._shoot)
    ((name, content),) = bench.browser.files.items()
    assert name.startswith("walk-") and name.endswith(".png")
    assert Image.open(io.BytesIO(content)).size == (320, 200)
    assert bench.browser.asked[0]["position"] == pytest.approx((0.0, -10.0, 0.0))


def test_a_flight_is_a_zip_of_numbered_pictures_in_the_results(bench: Bench, tmp_path: Path) -> None:
    bench.panel._seconds.value = 1.0
    bench.do(bench.panel._fly)
    (file,) = (tmp_path / "flights").iterdir()
    with zipfile.ZipFile(file) as pictures:
        assert pictures.namelist() == [f"{n:05d}.png" for n in range(1, 26)]
        assert Image.open(io.BytesIO(pictures.read("00013.png"))).size == (320, 200)
    assert bench.browser.asked[0]["position"][2] == pytest.approx(101.5), "where the map is in the scene"
    assert bench.panel._download.visible and bench.panel._share == 1.0
    bench.do(bench.panel._send)
    assert bench.browser.files == {file.name: file.read_bytes()}


def test_a_flight_that_is_stopped_leaves_nothing(bench: Bench, tmp_path: Path) -> None:
    render = bench.browser.get_render

    def then_stop(*args: Any, **asked: Any) -> np.ndarray:
        bench.panel.close()
        return render(*args, **asked)

    bench.browser.get_render = then_stop  # type: ignore[method-assign]
    bench.do(bench.panel._fly)
    assert list((tmp_path / "flights").iterdir()) == [] and not bench.panel._download.visible
    assert bench.browser.told == []


def test_a_flight_ends_where_another_recording_is_opened_and_that_is_said(bench: Bench, tmp_path: Path) -> None:
    panel, render, now = bench.panel, bench.browser.get_render, [WALKED]
    panel._page = replace(panel._page, snapshot=lambda: now[0])

    def then_open(*args: Any, **asked: Any) -> np.ndarray:
        now[0] = replace(WALKED, session=WALKED.session + 1)
        return render(*args, **asked)

    bench.browser.get_render = then_open  # type: ignore[method-assign]
    bench.do(panel._fly)
    assert list((tmp_path / "flights").iterdir()) == [] and not panel._download.visible
    assert len(bench.browser.asked) == 1 and "the flight has ended" in bench.browser.told[0]


def test_a_flight_ends_with_its_browser_and_the_page_says_so_after_a_reload(
    bench: Bench, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.browser.problem = RuntimeError("the client disconnected before returning a frame")
    monkeypatch.setattr(server, "get_clients", lambda: {1: Browser()})
    bench.do(bench.panel._fly)
    assert "closed or reloaded" in bench.panel._where.content
    bench.browser.problem = None
    bench.panel._seconds.value = 1.0
    bench.do(bench.panel._fly)
    assert "reloaded" not in bench.panel._where.content and bench.panel._download.visible


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (TimeoutError(), "no picture in time"),
        (RuntimeError(), "smaller size"),
        (OSError(28, "No space left on device"), "No space"),
    ],
)
def test_why_there_is_no_picture_is_said(problem: Exception, words: str, bench: Bench, tmp_path: Path) -> None:
    bench.browser.problem = problem
    for act in (bench.panel._shoot, bench.panel._fly):
        bench.do(act)
    assert len(bench.browser.told) == 2 and all(words in text for text in bench.browser.told)
    assert list((tmp_path / "flights").iterdir()) == []


def test_a_flight_that_fills_the_disk_names_its_folder(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    bench.do(bench.panel._fly)
    (told,) = bench.browser.told
    assert f"No space left on device ({tmp_path / 'flights'}); check space" in told
    assert list((tmp_path / "flights").iterdir()) == []


def test_more_pixels_than_a_browser_renders_are_refused(bench: Bench) -> None:
    bench.panel._width.value, bench.panel._height.value = 8192, 8192
    bench.do(bench.panel._shoot)
    assert "more pixels" in bench.browser.told[0] and not bench.browser.asked
