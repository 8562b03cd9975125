"""Label edits by the user: on the page, in the session's state, and undone.

Tests app/server/controller.py and app/server/publisher.py.
"""

import zlib
from base64 import b64encode
from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from session_bench import Bench, last_notice

from app.mapping.painted import Stroke
from app.mapping.session_file import State
from app.server.keeping import Paint, UndoPaint
from app.server.protocol import EditLabels, Restart, Seek, SetParams, UndoLabels
from app.slam import moving
from app.slam.types import GROUND, MOVING, NON_GROUND


def test_changed_labels_are_shown_and_taken_back() -> None:
    bench = Bench()
    before = bench.do(Seek(20)).chunks
    frames = len(bench.fold.snapshot.series["speed"])
    after = bench.do(EditLabels(1, GROUND), EditLabels(3, NON_GROUND)).chunks
    assert (after[1].labels == GROUND).all() and (after[3].labels == NON_GROUND).all()
    assert [one is other for one, other in zip(before, after, strict=True)] == [True, False, True, False, True]
    assert np.array_equal(after[1].points, before[1].points) and len(bench.see().series["speed"]) == frames
    undone = bench.do(UndoLabels(), UndoLabels(), UndoLabels())
    assert all(np.array_equal(one.labels, other.labels) for one, other in zip(before, undone.chunks, strict=True))
    assert "no edit of labels to undo" in last_notice(undone)


def test_what_moves_is_shown_once_it_is_found_and_no_more_when_that_is_switched_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(moving, "find", lambda keyframe, *_: np.arange(len(keyframe.cloud)) >= 0)
    bench = Bench()
    found = bench.do(Seek(20)).chunks
    assert len(found) == 5 and all((chunk.labels == MOVING).all() for chunk in found)
    edited = bench.do(EditLabels(1, GROUND)).chunks
    assert (edited[1].labels == GROUND).all(), "the user has the last word"
    off = bench.do(SetParams({"moving.enabled": False})).chunks
    assert [(chunk.labels == MOVING).any() for chunk in off] == [False] * 5 and (off[1].labels == GROUND).all()


def test_labels_that_do_not_fit_are_refused() -> None:
    bench = Bench()
    bench.do(Seek(20))
    assert "2 labels do not fit" in last_notice(bench.do(EditLabels(1, (GROUND, GROUND))))
    assert "no keyframe 500" in last_notice(bench.do(EditLabels(500, GROUND)))
    assert not bench.sessions[-1].keyframes.edits


def test_a_keyframe_that_is_made_again_has_its_own_labels() -> None:
    bench = Bench()
    bench.do(Seek(40))
    bench.do(EditLabels(6, GROUND), Seek(10), SetParams({"ground.sigma": 0.2}))
    assert not (bench.do(Seek(40)).chunks[6].labels == GROUND).all()


def test_a_state_with_label_edits_is_written_and_read() -> None:
    bench = Bench()
    bench.do(Seek(20))
    bench.do(EditLabels(1, GROUND), EditLabels(2, NON_GROUND))
    session, adapter = bench.sessions[-1], TypeAdapter(State)
    state = State(session.params, labels=session.keyframes.edits)
    assert adapter.validate_json(adapter.dump_json(state)) == state
    assert len(state.labels) == 2


def test_labels_that_unpack_to_a_gigabyte_are_refused_before_they_do() -> None:
    packing = zlib.compressobj()
    packed = b"".join(packing.compress(bytes(1 << 20)) for _ in range(32)) + packing.flush()
    entry = (0, 1, b64encode(packed).decode())
    with pytest.raises(ValidationError, match="more than 16,777,216 labels"):
        TypeAdapter(State).validate_python({"params": {}, "labels": (entry,)})


def test_marks_of_the_brush_are_kept_undone_and_survive_a_restart() -> None:
    bench = Bench()
    bench.do(Seek(20))
    first, second = (Stroke.of(5, np.arange(4) < count, GROUND) for count in (1, 3))
    assert bench.do(Paint(first), Paint(second)).painted == (first, second)
    assert bench.do(UndoPaint()).painted == (first,)
    assert bench.do(Restart()).painted == (first,)
    assert bench.do(UndoPaint(), UndoPaint()).painted == ()
    whole = (first, replace(second, joined=True))
    assert bench.do(Paint(second), *map(Paint, whole), Restart()).painted == (second, *whole)
    assert bench.do(UndoPaint()).painted == (second,), "one action takes back what one action did"
