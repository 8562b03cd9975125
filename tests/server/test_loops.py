"""Loops of the sample recording in a session: found while frames are processed, overridden, undone, replayed."""

import math
import operator
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from test_rewind import SAMPLE, Bench

from app.export.exports import BY_RUN
from app.mapping.checkpoints import DEFAULT_BYTES
from app.mapping.loops import LoopProcess, RestartingLoops
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.server.protocol import (
    EditLoop,
    InspectLoop,
    Pause,
    Play,
    Restart,
    Save,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    TryLoop,
    UndoLoop,
)
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Reject, SetWeight
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.params import Params

FILES = ("trajectory.tum", *(export.name for export in BY_RUN if export.of_loops))
LENGTH_S, LAST = 41.0, 409
"""So far the walk has come back once, through a passage in which odometry drifts by centimetres, and its last frame."""

LEVELLED = 0.01
"""rad, m: what levelling by gravity may turn the map."""


def open_lap(path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
    return open_session(path, params, 0.0, LENGTH_S, truth=truth, checkpoint_bytes=DEFAULT_BYTES)


class Walk(Bench):
    """The first lap of the sample, walked to its end."""

    def __init__(self) -> None:
        super().__init__(resolve_params(SAMPLE, None, None, []), open_lap, SAMPLE)

    def settle(self) -> None:
        """Until nothing is awaited any more, of the loops' process neither."""
        deadline = time.monotonic() + 60
        while (wait := self.controller.work()) is not None:
            assert time.monotonic() < deadline
            time.sleep(wait)

    def saved(self, folder: Path) -> dict[str, bytes]:
        assert not self.do(Save(folder)).saved[-1].error
        return {name: (folder / name).read_bytes() for name in FILES}

    def end(self) -> Snapshot:
        return self.do(Pause(), Seek(LAST - 5), SetSpeed(math.inf), Play())


@pytest.fixture(scope="module")
def walk() -> Iterator[Walk]:
    walk = Walk()
    walk.end()
    yield walk
    walk.controller.close()


@pytest.fixture(scope="module")
def files(walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """As saved at the end, nothing overridden."""
    return walk.saved(tmp_path_factory.mktemp("never_stopped"))


def accepted(snapshot: Snapshot) -> list[LoopEdge]:
    return [edge for edge in snapshot.loops.edges if edge.verdict is Verdict.ACCEPTED]


def test_the_walk_ends_where_it_began_and_that_is_found(walk: Walk) -> None:
    snapshot = walk.end()
    assert len(accepted(snapshot)) >= 3
    assert all(edge.newer - edge.older > 50 for edge in accepted(snapshot))
    assert 0.005 < np.linalg.norm(snapshot.result.T_map_odom[:3, 3]) < 1.0, "the sample's loops move the map"


def test_back_and_on_again_gives_the_same_files(walk: Walk, files: dict[str, bytes], tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for frame in [*rng.integers(0, LAST, 4).tolist(), LAST - 18, 5]:
        snapshot = walk.do(Seek(frame))
        assert len(snapshot.trajectory) == frame + 1
        assert all(edge.decided_at < len(snapshot.chunks) for edge in snapshot.loops.edges)
    walk.end()
    assert walk.saved(tmp_path) == files


def test_before_a_loop_is_found_the_map_is_where_odometry_has_it(walk: Walk) -> None:
    early = walk.do(Seek(200))
    assert not accepted(early)
    np.testing.assert_allclose(early.result.T_map_odom, np.eye(4), atol=LEVELLED)
    walk.end()


def test_all_rejected_leaves_odometry_and_undone_leaves_nothing(
    walk: Walk, files: dict[str, bytes], tmp_path: Path
) -> None:
    before = walk.end()
    loops = accepted(before)
    after = walk.do(*(EditLoop(Reject(*edge.pair)) for edge in loops))
    assert not accepted(after) and len(after.loops.undo) == len(loops)
    kept = after.chunks[: len(before.chunks)]  # clouds of a restarted walk may still come
    assert kept and all(map(operator.is_, kept, before.chunks)), "the map stays as fine"
    np.testing.assert_allclose(after.result.T_map_odom, np.eye(4), atol=LEVELLED)
    moved = np.linalg.norm(after.trajectory - before.trajectory, axis=1)
    assert moved.max() > 0.005
    back = walk.do(*(UndoLoop() for _ in loops))
    assert len(accepted(back)) == len(loops) and len(back.loops.redo) == len(loops)
    assert walk.saved(tmp_path / "undone") == files


def test_a_loop_can_be_looked_at_and_a_command_tried_without_doing_it(walk: Walk) -> None:
    before = walk.end()
    edge = accepted(before)[0]
    seen = walk.do(InspectLoop(edge.pair))
    assert seen.loops.inspected is not None and seen.loops.inspected[0] == edge.pair
    assert len(seen.loops.inspected[1].older) > 100 and seen.loops.residuals
    tried = walk.do(TryLoop(Reject(*edge.pair)))
    assert tried.loops.tried is not None and tried.loops.tried[0] == Reject(*edge.pair)
    assert tried.loops.edges == before.loops.edges and not tried.loops.undo
    assert walk.do(TryLoop(None), InspectLoop(None)).loops.tried is None
    after = walk.do(EditLoop(Reject(*edge.pair)))
    np.testing.assert_allclose(tried.loops.tried[1].poses[:, :3, 3], after.keyframe_poses[:, :3, 3], atol=0.02)
    walk.do(UndoLoop())


def test_what_can_not_be_done_is_said_and_changes_nothing(walk: Walk) -> None:
    before = walk.end()
    after = walk.do(EditLoop(SetWeight(*accepted(before)[0].pair, -1.0)))
    assert after.notices[-1].level == "error" and "weight" in after.notices[-1].text
    assert after.loops.edges == before.loops.edges


# --- what goes wrong -----------------------------------------------------------------------------
def test_a_factor_that_the_solver_fails_with_is_left_out_the_page_says_so_and_the_walk_goes_on(
    walk: Walk, files: dict[str, bytes], tmp_path: Path
) -> None:
    """gtsam raises IndeterminantLinearSystemException with so large a weight."""
    pair = accepted(walk.end())[0].pair
    broken = walk.do(EditLoop(SetWeight(*pair, 1e306)))
    assert f"The solver failed with the loop {pair[0]}-{pair[1]}" in broken.notices[-1].text
    (edge,) = (edge for edge in broken.loops.edges if edge.pair == pair)
    assert edge.verdict is Verdict.REJECTED and "solver" in edge.reason
    assert broken.engine_alive and len(broken.trajectory) and np.isfinite(broken.trajectory).all()
    assert walk.end().transport.frame == broken.transport.frame
    walk.do(UndoLoop())
    assert walk.saved(tmp_path) == files


def test_the_loops_process_killed_twice_is_revived_and_leaves_the_same_files(
    walk: Walk, files: dict[str, bytes], tmp_path: Path
) -> None:
    def kill() -> None:
        assert walk.session.loops is not None
        client = walk.session.loops._client  # only a test has a reason to know it
        assert isinstance(client, RestartingLoops)
        process = client._process
        assert isinstance(process, LoopProcess)
        os.kill(process.pid, signal.SIGKILL)

    walk.do(Seek(300))
    kill()
    ended = walk.end()
    assert any("started again" in notice.text for notice in ended.notices)
    pair = accepted(ended)[0].pair
    walk.controller.handle(EditLoop(Reject(*pair)))
    kill()  # before it has answered
    walk.settle()
    assert walk.see().loops.undo == (Reject(*pair),)
    walk.do(UndoLoop())
    assert walk.saved(tmp_path) == files


def test_edits_do_not_pass_to_the_loops_of_other_keyframes(walk: Walk) -> None:
    """Keyframes are numbered in their order, so with other settings the same numbers are other places.

    The last test, since it leaves the walk with other keyframes.
    """
    rejected = [EditLoop(Reject(*edge.pair)) for edge in accepted(walk.end())]
    assert walk.do(*rejected, SetParams({"keyframe.distance": 1.0})).loops.undo, "for keyframes to come only"
    after = walk.do(Restart())
    assert not after.loops.undo and any("Edits of loops are left out" in notice.text for notice in after.notices)
    edited = walk.do(Play(), EditLoop(Reject(KeyframeId(0, 2), KeyframeId(0, 9))))
    assert edited.loops.undo and walk.do(Restart()).loops.undo, "the same keyframes come again"
    went_on = walk.do(Seek(5), SetParams({"keyframe.distance": 0.5}))
    assert not went_on.loops.undo
