"""Marks of the brush: the newest stroke counts, undo is a shorter list, and files hold them."""

import tracemalloc
import zlib
from base64 import b64encode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.mapping.painted import UNMARKED, Stroke, entry_of, marks, read_json, stroke_of, strokes_of, to_json, undone
from app.mapping.session_file import Opened, SavedSession, State, read_marks, write_session
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import GROUND, NON_GROUND

POINTS = 11


def stroke(stamp: int, first: int, last: int, mark: int) -> Stroke:
    touched = np.zeros(POINTS, np.bool_)
    touched[first:last] = True
    return Stroke.of(stamp, touched, mark)


strokes = st.lists(
    st.builds(stroke, st.integers(0, 2), st.integers(0, 8), st.integers(3, POINTS), st.sampled_from([0, 1, UNMARKED])),
    max_size=8,
)


@given(strokes)
def test_each_point_has_the_mark_of_the_last_stroke_that_touched_it(painted: list[Stroke]) -> None:
    found = marks(painted)
    for stamp in range(3):
        for point in range(POINTS):
            over = [one.mark for one in painted if one.stamp_ns == stamp and one.mask[point]]
            now = found[stamp][point] if stamp in found else UNMARKED
            assert now == (over[-1] if over else UNMARKED)


@given(strokes)
def test_a_file_brings_the_same_marks_back(painted: list[Stroke]) -> None:
    again = marks(read_json(to_json(painted), "walk.labels.json"))
    assert {stamp: labels.tolist() for stamp, labels in again.items()} == {
        stamp: labels.tolist() for stamp, labels in marks(painted).items()
    }
    assert strokes_of(again) == strokes_of(marks(painted))


@given(st.lists(st.booleans(), max_size=6))
def test_strokes_of_one_action_are_undone_together_also_after_a_file(joined: list[bool]) -> None:
    painted = tuple(replace(stroke(n, 0, 3, GROUND), joined=one) for n, one in enumerate(joined))
    again = tuple(stroke_of(entry_of(one)) for one in painted)
    assert again == painted
    left = undone(again)
    assert left == painted[: len(left)] and (len(left) < len(painted) or not painted)
    assert all(one.joined for one in painted[len(left) + 1 :]) and not (left and painted[len(left)].joined)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "[" * 100_000,
        '{"hemislam_labels": 2}',
        '{"hemislam_labels": 1, "strokes": [{}]}',
        '{"hemislam_labels": 1, "strokes": [{"points": Infinity, "touched": "", "stamp_ns": 1, "mark": "none"}]}',
    ],
)
def test_a_file_that_holds_no_labels_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(HemislamError, match=r"walk\.json holds no labels"):
        read_json(text, "walk.json")


def test_bits_that_do_not_fit_the_points_are_refused() -> None:
    text = to_json([stroke(5, 0, 3, GROUND)]).replace(f'"points": {POINTS}', '"points": 99')
    with pytest.raises(HemislamError, match="99 points"):
        read_json(text, "walk.json")


def test_marks_that_unpack_to_more_than_a_scan_are_refused_before_memory_is_full(tmp_path: Path) -> None:
    bomb = b64encode(zlib.compress(bytes(200_000_000))).decode()
    tracemalloc.start()
    with pytest.raises(ValueError, match="another number of bits"):
        stroke_of({"points": 99, "touched": bomb, "stamp_ns": 1, "mark": "none"})
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 10_000_000


def test_a_session_file_keeps_the_strokes_and_a_search_reads_their_marks(tmp_path: Path) -> None:
    recording, path = tmp_path / "walk.mcap", tmp_path / "walk.hemislam"
    recording.write_bytes(b"x")
    painted = (stroke(5, 0, 9, GROUND), stroke(5, 2, 4, NON_GROUND), stroke(7, 0, 2, GROUND))
    saved = SavedSession(Opened(recording, nbytes=1), State(Params(), painted=painted), 9)
    write_session(path, saved)
    (first, labels), (second, _) = read_marks(path)
    assert (first, second) == (5, 7)
    assert list(labels) == [1, 1, 0, 0, 1, 1, 1, 1, 1, UNMARKED, UNMARKED]
    write_session(path, replace(saved, state=State(Params())))
    with pytest.raises(HemislamError, match="no labelled points"):
        read_marks(path)


@pytest.mark.parametrize("name", ["", "gone.labels.json", "gone.hemislam", "bytes.labels.json"])
def test_labels_that_cannot_be_read_are_named_in_a_sentence(name: str, tmp_path: Path) -> None:
    (tmp_path / "bytes.labels.json").write_bytes(b"\xff\xfe")
    with pytest.raises(HemislamError) as refused:
        read_marks(tmp_path / name)
    assert str(tmp_path / name) in str(refused.value) and "Errno" not in str(refused.value)
    assert "codec" not in str(refused.value) and ";" in str(refused.value), "it says what to do"
