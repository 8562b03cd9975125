"""The shareable page, opened from the disk: it shows the map within seconds, without errors.

Tests app/export/share.py.
"""

import base64
import io
import os
import time
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import zstandard
from PIL import Image
from playwright.sync_api import Browser

from app.export import share
from app.export.point_sizes import LEAST_PX, MOST_PX, VISERS
from app.export.results import Results
from app.slam.frames import READOUTS, Frame
from app.slam.params import Params
from app.slam.run_log import RunInfo, RunLog
from app.slam.types import Cloud, Keyframe
from tests.browser.conftest import AT_TEN_FRAMES_A_SECOND


def plaza(points: int) -> Results:
    """Two keyframes over a square of 30 m with a wavy floor."""
    rng, keyframes = np.random.default_rng(2), []
    for index in range(2):
        at = rng.uniform(-15, 15, (points // 2, 3)).astype(np.float32)
        at[:, 2] = np.sin(at[:, 0] / 3)
        nothing = np.zeros(len(at), np.int32)
        cloud = Cloud(at, nothing.astype(np.uint8), nothing.astype(np.float32), nothing.astype(np.uint16), nothing)
        keyframes.append(Keyframe(index, index, 10**18 + index, np.eye(4), np.eye(4), np.eye(6), cloud))
    return Results(RunLog([]), keyframes, RunInfo(Path("plaza.mcap"), Params()))


def test_a_shared_page_opens_from_the_disk_without_a_complaint(chromium: Browser, tmp_path: Path) -> None:
    file = tmp_path / "share.html"
    share.write(file, plaza(200_000))
    page, said = chromium.new_page(viewport={"width": 800, "height": 600}), list[str]()
    page.add_init_script(AT_TEN_FRAMES_A_SECOND)
    page.on("console", lambda one: said.append(one.text) if one.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    begin = time.monotonic()
    page.goto(file.as_uri())
    deadline = time.monotonic() + 60
    while True:
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        if (np.ptp(picture[100:500, 200:600], axis=2) > 40).mean() > 0.2:
            break
        assert time.monotonic() < deadline, "the map does not show"
        page.wait_for_timeout(200)
    print(f"shown after {time.monotonic() - begin:.1f} s")
    if "SHARE_PICTURE" in os.environ:
        page.screenshot(path=Path(os.environ["SHARE_PICTURE"]))
    sized = page.evaluate(
        "(line) => { const gl = document.createElement('canvas').getContext('webgl2');"
        " const shader = gl.createShader(gl.VERTEX_SHADER); gl.shaderSource(shader, line);"
        " return gl.getShaderSource(shader); }",
        VISERS,
    )
    assert sized == f"gl_PointSize = clamp(scale / -world_pos.z, {LEAST_PX:.2f}, {MOST_PX:.2f});"
    assert "plaza" in page.title() and page.get_by_text("200,000 points").is_visible()
    of_the_renderer = ("THREE.Clock: ", "GL Driver Message", "Canvas2D: Multiple readback")
    assert not [text for text in said if not text.startswith(of_the_renderer) and "GL Driver" not in text]
    page.close()


def test_scale_and_arrow_are_in_the_first_picture_also_if_some_points_are_far() -> None:
    points = np.random.default_rng(1).uniform((-30, -20, 0), (30, 25, 5), (2000, 3)).astype(np.float32)
    points[:5] += np.float32([300, -300, 0])
    server = MagicMock()
    share._draw(server, points, np.empty((0, 3)), plaza(2))
    eye, aim = np.array(server.initial_camera.position), np.array(server.initial_camera.look_at)
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(ahead, [0, 0, 1]) / np.hypot(*ahead[:2])
    labels = {call.args[0]: np.array(call.kwargs["position"]) - eye for call in server.scene.add_label.call_args_list}
    for name in ("/scale/text", "/arrow/text"):
        across, up = (labels[name] @ axis / (labels[name] @ ahead) for axis in (right, np.cross(right, ahead)))
        assert abs(up) < np.tan(np.radians(37.5)) and abs(across) < 4 / 3 * np.tan(np.radians(37.5))  # viser's 75°


def test_measures_are_named_with_their_distance_and_notes_stand_where_they_were_taken(tmp_path: Path) -> None:
    results = plaza(20)
    one = Frame(10**18, False, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0, 0, 1]), np.zeros(len(READOUTS)))
    results.log = RunLog([one])
    results.notes = ((0, "a loose tile"), (5, "not there yet"))
    results.marks = (
        ("door", ((0, (0.0, 0.0, 0.0)), (1, (3.0, 4.0, 0.0)))),
        ("gone", ((7, (0.0, 0.0, 0.0)),)),
    )
    ((text, at),) = share.marked(results)
    assert text == "door 5.000 m" and at.tolist() == [[0, 0, 0], [3, 4, 0]]
    share.write(tmp_path / "share.html", results)
    _, begin, rest = (tmp_path / "share.html").read_text().partition('window.__VISER_EMBED_DATA__="')
    assert begin, "viser's page holds its scene otherwise"
    scene = base64.b64decode(rest.partition('"')[0])
    told = zstandard.ZstdDecompressor().decompressobj().decompress(scene[8:])
    assert b"door 5.000 m" in told and b"a loose tile" in told and b"not there yet" not in told


def test_a_million_points_take_less_than_15_megabytes(tmp_path: Path) -> None:
    share.write(tmp_path / "share.html", plaza(1_500_000))
    assert 3e6 < (tmp_path / "share.html").stat().st_size < 15e6
