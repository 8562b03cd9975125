"""The parameter panel: values set by the user become commands, the engine's values are shown, and neither echoes."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.server.fork import APART
from app.server.protocol import (
    Command,
    OpenedRecording,
    Progress,
    Restart,
    SetParams,
    Snapshot,
    StepFrame,
)
from app.slam.params import Params, leaves
from app.ui.parameters import PRIMARY, ParameterHistory, ParameterPanel
from tests.ui.conftest import BusyThreads, Clock, browser_sends, page_of, user_clicks, user_sets
from tests.ui.fake_engine import FakeEngine


class Parameters:
    """A parameter panel with its clock and what it sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.sent: list[Command] = []
        self.clock = Clock()
        self.panel = ParameterPanel(page_of(server, self.sent.append, now=self.clock), Params())
        self.params = Params()

    def control(self, path: str) -> Any:
        return self.panel._widgets[path][0].handle

    def widgets(self, path: str) -> list[Any]:
        return [widget.handle for widget in self.panel._widgets[path]]

    def tick(self, seconds: float = 0.0, **changes: Any) -> None:
        self.clock.now += seconds
        snapshot = Snapshot(params=self.params, **changes)
        self.panel.follow(snapshot)
        self.panel.draw(snapshot)


@pytest.fixture
def parameters(server: viser.ViserServer) -> Parameters:
    return Parameters(server)


def test_every_parameter_has_widgets_that_show_its_default(parameters: Parameters) -> None:
    assert set(parameters.panel._widgets) == {leaf.path for leaf in leaves()}
    for leaf in leaves():
        first, *others = parameters.panel._widgets[leaf.path]
        assert first.meant(first.handle.value, leaf.default) == leaf.default
        assert {widget.handle.hint for widget in (first, *others)} == {leaf.help}


def test_the_papers_four_come_first(parameters: Parameters) -> None:
    orders = {path: widgets[0].handle.order for path, widgets in parameters.panel._widgets.items()}
    assert set(sorted(orders, key=lambda path: orders[path])[:4]) == set(PRIMARY)


def test_every_number_has_a_slider_over_its_whole_range(parameters: Parameters) -> None:
    long = set()
    for leaf in leaves():
        number = leaf.default[0] if isinstance(leaf.default, tuple) else leaf.default
        if type(number) not in (int, float):
            continue
        widgets = parameters.widgets(leaf.path)
        sliders = [widget for widget in widgets if isinstance(widget, viser.GuiSliderHandle)]
        assert widgets[0].precision == (0 if isinstance(number, int) else 9), "its box shows what was typed"
        assert len(sliders) == (3 if isinstance(leaf.default, tuple) else 1)
        if widgets[0] in sliders:
            assert {(one.min, one.max, one.step) for one in sliders} == {(leaf.minimum, leaf.maximum, leaf.step)}
        else:
            long.add(leaf.path)
    noise = {f"imu.{name}" for name in ("gyro_noise", "accel_noise", "gyro_bias_walk", "accel_bias_walk")}
    assert long == noise | {"recording.imu_time_offset", "loops.window", "sensor.translation"}


def test_a_slider_over_decades_has_round_values_and_a_box_for_all_others(parameters: Parameters) -> None:
    box, slider = parameters.widgets("imu.gyro_noise")
    places = range(slider.min, slider.max + 1)
    values = []
    for place in places:
        user_sets(slider, place)
        values.append(box.value)
    assert values[:4] == [1e-6, 2e-6, 5e-6, 1e-5]
    assert values[-1] == 1.0
    parameters.tick(0.6)
    assert parameters.sent == [SetParams({"imu.gyro_noise": 1.0})]
    user_sets(box, 0.0021)
    assert values[slider.value] == 0.002


def test_a_clock_offset_has_round_values_on_either_side_of_zero(parameters: Parameters) -> None:
    box, slider = parameters.widgets("recording.imu_time_offset")
    assert slider.value * 2 == slider.max, "0 lies in the middle"
    user_sets(slider, slider.value - 1)
    assert box.value == -0.001


def test_the_sliders_of_a_vector_change_one_number_each(parameters: Parameters) -> None:
    parameters.params = Params().with_values({"sensor.rotation": (1.0, 2.0, 3.0)})
    parameters.tick()
    roll, pitch, yaw = parameters.widgets("sensor.rotation")
    assert [roll.value, pitch.value, yaw.value] == [1.0, 2.0, 3.0]
    assert [one.label.split()[0] for one in (roll, pitch, yaw)] == ["roll", "pitch", "yaw"]
    user_sets(pitch, -20.0)
    user_sets(yaw, 90.0)
    parameters.tick(0.6)
    assert parameters.sent == [SetParams({"sensor.rotation": (1.0, -20.0, 90.0)})]


@pytest.mark.parametrize(("path", "mark"), [("ground.alpha", ""), ("filter.point_noise", "▸"), ("imu.gravity", "↻")])
def test_labels_say_when_a_change_takes_effect(parameters: Parameters, path: str, mark: str) -> None:
    text = parameters.control(path).label
    assert [m for m in "▸↻" if m in text] == list(mark)


def test_moving_a_slider_sends_the_value_at_once(parameters: Parameters) -> None:
    user_sets(parameters.control("ground.alpha"), 25.0)
    assert parameters.sent == [SetParams({"ground.alpha": 25.0})]


def test_a_slider_below_the_first_four_sends_once_it_rests(parameters: Parameters) -> None:
    noise = parameters.control("filter.point_noise")
    for passed in (0.0, 0.2, 0.25):
        user_sets(noise, passed)
        parameters.tick(0.1)
    assert parameters.sent == []
    parameters.tick(0.6)
    assert parameters.sent == [SetParams({"filter.point_noise": 0.25})]


def test_a_snapshot_s_values_are_shown_and_not_sent_back(parameters: Parameters) -> None:
    parameters.params = Params().with_values(
        {"ground.alpha": 12.0, "imu.max_gap": 0.3, "sensor.translation": (1, 2, 3)}
    )
    parameters.tick()
    assert parameters.control("ground.alpha").value == 12.0
    assert parameters.control("imu.max_gap").value == 0.3
    assert [one.value for one in parameters.widgets("sensor.translation")[::2]] == [1, 2, 3]
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


def test_changed_parameters_can_be_reset_one_by_one_or_all(parameters: Parameters, engine: FakeEngine) -> None:
    resets = parameters.panel._resets["primary"]
    recording = engine.snapshot.recording
    parameters.params = Params().with_values({"ground.voxel_size": 0.3})  # as its own parameters have it
    parameters.tick(recording=recording)
    assert resets.visible and resets.options == ("nothing changed",)
    user_sets(resets, "nothing changed")
    assert parameters.sent == []
    opened = parameters.params
    parameters.params = opened.with_values({"ground.alpha": 12.0, "ground.sigma": 0.1})
    parameters.tick(recording=recording)
    assert resets.visible and resets.options == ("α seed angle", "σ thickness", "all")
    user_sets(resets, "σ thickness")
    assert parameters.sent == [SetParams({"ground.sigma": Params().ground.sigma})]
    parameters.sent.clear()
    user_sets(resets, "all")
    (command,) = parameters.sent
    assert isinstance(command, SetParams)
    assert command.values == {path: opened.value(path) for path in PRIMARY}


def test_resets_lead_back_to_the_opening_after_a_fork_has_been_swapped_for_a(
    parameters: Parameters, engine: FakeEngine
) -> None:
    """A fork has nothing open while it starts, and then the recording by its full path."""
    resets, recording = parameters.panel._resets["primary"], engine.snapshot.recording
    assert recording is not None
    parameters.tick(recording=replace(recording, path=Path(os.path.relpath(recording.path))))
    parameters.panel.draw(Snapshot(params=parameters.params))
    parameters.params = Params().with_values({"ground.alpha": 12.0})
    parameters.tick(recording=recording)
    assert resets.options == ("α seed angle",)


def test_what_the_ground_sliders_made_of_the_scan_stands_below_them(parameters: Parameters, engine: FakeEngine) -> None:
    engine.send(StepFrame())
    result = engine.snapshot.result
    assert result is not None
    parameters.tick(result=result)
    assert f"<b>{100 * result.ground.share:.1f}</b> % ground" in parameters.panel._ground.content
    ground = replace(result.ground, found=False, reason="only 2 seed points")
    parameters.tick(result=replace(result, ground=ground))
    assert "No ground plane: only 2 seed points." in parameters.panel._ground.content


def test_while_a_ground_slider_moves_the_share_before_stands_beside_it(
    parameters: Parameters, engine: FakeEngine
) -> None:
    engine.send(StepFrame())
    result = engine.snapshot.result
    assert result is not None
    before, more = f"(was {100 * result.ground.share:.1f} %)", replace(result.ground, share=result.ground.share + 0.1)
    panel, snapshot = parameters.panel, replace(engine.snapshot, result=result)
    panel.draw(snapshot)
    assert "was" not in panel._ground.content
    for _ in range(2):
        panel.draw(replace(snapshot, result=replace(result, ground=more)), tuning=True)
        assert before in panel._ground.content
    panel.draw(replace(snapshot, result=replace(result, ground=more)))
    assert "was" not in panel._ground.content


def test_each_ground_slider_says_that_it_is_about_the_ground(parameters: Parameters) -> None:
    assert all("ground" in parameters.control(path).hint for path in PRIMARY)


def test_undo_and_redo_are_below_the_sliders_and_never_come_or_go(parameters: Parameters) -> None:
    panel = parameters.panel
    assert panel._undo.order > max(parameters.control(path).order for path in PRIMARY)
    parameters.tick()
    assert panel._undo.visible and panel._undo.disabled and panel._undo.label == "Undo"
    parameters.params = Params().with_values({"ground.sigma": 0.1})
    parameters.tick(5.0)
    assert panel._undo.visible and not panel._undo.disabled and panel._undo.label == "Undo σ thickness"
    assert panel._redo.visible and panel._redo.disabled


def test_undo_never_brings_the_values_of_another_recording_or_side(parameters: Parameters) -> None:
    turned = Params().with_values({"sensor.rotation": (0.0, 90.0, 0.0)})
    first, second = (OpenedRecording(Path(name), 0, 60.0, 600, ()) for name in ("hall.mcap", "walk.mcap"))
    parameters.tick(recording=first)
    parameters.params = turned.with_values({"ground.sigma": 0.1})
    parameters.tick(10.0, recording=first)
    label = parameters.panel._undo.label
    for changes in ({"recording": second}, {"recording": first, "session": APART}):
        parameters.params = turned
        parameters.tick(10.0, **changes)
        assert parameters.panel._undo.disabled and parameters.panel._redo.disabled
    parameters.params = turned.with_values({"ground.sigma": 0.1})
    parameters.tick(10.0, recording=first)
    assert parameters.panel._undo.label == label, "its own changes can be undone again"


def test_changes_that_wait_for_a_restart_are_named_beside_a_restart_button(parameters: Parameters) -> None:
    parameters.tick()
    assert not parameters.panel._restart.visible
    parameters.tick(pending_restart=("imu.gravity",))
    assert parameters.panel._restart.visible and "imu.gravity" in parameters.panel._pending.content
    user_clicks(parameters.panel._restart)
    assert parameters.sent == [Restart()]


def test_a_value_set_in_a_browser_is_sent_although_an_older_snapshot_is_drawn_meanwhile(
    parameters: Parameters, server: viser.ViserServer, busy: BusyThreads
) -> None:
    browser_sends(server, parameters.control("ground.alpha"), 33.0)
    parameters.tick()
    busy.catch_up()
    assert parameters.sent == [SetParams({"ground.alpha": 33.0})]
    assert parameters.control("ground.alpha").value == 33.0


def test_what_is_undone_can_be_redone_although_an_older_snapshot_is_drawn_meanwhile(parameters: Parameters) -> None:
    changed = Params().with_values({"ground.sigma": 0.1})
    parameters.tick()
    parameters.params = changed
    parameters.tick(10.0)
    user_clicks(parameters.panel._undo)
    parameters.tick(0.04)  # the engine is still at a frame
    parameters.params = Params()
    parameters.tick(0.04)
    assert parameters.panel._undo.disabled and parameters.panel._redo.label == "Redo σ thickness"
    user_clicks(parameters.panel._redo)
    parameters.tick(0.04)
    parameters.params = changed
    parameters.tick(0.04)
    assert parameters.panel._redo.disabled and parameters.panel._undo.label == "Undo σ thickness"


def test_a_slow_drag_is_undone_at_once() -> None:
    history = ParameterHistory()
    history.see(Params(), 0.0)
    for number in range(1, 20):
        history.see(Params().with_values({"ground.alpha": 25.0 + number}), 10.0 + 7.0 * number)
    history.see(Params().with_values({"ground.alpha": 44.0, "ground.sigma": 0.1}), 143.5)
    assert history.change(-1) == {"ground.sigma": Params().ground.sigma}, "another slider, however soon"
    history.go(-1)
    assert history.change(-1) == {"ground.alpha": 25.0}


def test_a_drag_that_ends_where_it_began_is_no_change() -> None:
    history = ParameterHistory()
    for seconds, alpha in zip((0.0, 10.0, 20.0, 21.0), (25.0, 30.0, 60.0, 30.0), strict=True):
        history.see(Params().with_values({"ground.alpha": alpha}), seconds)
    assert history.change(-1) == {"ground.alpha": 25.0}


def test_changes_are_undone_and_redone_one_by_one_and_a_drag_is_one_change() -> None:
    history, alphas = ParameterHistory(), (25.0, 30.0, 31.0, 40.0)
    for seconds, alpha in zip((0.0, 10.0, 10.3, 20.0), alphas, strict=True):
        history.see(Params().with_values({"ground.alpha": alpha}), seconds)
    assert history.change(1) == {}
    for expected in (31.0, 25.0):
        assert history.change(-1) == {"ground.alpha": expected}
        history.go(-1)
    assert history.change(-1) == {} and history.change(1) == {"ground.alpha": 31.0}
    history.see(Params().with_values({"ground.sigma": 0.2, "ground.alpha": 25.0}), 30.0)
    assert history.change(1) == {}, "another change takes the place of what was undone"
