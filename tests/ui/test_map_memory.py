"""What the page shows of a long walk takes the memory that the map gives up for it (`app.server.chunks.room`)."""

import gc
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import viser

from app.server import wire
from app.server.chunks import CANDIDATE_POINTS, FRAME_POINTS, KEYFRAME_POINTS, coarser
from app.server.edges import EdgesChange, EdgesReceiver
from app.server.protocol import Chunk
from app.slam.loops.types import Evidence, LoopEdge, Measured, Verdict
from app.ui.chunks import MapChunks
from app.ui.loops.edges import LoopEdges
from app.ui.loops.kinds import Kind
from app.ui.paths import Trajectory
from app.ui.view import View

Held = Callable[[], int]
POINT_BYTES = 29.4
"""As the first test measures."""
MANY = 1000


@pytest.fixture
def held() -> Iterator[Held]:
    """Bytes since the test began; those that are mapped files, as poses and positions of a snapshot, do not count."""

    def now() -> int:
        gc.collect()
        time.sleep(0.2)  # what is on its way to nobody
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    yield now
    tracemalloc.stop()


def chunk(index: int, points: int) -> Chunk:
    rng = np.random.default_rng(index)
    return Chunk(
        index=index,
        frame=5 * index,
        stamp_ns=10**18 + index,
        points=rng.random((points, 3), dtype=np.float32),
        labels=np.zeros(points, np.uint8),
        intensity=np.zeros(points, np.float32),
        ring=np.zeros(points, np.uint16),
        T_imu_lidar=np.eye(4),
    )


def test_a_point_of_the_map_takes_as_much_as_is_said(server: viser.ViserServer, held: Held) -> None:
    chunks, there = MapChunks(server.scene, "/map/keyframes"), (chunk(0, 6000),)
    chunks.clear(0, 100.0)
    chunks.draw(there, np.eye(4)[None], View())  # the first time something is loaded
    before = held()
    for index in range(1, 41):
        there = (*there, wire.unpack(wire.pack(chunk(index, 6000))))
        chunks.draw(there, np.tile(np.eye(4), (len(there), 1, 1)), View())
    taken = held() - before
    assert taken / (40 * 6000) == pytest.approx(POINT_BYTES, rel=0.05)


def test_a_keyframe_without_points_takes_no_more_than_the_map_gives_up_for_it(
    server: viser.ViserServer, held: Held
) -> None:
    chunks, there = MapChunks(server.scene, "/map/keyframes"), ()
    chunks.clear(0, 100.0)
    none = coarser(chunk(0, 0))
    before = held()
    for first in range(0, MANY, 100):
        there = (*there, *(replace(none, index=k, frame=5 * k, stamp_ns=10**18 + k) for k in range(first, first + 100)))
        chunks.draw(there, np.tile(np.eye(4), (len(there), 1, 1)), View())
    own_poses = 2 * 128  # of the newest snapshot and one before it
    assert 0.5 < ((held() - before) / MANY + own_poses) / (KEYFRAME_POINTS * POINT_BYTES) < 1


def test_a_frame_takes_no_more_than_the_map_gives_up_for_it(server: viser.ViserServer, held: Held) -> None:
    walk = np.cumsum(np.random.default_rng(0).normal(0, 0.1, (5_000, 3)), axis=0)
    path = Trajectory(server.scene, "/map/trajectory")
    before = held()
    for count in range(100, len(walk) + 1, 100):
        path.draw(walk[:count], True)
    path.draw(walk + 0.01, True)  # as when a loop has moved it
    own_positions = 24  # of the newest snapshot
    assert 0.5 < ((held() - before) / len(walk) + own_positions) / (FRAME_POINTS * POINT_BYTES) < 1


def test_a_candidate_takes_no_more_than_the_map_gives_up_for_it(server: viser.ViserServer, held: Held) -> None:
    receiver, arches = EdgesReceiver(), LoopEdges(server.scene, "/map/loops")
    poses = np.tile(np.eye(4), (MANY + 600, 1, 1))
    before = held()
    for index in range(MANY):
        receiver.take(wire.unpack(wire.pack(EdgesChange(not index, (candidate(MANY - index, 500 + index),), ()))))
        if index % 10 == 9:
            arches.draw(receiver.edges, poses, frozenset(Kind), None)
    assert 0.5 < (held() - before) / MANY / (CANDIDATE_POINTS * POINT_BYTES) < 1


def candidate(older: int, newer: int) -> LoopEdge:
    """One of eight counts; every other one has words of its own."""
    measured = Measured(np.eye(4), np.eye(6), Evidence(*np.random.default_rng(newer).random(9), 3))
    first = (older + older % 8, newer - newer % 8) if newer % 8 else None
    verdict, words = Verdict.ACCEPTED, "{}; 3 others agree"
    if newer % 2:
        verdict, words = Verdict.REJECTED, f"the residual is {newer:05d} m, and that is more than there may be of it"
    return LoopEdge(older, newer, newer + 8, measured, verdict, words, represented_by=first)
