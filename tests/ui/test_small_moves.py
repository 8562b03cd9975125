"""Loops move most of a map only slightly: the page gets such moves only when they add up.

Tests app/ui/widgets.py.
"""

import numpy as np
import pytest
import viser

from app.server.protocol import StepFrame
from app.slam import lie
from app.ui.widgets import View
from tests.ui.conftest import Wire
from tests.ui.drawn import Drawn, chunk_nodes
from tests.ui.fake_engine import FakeEngine

STEP_M, STEPS = 3e-4, 30


@pytest.fixture
def drawn(server: viser.ViserServer, engine: FakeEngine) -> Drawn:
    """A walk of three keyframes, coloured by height."""
    drawn = Drawn(server, engine)
    engine.send(StepFrame(14))
    drawn.draw(View(colour_by="height"))
    return drawn


def test_a_drifting_map_is_sent_by_the_millimetre(
    drawn: Drawn, server: viser.ViserServer, wire: Wire, engine: FakeEngine
) -> None:
    poses, walk = engine.snapshot.keyframe_poses, engine.snapshot.trajectory
    assert poses is not None and walk is not None and len(chunk_nodes(server)) > 2
    clouds, paths = [], []
    for step in range(1, STEPS + 1):
        shift = np.array([0.0, step * STEP_M, 0.0])
        moved = poses.copy()
        moved[:, :3, 3] += shift
        wire.clear()
        drawn.draw(keyframe_poses=moved, trajectory=walk + shift)
        clouds.append([name for name in wire.nodes("SetPositionMessage") if name.startswith("/map/keyframes/")])
        paths.append([name for name in wire.nodes("SceneNodeUpdateMessage") if name.startswith("/map/trajectory/")])
        for name, node in chunk_nodes(server).items():
            T = moved[int(name.rpartition("/")[2])]
            assert np.abs(np.array(node.position) - T[:3, 3]).max() < 1.001e-3
    assert [bool(sent) for sent in clouds] == [bool(sent) for sent in paths]
    assert [step for step, sent in enumerate(clouds, 1) if sent] == [*range(4, STEPS + 1, 4)]
    assert {len(sent) for sent in clouds} == {0, len(chunk_nodes(server))}


def test_a_turn_that_is_visible_far_away_is_sent(drawn: Drawn, wire: Wire, engine: FakeEngine) -> None:
    for angle, told in ((3e-5, False), (2e-4, True)):
        turned = engine.snapshot.keyframe_poses.copy()
        turned[0, :3, :3] = lie.exp(np.array([0.0, 0.0, angle])) @ turned[0, :3, :3]
        wire.clear()
        drawn.draw(keyframe_poses=turned)
        assert ("/map/keyframes/0" in wire.nodes("SetOrientationMessage")) is told


def test_heights_that_change_little_by_little_are_coloured_again(
    drawn: Drawn, server: viser.ViserServer, wire: Wire, engine: FakeEngine
) -> None:
    """Also where the clouds are moved for another axis each time, before they have risen by a millimetre."""
    wire.clear()
    for step in range(1, 41):
        risen = engine.snapshot.keyframe_poses.copy()
        risen[:, :3, 3] += step * np.array([0.0, 3e-4, 2e-4])
        drawn.draw(keyframe_poses=risen)
    updates = [m for m in wire.messages if type(m).__name__ == "SceneNodeUpdateMessage" and "colors" in m.updates]
    coloured = [m for m in updates if m.name.startswith("/map/keyframes/")]
    assert {m.name for m in coloured} == set(chunk_nodes(server))
    assert 3 <= len(coloured) / len(chunk_nodes(server)) <= 10
