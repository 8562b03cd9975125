"""A fork of a walk with loops: identical if nothing differs, and a loop edit in B moves only B."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from test_fork import both_at, same, until

from app.sensors.presets import resolve_params
from app.server.fork import Workspace
from app.server.protocol import EditLoop, Play, Seek, Snapshot, UndoLoop
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.loops.edits import SetWeight
from app.slam.loops.types import Pair, Verdict
from tests.rounds import AS_LOOPS, walk_round

BEFORE, LAST = 110, 118


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workspace]:
    """A where a walk round a room has its first loops, and B from there on."""
    folder = tmp_path_factory.mktemp("kept")
    recording = walk_round(folder / "room.mcap")
    params = resolve_params(recording, None, None, [AS_LOOPS])
    setup = Setup(recording, params=params, speed=math.inf, session_folder=folder)
    workspace = Workspace(EngineProcess(setup), setup, EngineProcess)
    until(lambda: workspace.snapshot, lambda s: s.transport.frame == 0)
    workspace.send(Seek(BEFORE))
    until(lambda: workspace.snapshot, lambda s: s.transport.frame == BEFORE)
    workspace.fork("twin")
    both_at(workspace, BEFORE)
    yield workspace
    workspace.close()


def accepted(snapshot: Snapshot) -> list[Pair]:
    return [edge.pair for edge in snapshot.loops.edges if edge.verdict is Verdict.ACCEPTED]


def agreed(workspace: Workspace) -> tuple[Snapshot, Snapshot]:
    """Both at the end, with the same loops: those of the last frames come a little after them."""
    both_at(workspace, LAST)
    for read in (lambda: workspace.snapshot, lambda: workspace.other):
        until(read, lambda s: s.transport.finished and len(accepted(s)) >= 3)
    b = until(lambda: workspace.other, lambda s: accepted(s) == accepted(workspace.snapshot))
    return workspace.snapshot, b


def test_a_fork_with_the_same_parameters_has_the_same_loops_and_map(walked: Workspace) -> None:
    walked.send(Play())  # to the end, where the last loops are found
    a, b = agreed(walked)
    same(a, b)
    np.testing.assert_array_equal(a.keyframe_poses, b.keyframe_poses)


def test_a_word_on_a_loop_in_b_moves_b_alone_and_undone_leaves_nothing(walked: Workspace) -> None:
    before, _ = agreed(walked)
    pair = accepted(before)[-1]
    walked.send_other(EditLoop(SetWeight(*pair, 20.0)))
    b = until(lambda: walked.other, lambda s: s.loops.undo == (SetWeight(*pair, 20.0),))
    a = walked.snapshot
    assert accepted(a) == accepted(before) and not a.loops.undo
    np.testing.assert_array_equal(a.trajectory, before.trajectory)
    assert np.abs(a.trajectory - b.trajectory).max() > 1e-4
    walked.send_other(UndoLoop())
    until(lambda: walked.other, lambda s: not s.loops.undo and np.array_equal(s.trajectory, walked.snapshot.trajectory))
    same(*agreed(walked))
