"""The scene after going back, opening another recording, and replacing keyframes.

Tests app/ui/scene.py and app/ui/chunks.py.
"""

from dataclasses import replace

import numpy as np
import pytest
import viser

from app.server import chunks as server_chunks
from app.server.chunks import within_budget
from app.server.protocol import Command, Restart, Seek, StepFrame
from app.ui.chunks import MapChunks
from app.ui.colours import COLOUR_BY
from app.ui.widgets import View
from tests.ui.conftest import Wire, clouds
from tests.ui.drawn import Drawn, chunk_nodes
from tests.ui.fake_engine import FakeEngine


@pytest.mark.parametrize("steps", [((Restart(), 0), (StepFrame(14), 3)), ((Seek(40), 7), (Seek(3), 1))])
def test_going_back_and_forth_leaves_nothing_behind(
    drawn: Drawn, wire: Wire, server: viser.ViserServer, steps: tuple[tuple[Command, int], ...]
) -> None:
    kept = []
    for _ in range(4):
        for command, chunks in steps:
            drawn.engine.send(command)
            drawn.draw()
            assert len(chunk_nodes(server)) == chunks
        server._run_garbage_collector(force=True)
        kept.append(wire.kept)
    assert kept[0] == kept[-1]


def shown(drawn: Drawn, server: viser.ViserServer) -> dict[str, object]:
    path = {
        name: handle.points.tobytes()
        for name, handle in server.scene._handle_from_node_name.items()
        if name.startswith("/map/trajectory/") and isinstance(handle, viser.LineSegmentsHandle)
    }
    map_points = {name: (node.points.tobytes(), node.colors.tobytes()) for name, node in chunk_nodes(server).items()}
    return {"path": path, "map": map_points, "limits": {by: drawn.scene.chunks.limits.get(by) for by in COLOUR_BY}}


@pytest.mark.parametrize("by", ["label", "height"])
def test_going_back_and_forth_shows_what_was_shown_then(server: viser.ViserServer, engine: FakeEngine, by: str) -> None:
    drawn, then = Drawn(server, engine), {}
    for frame in (12, 20, 300):
        engine.send(Seek(frame))
        drawn.draw(View(colour_by=by))
        then[frame] = shown(drawn, server)
    for frame in (20, 12, 20, 300):
        engine.send(Seek(frame))
        drawn.draw()
        assert shown(drawn, server) == then[frame]


def test_a_keyframe_that_another_walk_put_in_place_of_one_is_drawn(drawn: Drawn, server: viser.ViserServer) -> None:
    first, *rest = drawn.engine.snapshot.chunks
    other = replace(rest[0], points=rest[0].points + np.float32(1.0))
    drawn.draw(View(ceilings=True), chunks=(first, other, *rest[1:]))
    assert np.array_equal(chunk_nodes(server)["/map/keyframes/1"].points, other.points.astype(np.float16))


def test_of_keyframes_that_gave_their_points_away_no_node_is_left(
    drawn: Drawn, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_chunks, "MOST_SHOWN", 5)
    first = drawn.engine.snapshot.chunks[0]
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    map_chunks, held = MapChunks(server.scene, "/other"), ()
    map_chunks.clear(0, 100.0)
    for index in range(40):
        held = within_budget((*held, replace(first, index=index)), poses, poses[index, :3, 3], 10**9)
        map_chunks.draw(held, poses[: index + 1], View(ceilings=True))
    assert sum(name.startswith("/other/") for name in server.scene._handle_from_node_name) == 5
    nodes = [cloud for name, cloud in clouds(server).items() if name.startswith("/other/")]
    assert sorted(node.position for node in nodes) == sorted(
        tuple((poses[one.index] @ one.T_imu_lidar)[:3, 3]) for one in held if len(one.points)
    )
    assert map_chunks.points == 40 * len(first.points)
