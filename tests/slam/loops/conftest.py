"""A walk of one and a half laps round the corridor with drifting odometry, and the loop back end after this walk."""

from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import pytest

from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Edits, LoopEdit
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe
from tests.slam.loops.walks import Walk, drive, take

PARAMS = LoopsParams(submap_keyframes=5, submap_voxel=0.35)
"""Coarser than by default, which finds the same loops in half the time."""


def same(ours: tuple[LoopEdge, ...], theirs: tuple[LoopEdge, ...]) -> bool:
    """To the last bit."""
    return [_values(edge) for edge in ours] == [_values(edge) for edge in theirs]


def accepted(backend: LoopBackend) -> list[LoopEdge]:
    return [edge for edge in backend.edges if edge.verdict is Verdict.ACCEPTED]


def applied(backend: LoopBackend, command: LoopEdit) -> LoopEdge:
    backend.apply(command)
    return next(edge for edge in backend.edges if edge.pair == (command.older, command.newer))


def _values(edge: LoopEdge) -> list[object]:
    values = [getattr(edge, field.name) for field in fields(edge)]
    return [value.tobytes() if isinstance(value, np.ndarray) else repr(value) for value in values]


class Walked:
    """Attributes:
    walk: with exact odometry. keyframes: with odometry that drifts. backend: after all of them.
    poses, edges: what `backend` had after each keyframe, when it first came there; last, at the end.
    """

    def __init__(self) -> None:
        self.walk: Walk = take("corridor", 95.0)
        self.keyframes: tuple[Keyframe, ...] = self.walk.drifted(0.01, 0.03)
        self.halfway = 7 * len(self.keyframes) // 8
        self.poses: list[F64] = []
        self.edges: list[tuple[LoopEdge, ...]] = []
        self.backend = drive(self.keyframes, PARAMS, self._watch)
        self._watch(self.backend)

    def _watch(self, backend: LoopBackend) -> None:
        self.poses.append(backend.poses)
        self.edges.append(backend.edges)

    def again(self) -> LoopBackend:
        """The back end as it was at the end of the walk, whatever was done with it."""
        self.backend.load(Edits())
        self._walk_on(min(self.backend.known, len(self.keyframes)))
        if not same(self.backend.edges, self.edges[-1]):  # a test went another way
            self.backend.go_to(0)
            self.backend.forget()
            self._walk_on(0)
        self.backend.take_notices()
        return self.backend

    def _walk_on(self, count: int) -> None:
        self.backend.go_to(count)
        for keyframe in self.keyframes[count:]:
            self.backend.add(keyframe, PARAMS)
        self.backend.finish()


@pytest.fixture(scope="session")
def walked() -> Iterator[Walked]:
    walked = Walked()
    yield walked
    walked.backend.close()


@pytest.fixture
def backend(walked: Walked) -> LoopBackend:
    """All keyframes of the walk, none changed."""
    return walked.again()
