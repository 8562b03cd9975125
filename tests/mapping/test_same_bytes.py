"""The workbench, `replay` of its session and `run` write the same bytes, even with loops found only at the end.

Tests app/mapping/opening.py, app/mapping/saving.py.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from app.__main__ import cli
from app.mapping.checkpoints import DEFAULT_BYTES
from app.mapping.kept import Kept, Measure, Spot
from app.mapping.opening import open_session
from app.mapping.saving import mark
from app.mapping.session import Session
from app.mapping.session_file import SUFFIX, read_session, write_session
from app.sensors.presets import resolve_params
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.keeping import AddNote
from app.server.protocol import (
    Command,
    EditLoop,
    OpenRecording,
    Play,
    RedoLoop,
    Restart,
    Save,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
    UndoLoop,
)
from app.server.publisher import Publisher
from app.slam.loops import edit_files
from app.slam.loops.edits import Accept, Add, Reject, SetWeight
from app.slam.loops.service import InlineLoops
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.params import Params
from tests.rounds import AS_LOOPS, walk_round

SAMPLE = next((Path(__file__).resolve().parents[2] / "sample_data").glob("*.mcap"))
FILES = ("trajectory.tum", "trajectory_odometry.tum", "loops.csv", "graph.g2o", "map.ply")
LENGTH_S = 16.0
"""Long enough for the sample's first loops with AS_LOOPS; the other recordings are shorter."""
SHORT = ("--duration", str(LENGTH_S), "--set", AS_LOOPS)
ROOMS = ["perfect", "imperfect"]


class Workbench:
    """The engine's side of the workbench."""

    def __init__(self, recording: Path) -> None:
        self._params = resolve_params(recording, None, None, [AS_LOOPS])
        self._page, self._fold = Publisher(self._params), Fold()
        self.controller = Controller(self._page, self._params, self._open)
        self.controller.open(recording, None)
        self.do(SetSpeed(math.inf))

    @staticmethod
    def _open(path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
        return open_session(path, params, 0.0, LENGTH_S, truth=truth, checkpoint_bytes=DEFAULT_BYTES)

    def do(self, *commands: Command) -> Snapshot:
        """Until nothing is awaited any more."""
        for command in commands:
            self.controller.handle(command)
            deadline = time.monotonic() + 120
            while (wait := self.controller.work()) is not None:
                assert time.monotonic() < deadline
                time.sleep(wait)
        if self._page.filled:
            self._fold.apply(self._page.take())
        return self._fold.snapshot

    def saved(self, folder: Path) -> dict[str, bytes]:
        assert not self.do(Save(folder)).saved[-1].error
        return read(folder)


def read(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in FILES}


def accepted(snapshot: Snapshot) -> list[LoopEdge]:
    return [edge for edge in snapshot.loops.edges if edge.verdict is Verdict.ACCEPTED]


def hemislam(folder: Path, *words: str) -> dict[str, bytes]:
    call(folder, *words)
    return read(folder)


def call(folder: Path, *words: str) -> str:
    """What the command line prints."""
    result = CliRunner().invoke(cli, [*words, "--out", str(folder)])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module", params=["sample", *ROOMS])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample, and two that are simulated."""
    if request.param == "sample":
        return SAMPLE
    return walk_round(tmp_path_factory.mktemp("simulated") / "room.mcap", perfect=request.param == "perfect")


@dataclass
class Played:
    """A workbench that played to the end, and what it saved then."""

    workbench: Workbench
    folder: Path
    saved: dict[str, bytes]


@pytest.fixture(scope="module")
def undisturbed(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Played]:
    workbench = Workbench(recording)
    ended = workbench.do(Play())
    assert ended.transport.finished and accepted(ended)
    folder = tmp_path_factory.mktemp("undisturbed")
    yield Played(workbench, folder, workbench.saved(folder))
    workbench.controller.close()


@pytest.fixture
def played(undisturbed: Played) -> Iterator[Played]:
    """Without edits, which each test leaves it."""
    yield undisturbed
    while undisturbed.workbench.do().loops.undo:
        undisturbed.workbench.do(UndoLoop())


def test_an_undisturbed_session_a_replay_and_a_run_write_the_same(
    recording: Path, undisturbed: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the sample, all three look for loops in another process; in the rooms only the page does, to save time."""
    if recording != SAMPLE:
        monkeypatch.setattr("app.mapping.opening.open_session", partial(open_session, loops=InlineLoops))
    session = undisturbed.folder / f"session{SUFFIX}"
    assert hemislam(tmp_path / "run", "run", str(recording), *SHORT) == undisturbed.saved
    assert hemislam(tmp_path / "replay", "replay", str(session)) == undisturbed.saved


@pytest.mark.parametrize("recording", ROOMS, indirect=True)
def test_a_session_with_detours_edits_other_parameters_and_a_fork_is_replayed_to_the_same(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page has a process for its loops. The replays look for them in this one, which saves six starts."""
    workbench = Workbench(recording)
    monkeypatch.setattr("app.mapping.opening.open_session", partial(open_session, loops=InlineLoops))
    opened = workbench.do().recording
    assert opened is not None
    middle = opened.frames // 2
    workbench.do(Seek(middle), SetParams({"filter.max_iterations": 3}), EditLoop(Add(0, 5, register=False)))
    workbench.do(StepFrame(30), Seek(middle - 30), SetParams({"ground.sigma": 0.05, "moving.seen_through": 4}))
    found = [edge.pair for edge in accepted(workbench.do(Play())) if edge.pair != (0, 5)]
    assert found, "else there is nothing to edit"
    workbench.do(EditLoop(Reject(*found[0])), UndoLoop(), EditLoop(Reject(*found[-1])))
    saved = {"end": workbench.saved(tmp_path / "end")}
    workbench.do(StepFrame(-3))
    saved["before"] = workbench.saved(tmp_path / "before")
    assert saved["end"]["loops.csv"] != saved["before"]["loops.csv"], "the end brings loops"
    session = read_session(tmp_path / "end" / f"session{SUFFIX}")
    write_session(tmp_path / f"fork{SUFFIX}", session.forked(middle, Params()))
    assert workbench.do(OpenRecording(tmp_path / f"fork{SUFFIX}"), Play()).transport.finished
    saved["fork"] = workbench.saved(tmp_path / "fork")
    assert saved["fork"]["trajectory.tum"] != saved["end"]["trajectory.tum"]
    workbench.controller.close()
    for name in ("end", "fork", "before"):
        again = hemislam(tmp_path / f"{name}-again", "replay", str(tmp_path / name / f"session{SUFFIX}"))
        assert again == saved[name], name


@pytest.mark.parametrize("recording", ["imperfect"], indirect=True)
def test_playing_again_from_the_end_or_restarting_keeps_the_edits(played: Played, tmp_path: Path) -> None:
    workbench = played.workbench
    last = accepted(workbench.do())[-1].pair
    workbench.do(EditLoop(Reject(*last)), AddNote("a door"))
    edited = workbench.saved(tmp_path / "edited")
    assert edited != played.saved
    assert workbench.do(Play()).transport.finished
    assert workbench.saved(tmp_path / "played") == edited
    restarted = workbench.do(Restart(), Play())
    assert restarted.transport.finished and restarted.notes[-1].text == "a door"
    assert restarted.loops.undo == (Reject(*last),) and last not in [edge.pair for edge in accepted(restarted)]
    workbench.do(UndoLoop())
    assert workbench.saved(tmp_path / "undone") == played.saved


@pytest.mark.parametrize("recording", ["imperfect"], indirect=True)
def test_the_file_of_what_was_done_in_the_page_repeats_it_headless(
    recording: Path, played: Played, tmp_path: Path
) -> None:
    workbench = played.workbench
    first, *_, last = (edge.pair for edge in accepted(workbench.do()))
    workbench.do(EditLoop(Reject(*first)), EditLoop(SetWeight(*last, 0.1)))
    snapshot = workbench.do(EditLoop(Accept(*first)), UndoLoop(), RedoLoop(), UndoLoop())
    path = tmp_path / "edits.yaml"
    path.write_text(edit_files.write(snapshot.loops.undo) + "- accept: [1, 2]\n")
    ours = workbench.saved(tmp_path / "page")
    printed = call(tmp_path / "headless", "run", str(recording), *SHORT, "--loops", str(path))
    assert "Accept 1-2 has no effect" in printed
    assert read(tmp_path / "headless") == ours


def test_what_was_measured_on_keyframes_of_other_settings_is_not_saved() -> None:
    at = (0.5, 0.25, -1.0)
    spots = {"here": Spot(1, at, 49), "other": Spot(1, at, 45), "older file": Spot(0, at), "later": Spot(2, at, 84)}
    results: Any = SimpleNamespace(keyframes=[SimpleNamespace(frame=0), SimpleNamespace(frame=49)])
    mark(results, Kept(measures=tuple(Measure(name, (spot,)) for name, spot in spots.items())))
    assert results.marks == (("here", ((1, at),)), ("older file", ((0, at),)))
