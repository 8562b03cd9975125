"""Panels: what a person does becomes a command, what the engine says is shown, and neither echoes."""

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser

from app.server.folders import Folders
from app.server.protocol import (
    Command,
    Notice,
    Pause,
    Play,
    Progress,
    Restart,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.slam.params import Params, leaves
from app.ui.doctor import findings_html, verdicts
from app.ui.files import result_folder_name, size_text
from app.ui.header import title
from app.ui.html import legend, tile
from app.ui.notices import log_html
from app.ui.parameters import PRIMARY, ParameterPanel
from app.ui.readouts import HISTORY, recent, stacked_stages
from app.ui.transport import SPEEDS, TransportPanel, speed_name, where
from app.ui.workbench import Workbench
from tests.ui.conftest import Wire
from tests.ui.fake_engine import FINDINGS, FakeEngine

SOMEONE = object()
"""Stands for a browser."""


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def user_sets(handle: Any, value: Any) -> None:
    """As if somebody set a control in a browser."""
    handle._impl.value = value
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(client=SOMEONE, client_id=0, target=handle))  # type: ignore[arg-type]


def user_clicks(handle: Any) -> None:
    user_sets(handle, True)


class Parameters:
    """A parameter panel with its clock and what it sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.clock = Clock()
        self.panel = ParameterPanel(server.gui, Params(), self.sent.append, self.clock)
        self.params = Params()

    def control(self, path: str) -> Any:
        return self.panel._controls[path]

    def tick(self, seconds: float = 0.0, **changes: Any) -> None:
        self.clock.now += seconds
        self.panel.tick(Snapshot(params=self.params, **changes))


@pytest.fixture
def parameters(server: viser.ViserServer) -> Parameters:
    return Parameters(server)


def test_every_parameter_has_a_control_that_shows_its_default(parameters: Parameters) -> None:
    assert set(parameters.panel._controls) == {leaf.path for leaf in leaves()}
    for leaf in leaves():
        assert parameters.control(leaf.path).value == leaf.default
        assert parameters.control(leaf.path).hint == leaf.help


def test_the_papers_four_come_first_and_are_sliders(parameters: Parameters) -> None:
    orders = {path: control.order for path, control in parameters.panel._controls.items()}
    assert set(sorted(orders, key=lambda path: orders[path])[:4]) == set(PRIMARY)
    assert all(isinstance(parameters.control(path), viser.GuiSliderHandle) for path in PRIMARY)


@pytest.mark.parametrize(("path", "mark"), [("ground.alpha", ""), ("filter.point_noise", "▸"), ("imu.gravity", "↻")])
def test_labels_say_when_a_change_takes_effect(parameters: Parameters, path: str, mark: str) -> None:
    text = parameters.control(path).label
    assert [m for m in "▸↻" if m in text] == list(mark)


def test_moving_a_slider_sends_the_value_at_once(parameters: Parameters) -> None:
    user_sets(parameters.control("ground.alpha"), 25.0)
    assert parameters.sent == [SetParams({"ground.alpha": 25.0})]


def test_a_typed_value_is_sent_once_the_keys_rest(parameters: Parameters) -> None:
    noise = parameters.control("filter.point_noise")
    for typed in (0.0, 0.2, 0.25):
        user_sets(noise, typed)
        parameters.tick(0.1)
    assert parameters.sent == []
    parameters.tick(0.6)
    assert parameters.sent == [SetParams({"filter.point_noise": 0.25})]


def test_what_the_engine_says_is_shown_and_not_sent_back(parameters: Parameters) -> None:
    parameters.params = Params().with_values(
        {"ground.alpha": 12.0, "imu.max_gap": 0.3, "sensor.translation": (1, 2, 3)}
    )
    parameters.tick()
    assert parameters.control("ground.alpha").value == 12.0
    assert parameters.control("imu.max_gap").value == 0.3
    assert parameters.control("sensor.translation").value == (1, 2, 3)
    assert parameters.sent == []


def test_an_older_snapshot_does_not_pull_the_slider_from_under_the_hand(parameters: Parameters) -> None:
    alpha = parameters.control("ground.alpha")
    user_sets(alpha, 20.0)
    parameters.tick(0.05)
    assert alpha.value == 20.0


def test_a_value_that_the_engine_refused_goes_back(parameters: Parameters) -> None:
    alpha = parameters.control("ground.alpha")
    user_sets(alpha, 20.0)
    parameters.tick(0.5, progress=Progress("Going to frame 5", 0.1))
    parameters.tick(5.0, progress=Progress("Going to frame 5", 0.9))
    assert alpha.value == 20.0  # it may be busy still
    parameters.tick(0.1)
    parameters.tick(0.1)
    assert alpha.value == Params().ground.alpha


def test_changed_parameters_can_be_reset_one_by_one_or_all(parameters: Parameters) -> None:
    resets = parameters.panel._resets["primary"]
    parameters.tick()
    assert not resets.visible
    parameters.params = Params().with_values({"ground.alpha": 12.0, "ground.sigma": 0.1})
    parameters.tick()
    assert resets.visible and resets.options == ("alpha", "sigma", "all")
    user_sets(resets, "sigma")
    assert parameters.sent == [SetParams({"ground.sigma": Params().ground.sigma})]
    parameters.sent.clear()
    user_sets(resets, "all")
    (command,) = parameters.sent
    assert isinstance(command, SetParams)
    assert command.values == {path: Params().value(path) for path in PRIMARY}


def test_what_waits_for_a_restart_is_named_and_can_be_had_now(parameters: Parameters) -> None:
    parameters.tick()
    assert not parameters.panel._restart.visible
    parameters.tick(pending_restart=("imu.gravity",))
    assert parameters.panel._restart.visible and "imu.gravity" in parameters.panel._pending.content
    user_clicks(parameters.panel._restart)
    assert parameters.sent == [Restart()]


def test_the_slider_of_m_ends_at_the_lines_there_are(parameters: Parameters) -> None:
    parameters.panel.fit_lines(32)
    assert parameters.control("ground.scan_lines").max == 32


# --- transport ---------------------------------------------------------------------------------
class Transporting:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.engine, self.clock = engine, Clock()
        self.panel = TransportPanel(server.gui, engine.send, lambda: engine.snapshot, self.clock)

    def tick(self, seconds: float = 0.0) -> None:
        self.clock.now += seconds
        self.panel.tick(self.engine.snapshot)


@pytest.fixture
def transport(server: viser.ViserServer, engine: FakeEngine) -> Transporting:
    return Transporting(server, engine)


def test_the_play_button_plays_then_pauses(transport: Transporting) -> None:
    user_clicks(transport.panel._play)
    transport.tick()
    assert transport.panel._play.label == "Pause"
    user_clicks(transport.panel._play)
    transport.tick()
    assert transport.engine.sent == [Play(), Pause()]
    assert transport.panel._play.label == "Play"


def test_playing_at_the_end_begins_anew(transport: Transporting) -> None:
    snapshot = transport.engine.snapshot
    transport.engine.publish(transport=replace(snapshot.transport, finished=True))
    user_clicks(transport.panel._play)
    assert transport.engine.sent == [Restart(), Play()]


def test_the_slider_follows_the_frame_without_seeking(transport: Transporting) -> None:
    transport.engine.send(StepFrame(7))
    transport.tick()
    assert transport.panel._slider.value == 6
    assert transport.panel._slider.max == transport.engine.frames - 1
    transport.tick(5.0)
    assert transport.engine.sent == [StepFrame(7)]


def test_dragging_seeks_once_to_where_the_hand_came_to_rest(transport: Transporting) -> None:
    transport.engine.send(StepFrame(3))
    transport.tick()
    for frame in (5, 9, 12):
        user_sets(transport.panel._slider, frame)
        transport.tick(0.05)
        assert transport.panel._slider.value == frame
    transport.tick(0.3)
    assert transport.engine.sent[1:] == [Seek(12)]
    transport.tick()
    assert transport.panel._slider.value == 12


@pytest.mark.parametrize("name", SPEEDS)
def test_speeds_are_sent_and_shown(transport: Transporting, name: str) -> None:
    user_sets(transport.panel._speed, name)
    assert transport.engine.sent == [SetSpeed(SPEEDS[name])]
    assert speed_name(SPEEDS[name]) == name
    transport.tick()
    assert transport.panel._speed.value == name


def test_the_stamp_is_exact_to_the_millisecond(engine: FakeEngine) -> None:
    engine.send(StepFrame(12))
    text = where(engine.snapshot)
    assert "frame <b>11</b> of 400" in text and "<b>1.10</b> of 40.0 s" in text
    assert "2023-11-14 22:13:21.100 UTC" in text


# --- words -------------------------------------------------------------------------------------
def test_what_needs_the_user_comes_first_with_its_option() -> None:
    text = findings_html(FINDINGS)
    assert text.index("needs you") < text.index("corrected") < text.index("fine")
    assert "<code>--set imu.max_gap=0.4</code>" in text
    assert "needs you 1" in verdicts(FINDINGS) and "fine 2" in verdicts(FINDINGS)


@pytest.mark.parametrize(
    "render",
    [
        lambda text: findings_html((replace(FINDINGS[0], subject=text, text=text, option=text),)),
        lambda text: log_html((Notice(1, "error", text),)),
        lambda text: tile(text, text, text, note=text),
        lambda text: title(Snapshot(recording=replace(FakeEngine(frames=2).snapshot.recording, path=Path(text)))),  # type: ignore[type-var]
    ],
)
def test_names_from_a_recording_are_never_markup(render: Callable[[str], str]) -> None:
    assert "<script" not in render("<script>alert(1)<")


def test_the_legend_names_limits_and_unit() -> None:
    from app.ui.colours import ColourBy, Limits

    text = legend(ColourBy.HEIGHT, Limits(-2.0, 3.0))
    assert ">-2<" in text and ">3<" in text and "height · m" in text
    assert all(name in legend(ColourBy.LABEL, None) for name in ("ground", "not ground", "seed"))


def test_result_folders_sort_and_need_no_quoting() -> None:
    now = datetime(2026, 5, 1, 13, 45, 2)
    assert result_folder_name(Path("/x/hall bpearl (1).mcap"), now) == "hall_bpearl__1_-2026-05-01-134502"


@pytest.mark.parametrize(
    ("size", "text"), [(12, "12 B"), (2_000, "2 kB"), (25_400_000, "25 MB"), (3_800_000_000, "3.8 GB")]
)
def test_sizes_read_as_people_say_them(size: int, text: str) -> None:
    assert size_text(size) == text


def test_plots_show_the_newest_frames_only(engine: FakeEngine) -> None:
    engine.send(StepFrame(HISTORY + 20))
    stamps, planarity = recent(engine.snapshot.series, "planarity")
    assert len(stamps) == len(planarity) == HISTORY
    assert stamps[-1] == pytest.approx(0.1 * (HISTORY + 19))


def test_stages_are_stacked_to_the_total(engine: FakeEngine) -> None:
    engine.send(StepFrame(10))
    _, highest, *lower = stacked_stages(engine.snapshot.series)
    assert np.allclose(highest, engine.snapshot.series["total_ms"])
    assert all((a >= b).all() for a, b in zip([highest, *lower], lower, strict=False))


# --- the whole page ----------------------------------------------------------------------------
class Page:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine, folder: Path) -> None:
        self.clock = Clock()
        self.engine = engine
        self.workbench = Workbench(server, engine, Folders([folder]), now=self.clock)

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


def test_a_page_at_rest_sends_nothing(page: Page, wire: Wire) -> None:
    page.engine.send(StepFrame(5))
    for _ in range(5):
        page.draw(0.5)
    wire.clear()
    page.draw(0.5)
    assert wire.messages == []


def test_the_page_says_that_the_engine_is_gone(page: Page) -> None:
    page.engine.publish(engine_alive=False)
    page.draw(0.1)
    assert "engine stopped" in page.workbench._header._title.content


def test_long_work_shows_what_it_is_and_how_far(page: Page) -> None:
    page.engine.publish(progress=Progress("Compiling deskew", 0.25))
    page.draw(0.1)
    header = page.workbench._header
    assert header._bar.visible and header._bar.value == 25.0 and "Compiling deskew · 25 %" in header._work.content
    page.engine.publish(progress=Progress("Opening x.mcap", float("nan")))
    page.draw(0.1)
    assert "Opening x.mcap …" in header._work.content
    page.engine.publish(progress=None)
    page.draw(0.1)
    assert not header._bar.visible


def test_the_thread_outlives_a_snapshot_that_can_not_be_drawn(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    import time

    page.clock.now += 1000
    page.workbench.start()
    page.engine.publish(trajectory=np.zeros((3, 7)))
    time.sleep(0.2)
    page.engine.publish(trajectory=None, progress=Progress("Still here", 0.5))
    deadline = time.monotonic() + 10
    while "Still here" not in page.workbench._header._work.content and time.monotonic() < deadline:
        time.sleep(0.02)
    page.workbench.close()
    assert "Still here" in page.workbench._header._work.content
    assert "could not be drawn" in caplog.text
