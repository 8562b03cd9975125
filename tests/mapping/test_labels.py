"""Labels may change later; the keyframes themselves never change."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.export.map_file import write
from app.export.points import Choice, blocks
from app.mapping.labels import LabelEdit, LabelledKeyframes
from app.mapping.moving import MovingPoints
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.map_frame import MapFrame
from app.slam.sections import MovingParams
from app.slam.types import GROUND, NON_GROUND, Cloud, Keyframe

POINTS = 4


def keyframe(index: int) -> Keyframe:
    numbers = np.zeros(POINTS, np.float32)
    cloud = Cloud(
        np.zeros((POINTS, 3), np.float32),
        np.full(POINTS, NON_GROUND, np.uint8),
        numbers,
        np.zeros(POINTS, np.uint16),
        np.zeros(POINTS, np.int32),
    )
    return Keyframe(index, 5 * index, index, np.eye(4), np.eye(4), np.eye(6), cloud)


KEYFRAMES = [keyframe(index) for index in range(3)]
ALL_GROUND = np.full(POINTS, GROUND, np.uint8)


def labelled(keyframes: list[Keyframe], edits: tuple[LabelEdit, ...] = ()) -> LabelledKeyframes:
    """Keyframes in which nothing moves."""
    return LabelledKeyframes(keyframes, MovingPoints(keyframes, MovingParams(enabled=False)), edits)


@given(st.lists(st.one_of(st.none(), st.tuples(st.integers(0, 2), st.integers(0, 2))), max_size=12))
def test_the_newest_edit_counts_and_undo_brings_the_one_before_back(steps: list[tuple[int, int] | None]) -> None:
    """A step is an edit (keyframe, label) or an undo (None)."""
    seen = labelled(KEYFRAMES)
    edits: list[tuple[int, int]] = []
    for step in steps:
        if step is not None:
            seen.edit(*step)
            edits.append(step)
        elif edits:
            assert seen.undo() == edits.pop()[0]
        else:
            with pytest.raises(HemislamError, match="no edit of labels"):
                seen.undo()
    expected = dict.fromkeys(range(3), NON_GROUND) | dict(edits)
    assert {index: int(seen[index].cloud.labels[0]) for index in range(len(seen))} == expected
    assert all((one.cloud.labels == NON_GROUND).all() for one in KEYFRAMES)


def test_an_export_under_way_does_not_see_later_keyframes() -> None:
    keyframes = KEYFRAMES[:2]
    seen = labelled(keyframes, (LabelEdit.of(KEYFRAMES[1], ALL_GROUND),)).now()
    keyframes.append(KEYFRAMES[2])
    assert len(seen) == 2 and (seen[0].cloud.labels == NON_GROUND).all()
    with pytest.raises(IndexError):
        seen[2]


def test_labels_for_another_number_of_points_are_refused() -> None:
    with pytest.raises(HemislamError, match="Keyframe 0 has 4 points; 3 labels do not fit"):
        labelled(KEYFRAMES).edit(0, ALL_GROUND[:3])
    with pytest.raises(HemislamError, match="no keyframe 3 to label; there are 3"):
        labelled(KEYFRAMES).edit(3, GROUND)


def test_labels_that_fit_no_more_are_left_out() -> None:
    """Another version of the engine may keep other points of the same scan than the session's file was made with."""
    others = LabelEdit(KeyframeId(0, 1), bytes([GROUND] * (POINTS + 1)))
    assert (labelled(KEYFRAMES, (others,))[1].cloud.labels == NON_GROUND).all()


def test_labels_are_kept_as_they_were_given() -> None:
    labels = ALL_GROUND.copy()
    edit = LabelEdit.of(KEYFRAMES[0], labels)
    labels[:] = NON_GROUND
    assert edit.labels == bytes([GROUND] * POINTS)


def test_the_map_is_written_with_edited_labels(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    seen = labelled(KEYFRAMES, (LabelEdit.of(KEYFRAMES[1], ALL_GROUND),))
    write(path, blocks(seen, MapFrame(), Choice()))
    edited = path.read_bytes()
    relabelled = [replace(one, cloud=replace(one.cloud, labels=ALL_GROUND)) for one in KEYFRAMES[1:2]]
    write(path, blocks([KEYFRAMES[0], *relabelled, KEYFRAMES[2]], MapFrame(), Choice()))
    assert edited == path.read_bytes()
