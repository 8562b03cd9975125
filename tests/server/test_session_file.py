"""Session files: reopening restores the session, a headless replay gives the same result, a kill loses only a moment.

Tests app/server/controller.py, app/server/keeping.py, app/server/loop_commands.py, app/server/player.py.
"""

import json
import math
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from test_rewind import SAMPLE, Bench, open_whole, page
from typer.testing import CliRunner

from app.__main__ import cli
from app.export.box import Box
from app.mapping.kept import Clip, Measure, Note, Spot
from app.mapping.session import Session
from app.mapping.session_file import SUFFIX, read_session
from app.sensors.presets import resolve_params
from app.server.controller import Controller
from app.server.keeping import (
    MOST_MEASURES,
    MOST_NOTES,
    AddNote,
    EditMeasure,
    KeepMeasure,
    KeepView,
    SetClip,
)
from app.server.protocol import (
    Calibrated,
    OpenRecording,
    Pause,
    Play,
    Save,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.server.setup import Setup
from app.server.worker import EngineProcess

LENGTH_S = 8.0


class Kept(Bench):
    """A session on the sample that is kept in a folder."""

    def __init__(self, folder: Path, path: Path = SAMPLE) -> None:
        self.folder = folder
        super().__init__(resolve_params(SAMPLE, None, None, []), open_whole, path)

    def _controller(self, opener: Callable[..., Session]) -> Controller:
        return Controller(self.page, self.params, opener, session_folder=self.folder, clock=lambda: 0.0)

    @property
    def session_file(self) -> Path:
        path = self.see().session_file
        assert path is not None
        return path


def test_a_session_whose_clip_cannot_be_opens_in_the_page_and_says_so(tmp_path: Path) -> None:
    bench = Kept(tmp_path)
    bench.do(StepFrame())
    path = bench.session_file
    bench.controller.close()
    text = path.read_text()
    assert '"slab": 1.0' in text
    path.write_text(text.replace('"slab": 1.0', '"slab": 0.0'))
    again = Kept(tmp_path)
    again.do(OpenRecording(path))
    seen = again.see()
    assert seen.recording is not None and any("were left out" in notice.text for notice in seen.notices)
    again.controller.close()


def test_a_recording_has_a_session_file_however_long_its_name_is(tmp_path: Path) -> None:
    path = tmp_path / f"{'w' * 250}.mcap"
    path.symlink_to(SAMPLE)
    bench = Kept(tmp_path / "sessions", path)
    assert read_session(bench.session_file).opened.recording == SAMPLE.resolve()
    assert not [notice for notice in bench.see().notices if notice.level == "error"]
    bench.controller.close()


VIEW = ((1.0, 2.0, 30.5), (0.0, 0.0, 0.0))
CLIP = Clip(Box((-1.0, -2.0, 0.25), (3.0, 2.0, 2.5), 30.0), on=True, slab=0.5)
DOOR = Measure("door", (Spot(1, (0.5, 0.25, -1.0)), Spot(2, (0.5, 0.25, 1.125), 7)))

TURNED = "The LiDAR seems to be rotated by 90°, 0°, 0° on the IMU."


def walk_about(bench: Kept) -> Snapshot:
    """On, back, other parameters, on, and one last wish that no frame has seen yet."""
    bench.do(Seek(30), SetParams({"ground.sigma": 0.02}), Seek(60), Seek(45), SetParams({"scan.voxel_size": 0.6}))
    bench.do(Seek(80), Seek(70), AddNote("a turn"), KeepView(VIEW))
    wrong = Measure("wrong", DOOR.spots[:1])
    bench.do(KeepMeasure(wrong), KeepMeasure(replace(DOOR, name="")), EditMeasure(wrong, ""))
    bench.do(SetClip({"box": CLIP.box, "on": True}), SetClip({"slab": CLIP.slab}))
    bench.do(EditMeasure(replace(DOOR, name=""), DOOR.name), Calibrated(TURNED))
    return bench.do(StepFrame(2), SetParams({"ground.alpha": 35.0}))


def test_a_reopened_session_is_where_it_was_and_goes_on_the_same(tmp_path: Path) -> None:
    first = Kept(tmp_path)
    there = walk_about(first)
    second = Kept(tmp_path, first.session_file)
    again = second.see()
    assert again.params == there.params and again.transport.frame == there.transport.frame == 72
    np.testing.assert_array_equal(again.trajectory, there.trajectory)
    assert again.notes == there.notes == (Note(70, "a turn"),)
    assert again.views == there.views == (VIEW,)
    assert again.measures == there.measures == (DOOR,)
    assert again.clip == there.clip == CLIP
    assert again.resumed and not there.resumed
    assert second.controller._player.session is not None
    assert second.controller._player.session.results().info.calibration == TURNED
    assert again.result is not None and there.result is not None
    np.testing.assert_array_equal(again.result.cloud.labels, there.result.cloud.labels, "relabelled by the last wish")
    third = Kept(tmp_path, second.session_file)  # the one reopened is kept as well
    assert page(first.do(StepFrame(10))) == page(second.do(StepFrame(10))) == page(third.do(StepFrame(10)))
    for bench in (first, second, third):
        bench.controller.close()


def test_a_session_stopped_on_its_way_back_goes_on_as_it_went_unless_it_is_changed_there(tmp_path: Path) -> None:
    first = Kept(tmp_path)
    there = walk_about(first)
    file = first.session_file
    for change, same in (({}, True), ({"ground.alpha": 50.0}, False)):
        bench = Bench(first.params, open_whole, file, settle=False)
        while bench.see().transport.frame < 20:
            bench.controller.work()
        stopped = bench.do(Pause())
        assert stopped.transport.frame < 45
        again = bench.do(SetParams(change), Seek(72))
        assert again.transport.frame == 72
        assert np.array_equal(again.trajectory, there.trajectory) is same
        bench.controller.close()
    first.controller.close()


def test_what_is_wanted_while_a_session_opens_is_not_lost(tmp_path: Path) -> None:
    first = Kept(tmp_path)
    walk_about(first)
    bench = Bench(first.params, open_whole, first.session_file, settle=False)
    for command in (SetParams({"ground.sigma": 0.07}), AddNote("here")):
        bench.controller.handle(command)
    bench.settle()
    opened = bench.see()
    assert opened.params.ground.sigma == 0.07 and opened.notes[-1] == Note(72, "here")
    for each in (first, bench):
        each.controller.close()


def test_notes_are_kept_up_to_a_limit_and_what_is_beyond_it_is_reported(tmp_path: Path) -> None:
    bench = Kept(tmp_path)
    bench.do(*[AddNote(f"note {number}") for number in range(MOST_NOTES + 1)])
    seen = bench.see()
    assert [note.text for note in seen.notes] == [f"note {number}" for number in range(MOST_NOTES)]
    assert "A session holds at most 1,000 notes; this one was not added." in seen.notices[-1].text
    bench.controller.close()


def test_measures_are_kept_up_to_a_limit_and_what_is_beyond_it_is_reported(tmp_path: Path) -> None:
    bench = Kept(tmp_path)
    measures = [Measure(f"point {number}", (Spot(0, (0.0, 0.0, 0.0)),)) for number in range(MOST_MEASURES + 1)]
    bench.do(*map(KeepMeasure, measures))
    seen = bench.see()
    assert seen.measures == tuple(measures[:-1])
    assert "A session holds at most 200 measures; this one was not added." in seen.notices[-1].text
    bench.controller.close()


def test_a_saved_session_repeats_headless_to_the_same_files(tmp_path: Path) -> None:
    bench = Kept(tmp_path)
    walk_about(bench)
    bench.controller.handle(Save(tmp_path / "page"))
    while not bench.see().saved:
        bench.controller.work()
        time.sleep(0.01)
    bench.controller.close()
    file = tmp_path / "page" / f"session{SUFFIX}"
    result = CliRunner().invoke(cli, ["replay", str(file), "--out", str(tmp_path / "again")])
    assert result.exit_code == 0, result.output
    for name in ("trajectory.tum", "trajectory_odometry.tum", "map.ply", "graph.g2o"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "page" / name).read_bytes(), name
    ours, theirs = (json.loads((tmp_path / place / "report.json").read_text()) for place in ("page", "again"))
    assert ours["parameters"] == theirs["parameters"]


def test_an_engine_killed_at_any_moment_goes_on_to_the_same_end(tmp_path: Path) -> None:
    setup = Setup(
        SAMPLE,
        params=resolve_params(SAMPLE, None, None, ["loops.enabled=false"]),
        duration_s=LENGTH_S,
        speed=math.inf,
        play=True,
        session_folder=tmp_path / "kept",
    )
    ends = []
    rng = np.random.default_rng(3)
    for kills in (0, 3):
        engine = EngineProcess(setup)
        try:
            for _ in range(kills):
                _until(engine, lambda s: s.transport.frame >= 0 and s.progress is None)
                time.sleep(rng.uniform(0.0, 0.6))
                if engine.pid is not None and not engine.snapshot.transport.finished:
                    os.kill(engine.pid, signal.SIGKILL)
                    time.sleep(0.5)
            _until(engine, lambda s: s.transport.finished)
            engine.send(Save(tmp_path / str(kills)))
            ends.append(_until(engine, lambda s: bool(s.saved)))
        finally:
            engine.close()
    assert any("returns to where it was" in notice.text for notice in ends[1].notices)
    for name in ("trajectory.tum", "map.ply"):
        assert (tmp_path / "3" / name).read_bytes() == (tmp_path / "0" / name).read_bytes(), name


def _until(engine: EngineProcess, wanted: Callable[[Snapshot], bool]) -> Snapshot:
    deadline = time.monotonic() + 60
    snapshot = engine.snapshot
    while not wanted(snapshot):
        assert time.monotonic() < deadline, snapshot.transport
        snapshot = engine.wait(snapshot.revision, timeout=1.0)
    return snapshot


def test_a_session_file_opens_in_the_page_too(tmp_path: Path) -> None:
    bench = Kept(tmp_path)
    bench.do(SetSpeed(0.5), Seek(20), SetParams({"ground.sigma": 0.02}), StepFrame(3))
    other = Kept(tmp_path)
    there = other.do(OpenRecording(bench.session_file))
    assert there.transport.frame == 23 and there.params.ground.sigma == 0.02
    assert other.do(Play()).transport.playing
    bench.controller.close()
    other.controller.close()
