"""The layer of moving points depends only on the keyframes, not on how they came about. Tests app/mapping/moving.py.

Three walls of points surround the sensor. In one keyframe only, a disc stands a metre in front of one of them.
"""

from dataclasses import replace

import numpy as np
import pytest

from app.mapping.labels import LabelledKeyframes
from app.mapping.moving import MovingPoints
from app.slam.moving import AROUND
from app.slam.sections import MovingParams
from app.slam.types import GROUND, MOVING, NON_GROUND, Cloud, Keyframe

COUNT = 2 * AROUND + 5
MET = (3, AROUND + 2, COUNT - 2)
"""Keyframes in which the disc stood."""


def keyframe(index: int, *, met: bool) -> Keyframe:
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(-3, 3, 80), np.linspace(-1, 1, 40)))
    wall = np.full(a.size, 4.0)
    if met:
        wall[np.hypot(a, b) < 0.6] = 3.0
    points = np.concatenate([np.column_stack(axes) for axes in ((a, b, wall), (np.full(a.size, 5.0), a, b + 2))])
    n = len(points)
    zeros = np.zeros(n, np.float32), np.zeros(n, np.uint16), np.zeros(n, np.int32)
    cloud = Cloud(points.astype(np.float32), np.full(n, NON_GROUND, np.uint8), *zeros)
    return Keyframe(index, index, index, np.eye(4), np.eye(4), np.eye(6), cloud)


KEYFRAMES = [keyframe(index, met=index in MET) for index in range(COUNT)]


def moving_in(keyframes: LabelledKeyframes) -> list[int]:
    """How many points of each keyframe are labelled."""
    return [int(np.count_nonzero(keyframes[index].cloud.labels == MOVING)) for index in range(len(keyframes))]


def settled(moving: MovingPoints, count: int, *, last: bool = True) -> list[tuple[int, bool]]:
    steps = []
    while (step := moving.next(count, last=last)) is not None:
        steps.append(step)
    return steps


def test_labels_follow_the_walk_by_so_many_keyframes_and_the_last_ones_at_its_end() -> None:
    moving = MovingPoints(KEYFRAMES, MovingParams())
    seen = LabelledKeyframes(KEYFRAMES, moving=moving)
    assert settled(moving, AROUND, last=False) == [] and not any(moving_in(seen))
    assert settled(moving, AROUND + 4, last=False) == [(0, False), (1, False), (2, False), (3, True)]
    steps = settled(moving, COUNT)
    assert [index for index, changed in steps if changed] == list(MET[1:])
    assert [index for index, count in enumerate(moving_in(seen)) if count] == list(MET)
    assert all((one.cloud.labels == NON_GROUND).all() for one in KEYFRAMES), "the keyframes themselves never change"


def test_every_way_to_a_frame_gives_the_same_labels() -> None:
    """At once, along the walk, and after going back from a later frame."""
    count = MET[1] + 2
    at_once = moving_in(LabelledKeyframes(KEYFRAMES, moving=MovingPoints(KEYFRAMES, MovingParams()), count=count))
    further = MovingPoints(KEYFRAMES, MovingParams())
    for so_far in range(COUNT + 1):
        settled(further, so_far, last=so_far % 3 == 0)
    assert moving_in(LabelledKeyframes(KEYFRAMES, moving=further, count=count)) == at_once
    whole = moving_in(LabelledKeyframes(KEYFRAMES, moving=further, count=COUNT))
    assert whole == moving_in(LabelledKeyframes(KEYFRAMES, moving=further)), "and going on again loses nothing"


def test_after_going_back_other_keyframes_have_labels_of_their_own() -> None:
    keyframes = list(KEYFRAMES)
    seen = LabelledKeyframes(keyframes, moving=(moving := MovingPoints(keyframes, MovingParams())))
    settled(moving, COUNT)
    keyframes[MET[1] :] = [keyframe(index, met=False) for index in range(MET[1], COUNT)]
    seen.forget_after(MET[1])
    settled(moving, COUNT)
    assert [index for index, count in enumerate(moving_in(seen)) if count] == [MET[0]]


def test_other_keyframes_after_a_change_of_parameters_do_not_get_the_old_labels() -> None:
    keyframes = list(KEYFRAMES)
    seen = LabelledKeyframes(keyframes, moving=(moving := MovingPoints(keyframes, MovingParams())))
    settled(moving, COUNT)
    moving.choose(MovingParams(seen_through=3))
    cloud = KEYFRAMES[0].cloud
    arrays = (getattr(cloud, name)[:7] for name in ("points", "labels", "intensity", "ring", "offsets_ns"))
    keyframes[MET[1] :] = [replace(KEYFRAMES[MET[1]], cloud=Cloud(*arrays))]
    seen.forget_after(MET[1])
    assert len(seen[MET[1]].cloud.labels) == 7 and moving_in(seen)[MET[1]] == 0


def test_the_switch_and_the_slider_label_the_whole_map_again() -> None:
    moving = MovingPoints(KEYFRAMES, MovingParams())
    seen = LabelledKeyframes(KEYFRAMES, moving=moving)
    settled(moving, COUNT)
    found = moving_in(seen)
    moving.choose(MovingParams(enabled=False))
    assert moving_in(seen) == found, "what is known stays until it is found anew"
    assert [index for index, changed in settled(moving, COUNT) if changed] == list(MET)
    assert not any(moving_in(seen))
    moving.choose(MovingParams())
    settled(moving, COUNT)
    assert moving_in(seen) == found


def test_an_export_under_way_keeps_the_parameters_that_it_began_with() -> None:
    moving = MovingPoints(KEYFRAMES, MovingParams())
    under_way = LabelledKeyframes(KEYFRAMES, moving=moving).now()
    moving.choose(MovingParams(enabled=False))
    assert [index for index, count in enumerate(moving_in(under_way)) if count] == list(MET)


@pytest.mark.parametrize("label", [NON_GROUND, GROUND])
def test_the_user_has_the_last_word_and_can_take_it_back(label: int) -> None:
    moving = MovingPoints(KEYFRAMES, MovingParams())
    seen = LabelledKeyframes(KEYFRAMES, moving=moving)
    settled(moving, COUNT)
    before = moving_in(seen)
    seen.edit(MET[0], label)
    assert (seen[MET[0]].cloud.labels == label).all()
    seen.undo()
    assert moving_in(seen) == before and before[MET[0]] > 0


def test_a_keyframe_without_points_is_no_trouble() -> None:
    cloud = KEYFRAMES[0].cloud
    arrays = (getattr(cloud, name)[:0] for name in ("points", "labels", "intensity", "ring", "offsets_ns"))
    keyframes = [replace(KEYFRAMES[0], cloud=Cloud(*arrays)), *KEYFRAMES[1:4]]
    moving = MovingPoints(keyframes, MovingParams())
    assert len(settled(moving, 4)) == 4 and settled(moving, 4) == []
