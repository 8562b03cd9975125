"""Tests app/ui/calibration.py: the calibration panel shows and applies the result of a separate process."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.calibration.words import write_beside
from app.mapping.kept import Note
from app.sensors.presets import calibrated_beside, resolve_params, sidecar
from app.sensors.probe import NO_IMU
from app.server.protocol import (
    Calibrated,
    Command,
    Notice,
    OpenedRecording,
    Restart,
    SetParams,
    Snapshot,
)
from app.slam.params import Params
from app.ui import background
from app.ui.calibration import CalibrationPanel, FoundMounting
from tests.ui.conftest import page_of, user_clicks

FOUND = {"sensor.rotation": [70.0, -50.0, 104.0]}
OPEN = Snapshot(recording=OpenedRecording(Path("walk.mcap"), 0, 30.0, 300, ()))


def with_preset(recording: Path, *, calibrated: bool = True) -> Params:
    return resolve_params(recording, "h2lid-mount", None, [], calibrated=calibrated)


class Process:
    """Stands for the process; the test says what it sends."""

    def __init__(self, told: Any, main: Any, *args: Any, **_: Any) -> None:
        self.arguments, self.messages, self.closed = args, [], False

    def news(self) -> Any:
        return self.messages.pop(0) if self.messages else None

    def close(self, timeout: float | None = None) -> None:
        self.closed = True


class Calibrating:
    def __init__(self, server: viser.ViserServer, *, unasked: bool = False) -> None:
        self.sent: list[Command] = []
        self.now = OPEN
        page = page_of(server, self.sent.append, lambda: self.now)
        self.panel = CalibrationPanel(page, unasked=unasked, resolve=with_preset)

    def draw(self, now: Snapshot) -> None:
        self.now = now
        self.panel.draw(now)

    def found(self, message: Any) -> None:
        """The user asks for a calibration, which finds this."""
        user_clicks(self.panel._button)
        self.process().messages.append(message)
        self.draw(self.now)

    def process(self) -> Any:
        return self.panel._work._child


@pytest.fixture
def page(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calibrating:
    monkeypatch.setattr(background, "Child", Process)
    monkeypatch.chdir(tmp_path)
    page = Calibrating(server)
    page.draw(OPEN)
    return page


def test_a_click_finds_and_another_applies_what_was_found(page: Calibrating) -> None:
    panel = page.panel
    user_clicks(panel._button)
    process = page.process()
    assert process.arguments == (Path("walk.mcap"), Params())
    process.messages += [0.25, 0.5]
    panel.draw(OPEN)
    assert panel._work._bar.visible and panel._work._bar.value == 50 and panel._button.disabled
    process.messages.append(
        FoundMounting([("rotation of the LiDAR on the IMU", "roll 70.00 ± 0.05 <deg>")], FOUND, "<svg/>")
    )
    panel.draw(OPEN)
    assert process.closed and not panel._work._bar.visible and panel._apply.visible
    assert "roll 70.00 ± 0.05 &lt;deg&gt;" in panel._html.content and page.sent == []
    user_clicks(panel._apply)
    assert page.sent == [SetParams(FOUND), Restart(stay=True), Calibrated("")] and "<svg/>" in panel._plot.content
    user_clicks(panel._apply)
    assert page.sent[3:] == [SetParams({"sensor.rotation": (0.0, 0.0, 0.0)}), Restart(stay=True), Calibrated("")]


def test_nothing_is_applied_while_there_is_no_engine_to_take_it(page: Calibrating) -> None:
    page.found(FoundMounting([], FOUND))
    page.draw(replace(OPEN, engine_alive=False))
    assert page.panel._apply.disabled
    page.draw(OPEN)
    assert not page.panel._apply.disabled


def test_it_can_be_stopped_and_what_was_applied_before_can_still_be_undone(page: Calibrating) -> None:
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    page.draw(page.now)
    user_clicks(page.panel._button)
    process = page.process()
    assert page.panel._work._stop.visible and page.panel._apply.disabled, "nothing is applied meanwhile"
    user_clicks(page.panel._work._stop)
    assert process.closed and not page.panel._work._stop.visible and not page.panel._work._bar.visible
    page.draw(page.now)
    assert not page.panel._button.disabled
    assert page.panel._apply.label == "Undo" and page.panel._apply.visible and not page.panel._apply.disabled
    user_clicks(page.panel._apply)
    assert not sidecar(WALK).exists()


WALK = Path("walk.mcap")
GIVEN = with_preset(WALK)


def test_what_is_applied_is_kept_beside_the_recording_until_it_is_undone(page: Calibrating) -> None:
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    assert with_preset(WALK) == GIVEN.with_values(FOUND)
    assert "kept" in page.panel._html.content and str(sidecar(WALK)) in page.panel._html.content
    assert not page.panel._keep.visible
    user_clicks(page.panel._apply)
    assert not sidecar(WALK).exists() and "kept" not in page.panel._html.content


def test_undoing_brings_a_file_back_that_somebody_wrote(page: Calibrating) -> None:
    mine = "# mine\nsensor:\n  rotation: [1, 2, 3]\n  max_range: 40\n"
    sidecar(WALK).write_text(mine)
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    sensor = with_preset(WALK).sensor
    assert (sensor.rotation, sensor.max_range) == ((70.0, -50.0, 104.0), 40)
    user_clicks(page.panel._apply)
    assert sidecar(WALK).read_text() == mine and not Path("walk.params.yaml.old").exists()


def test_what_cannot_be_put_back_is_said_with_the_file_that_holds_it(
    page: Calibrating, monkeypatch: pytest.MonkeyPatch
) -> None:
    sidecar(WALK).write_text("sensor:\n  max_range: 40\n")
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)

    def full(path: Path, _: bytes) -> int:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    user_clicks(page.panel._apply)
    shown = page.panel._html.content
    assert "No space left" in shown and "rename walk.params.yaml.old to walk.params.yaml" in shown
    assert Path("walk.params.yaml.old").exists()


def test_a_full_disk_loses_no_file_that_somebody_wrote(page: Calibrating, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = "sensor:\n  max_range: 40\n"
    sidecar(WALK).write_text(mine)
    write_beside(WALK, FOUND)  # mine is only in the file .old now
    kept = sidecar(WALK).read_text()
    write_text = Path.write_text

    def half(path: Path, text: str, **options: Any) -> int:
        write_text(path, text[: len(text) // 2], **options)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", half)
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    assert "No space left" in page.panel._html.content and page.panel._keep.visible
    assert sidecar(WALK).read_text() == kept and Path("walk.params.yaml.old").read_text() == mine


def test_what_cannot_be_kept_is_used_all_the_same_and_said(page: Calibrating) -> None:
    sidecar(WALK).mkdir()
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    assert page.sent[0] == SetParams(FOUND) and "not kept" in page.panel._html.content and page.panel._keep.visible
    sidecar(WALK).rmdir()
    user_clicks(page.panel._keep)
    assert calibrated_beside(WALK) and not page.panel._keep.visible


def test_calibrating_again_counts_nothing_that_was_found_before(page: Calibrating) -> None:
    page.draw(replace(OPEN, params=GIVEN))
    page.found(FoundMounting([], FOUND))
    user_clicks(page.panel._apply)
    page.draw(replace(OPEN, params=GIVEN.with_values(FOUND)))
    user_clicks(page.panel._button)
    assert page.process().arguments == (WALK, GIVEN)


def test_a_calibration_beside_the_recording_does_not_count_either(page: Calibrating) -> None:
    write_beside(WALK, FOUND | {"recording.imu_time_offset": 0.02})
    page.draw(replace(OPEN, params=with_preset(WALK).with_values({"recording.imu_time_offset": 0.03})))
    user_clicks(page.panel._button)
    mine = GIVEN.with_values({"recording.imu_time_offset": 0.03})
    assert page.process().arguments == (WALK, mine), "what the user set since then stays"


def test_what_cannot_be_reported_is_said_and_nothing_is_offered(page: Calibrating) -> None:
    user_clicks(page.panel._button)
    page.process().messages.append("walk.mcap has 12 usable scans; it takes 50.")
    page.panel.draw(OPEN)
    assert "12 usable scans" in page.panel._html.content and not page.panel._apply.visible
    page.panel.draw(OPEN)
    assert not page.panel._button.disabled


def test_another_recording_ends_it_and_forgets_what_was_found(page: Calibrating) -> None:
    user_clicks(page.panel._button)
    process = page.process()
    assert OPEN.recording is not None
    page.panel.draw(replace(OPEN, recording=replace(OPEN.recording, path=Path("other.mcap"))))
    assert process.closed and page.process() is None and not page.panel._apply.visible


def test_without_a_recording_there_is_nothing_to_calibrate(server: viser.ViserServer) -> None:
    panel = CalibrationPanel(page_of(server, [].append, Snapshot))
    panel.draw(Snapshot())
    assert panel._button.disabled


TOLD = FoundMounting([("position", "unknown")], FOUND, "", "The LiDAR seems to be turned by 70°, -50°, 104° on the IMU")

ADVICE = Calibrated(f"{TOLD.contradiction}. To apply it, see Calibration under Recording.")


@pytest.fixture
def unasked(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calibrating:
    monkeypatch.setattr(background, "Child", Process)
    monkeypatch.chdir(tmp_path)
    return Calibrating(server, unasked=True)


def test_an_unknown_mounting_is_found_and_used_on_opening_and_undone_by_a_click(unasked: Calibrating) -> None:
    unasked.draw(OPEN)
    unasked.process().messages.append(TOLD)
    unasked.draw(OPEN)
    told = Calibrated(f"{TOLD.contradiction}; this was found in the recording and is used.")
    assert unasked.sent == [SetParams(FOUND), Restart(stay=True), told] and unasked.panel._apply.label == "Undo"
    assert "turned by 70°" in unasked.panel._html.content
    assert not sidecar(WALK).exists() and unasked.panel._keep.visible, "nobody asked for a file"
    unasked.draw(replace(OPEN, params=Params().with_values(FOUND)))
    unasked.draw(OPEN)
    assert unasked.process() is None, "it begins once for each recording"


def test_what_somebody_made_in_the_meantime_is_not_restarted(unasked: Calibrating) -> None:
    unasked.draw(OPEN)
    unasked.process().messages.append(TOLD)
    unasked.draw(replace(OPEN, notes=(Note(3, "a door"),)))
    assert unasked.sent == [ADVICE] and unasked.panel._apply.label == "Apply" and unasked.panel._apply.visible


def test_a_given_mounting_is_questioned_only_by_a_run_in_doubt_and_never_replaced_unasked(unasked: Calibrating) -> None:
    given = replace(OPEN, params=Params().with_values({"sensor.rotation": [0, 0, 90]}))
    unasked.draw(given)
    assert unasked.process() is None
    doubtful = replace(given, notices=(Notice(1, "warning", "This run is doubtful. It moves at up to 20 m/s."),))
    unasked.draw(doubtful)
    unasked.process().messages.append(TOLD)
    unasked.draw(doubtful)
    assert unasked.sent == [ADVICE] and unasked.panel._apply.visible and unasked.panel._apply.label == "Apply"


def test_without_an_imu_there_is_no_mounting_to_look_for(unasked: Calibrating) -> None:
    assert OPEN.recording is not None
    unasked.draw(replace(OPEN, recording=replace(OPEN.recording, findings=(NO_IMU,))))
    assert unasked.process() is None


def test_a_session_that_is_continued_keeps_its_parameters(unasked: Calibrating) -> None:
    unasked.draw(replace(OPEN, resumed=True))
    assert unasked.process() is None and unasked.sent == []


def test_a_doubt_about_an_earlier_recording_says_nothing_about_this_one(unasked: Calibrating) -> None:
    before = (Notice(7, "warning", "This run is doubtful. It moves at up to 20 m/s."),)
    given = replace(OPEN, params=Params().with_values({"sensor.rotation": [0, 0, 90]}), notices=before)
    unasked.draw(given)
    assert unasked.process() is None


def test_two_pages_that_press_calibrate_at_once_start_one_process(
    page: Calibrating, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Process] = []

    class Slow(Process):
        def __init__(self, *args: Any, **more: Any) -> None:
            super().__init__(*args, **more)
            started.append(self)
            time.sleep(0.3)

    monkeypatch.setattr(background, "Child", Slow)
    with ThreadPoolExecutor(2) as threads:
        for _ in range(2):
            threads.submit(page.panel._begin)
    assert len(started) == 1 and page.process() is started[0]
