"""Distance to another map and density, in colours.

Tests app/ui/background.py, app/ui/map_compare.py, app/ui/map_numbers.py.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from app.child import Link
from app.evaluation.cloud_distance import Comparison
from app.server.folders import Folders
from app.server.protocol import Chunk, OpenedRecording, Snapshot
from app.slam.errors import HemislamError
from app.ui import background
from app.ui.chunks import MapChunks
from app.ui.colours import DENSITY, DISTANCE, HEIGHT, NOTHING, Limits, key
from app.ui.map_compare import MapComparePanel, summary
from app.ui.map_numbers import Density, MapNumbers
from app.ui.widgets import View
from tests.ui.conftest import SOMEONE, clouds, page_of, user_clicks
from tests.ui.test_calibration import Process

RANDOM = np.random.default_rng(8)


def chunk_of(index: int, n: int) -> Chunk:
    points = RANDOM.uniform(-2, 2, (n, 3)).astype(np.float32)
    nothing = np.zeros(n, np.uint8)
    return Chunk(index, index, 0, points, nothing, nothing.astype(np.float32), nothing.astype(np.uint16), np.eye(4))


CHUNKS = (chunk_of(0, 30), chunk_of(1, 50))
NOW = Snapshot(
    recording=OpenedRecording(Path("walk.mcap"), 0, 60.0, 600, (), truth=Path("walk_truth.tum")),
    chunks=CHUNKS,
    keyframe_poses=np.tile(np.eye(4), (2, 1, 1)),
)
DISTANCES = np.concatenate([np.full(30, 0.02), np.full(40, -0.01), np.full(10, np.nan)]).astype(np.float32)
FOUND = Comparison(DISTANCES, np.full(80, 0.015, np.float32), np.eye(4))


class Comparing:
    def __init__(self, server: viser.ViserServer, folder: Path) -> None:
        self.now, self.modes = NOW, list[str]()
        page = page_of(server, snapshot=lambda: self.now)
        self.panel = MapComparePanel(page, Folders([folder]), folder / "results", self.modes.append)
        self.panel.draw(self.now)

    @property
    def process(self) -> Any:
        return self.panel._work._child

    def draw(self, *messages: Any) -> None:
        if messages:
            self.process.messages += messages
        self.panel.draw(self.now)


@pytest.fixture
def comparing(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Comparing:
    monkeypatch.setattr(background, "Child", Process)
    return Comparing(server, tmp_path)


def test_the_map_is_coloured_when_the_comparison_has_come(comparing: Comparing) -> None:
    user_clicks(comparing.panel._truth)
    (wanted,) = comparing.process.arguments
    assert wanted.by_truth and wanted.other == Path("walk_truth.tum") and len(wanted.scans) == 2
    comparing.draw(0.4)
    assert comparing.panel._work._bar.visible and comparing.panel._work._bar.value == pytest.approx(40)
    assert comparing.panel._choose.disabled
    comparing.draw(FOUND)
    assert comparing.modes == [DISTANCE] and not comparing.panel._work._bar.visible
    assert "the truth" in comparing.panel._found.content and "<svg" in comparing.panel._found.content
    view = comparing.panel.seen(NOW, View(colour_by=DISTANCE))
    assert view.numbers is not None and view.numbers.limits == Limits(-0.02, 0.02)
    assert view.numbers.of(CHUNKS[1])[:40] == pytest.approx(-0.01)
    assert comparing.panel.seen(NOW, View()).numbers is None


def test_stop_ends_it_and_a_problem_is_reported(comparing: Comparing) -> None:
    user_clicks(comparing.panel._truth)
    process = comparing.process
    user_clicks(comparing.panel._work._stop)
    comparing.draw()
    assert process.closed and comparing.process is None and not comparing.panel._work._bar.visible
    user_clicks(comparing.panel._truth)
    comparing.draw("The maps do not lie on each other.")
    assert comparing.process is None and comparing.modes == []


def fail(owner: Link, why: str) -> None:
    raise HemislamError(why)


def test_work_that_cannot_be_done_says_why(server: viser.ViserServer) -> None:
    work, found = background.Background(server.gui, "test", "The test"), None
    work.begin(fail, "The file cannot be read.")
    deadline = time.monotonic() + 60
    while found is None and time.monotonic() < deadline:
        found = next(work.messages(), None)
    work.stop()
    assert found == "The file cannot be read." and not work.running


def test_a_map_that_has_changed_since_is_said_to_be_old(comparing: Comparing) -> None:
    user_clicks(comparing.panel._truth)
    comparing.draw(FOUND)
    assert "changed since" not in comparing.panel._found.content
    comparing.now = replace(NOW, chunks=(*CHUNKS, chunk_of(2, 5)), keyframe_poses=np.tile(np.eye(4), (3, 1, 1)))
    comparing.draw()
    assert "changed since" in comparing.panel._found.content


def test_a_map_that_an_edit_of_a_loop_has_moved_since_is_said_to_be_old(comparing: Comparing) -> None:
    user_clicks(comparing.panel._truth)
    comparing.draw(FOUND)
    comparing.now = replace(NOW, keyframe_poses=NOW.keyframe_poses + 0.1)
    comparing.draw()
    assert "changed since" in comparing.panel._found.content


def test_a_comparison_that_fails_leaves_name_and_age_of_the_one_shown(comparing: Comparing) -> None:
    user_clicks(comparing.panel._truth)
    comparing.draw(FOUND)
    comparing.now = replace(NOW, chunks=(*CHUNKS, chunk_of(2, 5)), keyframe_poses=np.tile(np.eye(4), (3, 1, 1)))
    comparing.draw()
    comparing.panel._begin(Path("broken.ply"))
    comparing.draw("broken.ply cannot be read.")
    comparing.draw()
    html = comparing.panel._found.content
    assert "the truth" in html and "changed since" in html and "broken.ply" not in html


def test_another_session_has_no_comparison_and_the_colours_from_before(comparing: Comparing) -> None:
    comparing.panel.seen(NOW, View(colour_by=HEIGHT))
    user_clicks(comparing.panel._truth)
    comparing.draw(FOUND)
    comparing.panel.seen(NOW, View(colour_by=DISTANCE))
    user_clicks(comparing.panel._truth)
    comparing.now = replace(NOW, session=NOW.session + 1)
    comparing.draw()
    assert comparing.modes == [DISTANCE, HEIGHT] and comparing.process is None
    assert not comparing.panel._found.content
    assert comparing.panel.seen(comparing.now, View(colour_by=DISTANCE)).numbers is None


def test_a_comparison_is_reported_in_numbers() -> None:
    html = summary(FOUND, "other.laz", [])
    assert "43 % differ by more than chance" in html, "40 of 70 are 1 cm, less than could be told"
    assert "12 % have no counterpart" in html and "other.laz" in html and html.count("<rect") == 41
    nothing = Comparison(np.full(3, np.nan, np.float32), np.full(3, np.nan, np.float32), np.eye(4))
    assert "100 % have no counterpart" in summary(nothing, "b", [])


def test_points_without_a_number_are_grey_and_others_follow_the_colour_bar(server: viser.ViserServer) -> None:
    numbers = MapNumbers.split(CHUNKS, DISTANCES, Limits(-0.02, 0.02))
    drawn = MapChunks(server.scene, "/map/keyframes")
    drawn.clear(0, 60.0)
    drawn.draw(CHUNKS, np.tile(np.eye(4), (2, 1, 1)), View(colour_by=DISTANCE, numbers=numbers))
    assert drawn.limits[DISTANCE] == Limits(-0.02, 0.02)
    front, behind = (clouds(server)[f"/map/keyframes/{k}"].colors for k in range(2))
    bar = key(DISTANCE, Limits(-0.02, 0.02)).stops
    assert (front == bar[-1]).all() and (behind[40:] == NOTHING).all()
    assert (np.abs(behind[:40].astype(int) - bar[64]) < 4).all()
    drawn.draw(CHUNKS, np.tile(np.eye(4), (2, 1, 1)), View(colour_by=DISTANCE))
    assert (clouds(server)["/map/keyframes/0"].colors == NOTHING).all(), "before there is a comparison"


def test_density_is_counted_across_keyframes_and_again_when_they_move() -> None:
    here, there = (replace(chunk_of(k, 40), points=np.full((40, 3), 0.1, np.float32)) for k in range(2))
    apart, together = np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(4), (2, 1, 1))
    apart[1, 0, 3] = 10.0
    counting = Density(time.monotonic)
    for poses, count in ((apart, 40), (together, 80)):
        deadline = time.monotonic() + 60
        while (found := counting.of((here, there), poses)) is None or found.of(here)[0] != count:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert (found.of(there) == count).all() and found.limits == Limits(0.0, count)
    assert key(DENSITY, found.limits).high == "80" and SOMEONE is not None
