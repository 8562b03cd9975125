"""The whole page, drawn only as often as eyes can follow.

Tests app/ui/appearance.py.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viser
from viser._messages import GuiUpdateMessage

from app.server.folders import Folders
from app.server.protocol import Notice, OpenRecording, Progress, SetParams, StepFrame
from app.ui.files import FilesPanel
from app.ui.readouts import HISTORY
from app.ui.workbench import Workbench
from tests.ui.conftest import Clock, Wire, clouds, user_sets
from tests.ui.fake_engine import FakeEngine
from tests.ui.fake_forks import alone


class Page:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine, folder: Path) -> None:
        self.clock = Clock()
        self.engine = engine
        self.workbench = Workbench(server, alone(engine), Folders([folder]), now=self.clock)

    def draw(self, seconds: float = 0.0) -> None:
        self.clock.now += seconds
        self.workbench.draw(self.engine.snapshot)


@pytest.fixture
def page(server: viser.ViserServer, wire: Wire, engine: FakeEngine, tmp_path: Path) -> Page:
    page = Page(server, engine, tmp_path)
    page.draw()
    return page


SCAN = "/map/sensor/lidar/scan"


def test_frames_are_sent_at_the_rate_that_eyes_follow(page: Page, wire: Wire) -> None:
    wire.clear()
    for _ in range(100):
        page.engine.send(StepFrame(1))
        page.draw(0.01)
    scans = [m for m in wire.messages if getattr(m, "name", "") == SCAN and "points" in getattr(m, "updates", {})]
    assert 10 <= len(scans) <= 16


def test_a_picture_names_the_same_lines_as_the_page(page: Page) -> None:
    page.engine.send(StepFrame(3))
    page.draw(1.0)
    appearance = page.workbench._appearance
    assert "path" in appearance._legend.content and "path" in [name for _, name in appearance.key.names]
    appearance._layers["path"].value = False
    page.draw(1.0)
    assert "path" not in [name for _, name in appearance.key.names]


def test_a_ground_slider_dims_the_map_until_something_else_is_done_and_another_does_not(
    page: Page, server: viser.ViserServer
) -> None:
    def dimmed() -> bool:
        """And the legend says so."""
        grey = clouds(server)["/map/keyframes/0"].colors.ndim == 1
        assert ("while ground sliders move" in page.workbench._appearance._legend.content) == grey
        return grey

    page.engine.send(StepFrame(3))
    page.draw(1.0)
    page.engine.send(SetParams({"filter.point_noise": 0.2}))
    page.draw(1.0)
    assert not dimmed()
    page.engine.send(SetParams({"ground.alpha": 44.0}))
    page.draw(1.0)
    assert dimmed()
    for _ in range(6):
        page.draw(5.0)
        assert dimmed(), "while nothing else is done"
    page.engine.send(StepFrame(1))
    page.draw(1.0)
    assert not dimmed()
    for other in ("Readouts", ""):
        page.engine.send(SetParams({"ground.alpha": 30.0 if other else 31.0}))
        page.draw(1.0)
        assert dimmed()
        page.workbench._opened(other)
        page.draw(1.0)
        assert not dimmed(), "another tab, or Escape"


def test_a_moved_slider_is_drawn_at_once_however_recent_the_last_frame(page: Page, wire: Wire) -> None:
    page.engine.send(StepFrame(1))
    page.draw(1.0)
    wire.clear()
    page.engine.send(SetParams({"ground.sigma": 0.2}))
    page.draw(0.001)
    assert "colors" in wire.updates(SCAN)


def test_numbers_come_at_most_four_times_a_second_and_end_at_the_newest(page: Page, wire: Wire) -> None:
    wire.clear()
    for _ in range(100):
        page.engine.send(StepFrame(1))
        page.draw(0.01)
    uuid = page.workbench._readouts._tiles._impl.uuid
    sent = [m for m in wire.messages if getattr(m, "uuid", "") == uuid]
    assert 1 <= len(sent) <= 5
    page.draw(0.5)
    assert f"{page.engine.snapshot.result.ground.seeds:,}" in page.workbench._readouts._tiles.content  # type: ignore[union-attr]


def test_while_playing_each_panel_is_sent_at_most_four_times_a_second(page: Page, wire: Wire) -> None:
    """Ten seconds at ten frames a second."""
    for step in range(270):  # the first 20 for what is sent only once
        if step == 20:
            wire.clear()
        if step % 5 in (0, 2):
            page.engine.send(StepFrame(1))
            page.engine.publish(transport=replace(page.engine.snapshot.transport, playing=True))
        page.draw(0.04)
    counts = Counter((m.uuid, *m.updates) for m in wire.messages if isinstance(m, GuiUpdateMessage))
    assert max(counts.values()) <= 40
    assert counts.total() <= 400
    scene = Counter(type(m).__name__ for m in wire.messages if not isinstance(m, GuiUpdateMessage))
    assert scene.total() <= 1200


def test_a_page_at_rest_sends_nothing(page: Page, wire: Wire) -> None:
    page.engine.send(StepFrame(5))
    for _ in range(5):
        page.draw(0.5)
    wire.clear()
    page.draw(0.5)
    assert wire.messages == []


def test_a_page_at_rest_shows_the_plots_of_the_whole_walk_once_asked(page: Page) -> None:
    page.engine.send(StepFrame(HISTORY + 50))
    for _ in range(5):
        page.draw(0.5)
    readouts = page.workbench._readouts
    first = page.engine.snapshot.series["stamp_s"][:2]
    assert readouts._residual.data[0][0] > first[1]
    user_sets(readouts._whole, True)
    page.draw(0.5)
    for chart in (readouts._stages, readouts._residual):
        assert chart.data[0][0] <= first[1] and len(chart.data[0]) == HISTORY


def test_the_page_says_that_the_engine_is_gone(page: Page) -> None:
    page.engine.publish(engine_alive=False)
    page.draw(0.1)
    assert "engine stopped" in page.workbench._header._title.content


def test_long_work_shows_what_it_is_and_how_far(page: Page) -> None:
    page.engine.publish(progress=Progress("Compiling deskew", 0.25))
    page.draw(0.1)
    bar = page.workbench._transport._state
    assert "Compiling deskew \\u00b7 25 %" in bar.content and "done&#34;: 0.25" in bar.content
    page.engine.publish(progress=Progress("Opening x.mcap", float("nan")))
    page.draw(0.1)
    assert "Opening x.mcap \\u2026" in bar.content and "NaN" not in bar.content


def test_the_thread_outlives_a_snapshot_that_can_not_be_drawn(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    import time

    for _ in range(5):
        page.draw(1.0)  # until it rests
    page.clock.now += 1000
    page.workbench.start()
    page.engine.publish(trajectory=np.zeros((3, 7)))
    time.sleep(0.2)
    page.engine.publish(trajectory=np.empty((0, 3)), progress=Progress("Still here", 0.5))
    deadline = time.monotonic() + 10
    while "Still here" not in page.workbench._transport._state.content and time.monotonic() < deadline:
        time.sleep(0.02)
    page.workbench.close()
    assert "Still here" in page.workbench._transport._state.content
    assert "could not be drawn" in caplog.text


def test_messages_of_an_earlier_recording_name_it(page: Page) -> None:
    page.engine.publish(notices=(Notice(1, "warning", "It drifts.", "hall_bpearl.mcap"),))
    page.draw()
    log = page.workbench._notices._log
    assert "It drifts." in log.content and "hall_bpearl" not in log.content
    page.engine.send(OpenRecording(Path("/data/other.mcap")))
    page.draw()
    assert "hall_bpearl.mcap: It drifts." in log.content


def test_the_slider_of_m_reaches_all_scan_lines_of_the_recording_that_is_opened_next(page: Page) -> None:
    """The page may never draw a snapshot of it without a frame."""
    page.engine.send(StepFrame())
    result = page.engine.snapshot.result
    assert result is not None
    for session, lines in ((7, 16), (8, 128)):
        cloud = replace(result.cloud, ring=np.full(len(result.cloud), lines - 1, np.uint16))
        page.engine.publish(session=session, result=replace(result, cloud=cloud))
        page.draw(1.0)
        assert page.workbench._parameters._widgets["ground.scan_lines"][0].handle.max == lines


def test_a_map_whose_newest_frame_cannot_be_shown_can_be_saved(page: Page) -> None:
    """As after a new engine took over a live map at rest."""
    (files,) = (panel for panel in page.workbench._panels if isinstance(panel, FilesPanel))
    assert files._save.disabled
    page.engine.send(StepFrame(3))
    page.engine.publish(result=None)
    page.draw()
    assert not files._save.disabled
