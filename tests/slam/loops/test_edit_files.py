"""Loop edits as a file."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edit_files import read, write
from app.slam.loops.edits import Accept, Add, LoopEdit, Override, Reject, SetWeight, Solve, rows


@st.composite
def _edits(draw: st.DrawFn) -> LoopEdit:
    older = draw(st.integers(0, 10_000))
    newer = draw(st.integers(older + 1, 20_000))
    weight = draw(st.floats(1e-9, 1e9))
    guess = np.eye(4)
    turn = draw(st.tuples(*(st.floats(-3, 3) for _ in range(3))))
    guess[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    guess[:3, 3] = draw(st.tuples(*(st.floats(-1e4, 1e4) for _ in range(3))))
    register = draw(st.booleans())
    return draw(
        st.sampled_from(
            (
                Accept(KeyframeId(draw(st.integers(0, 3)), older), KeyframeId(3, newer)),
                Reject(older, newer),
                SetWeight(older, newer, weight),
                Add(older, newer, None, register),
                Add(older, newer, rows(guess), register),
                Solve(),
                Override(f"fix {older}", register),
            )
        )
    )


@settings(deadline=None)
@given(st.lists(_edits(), max_size=6))
def test_what_is_written_is_read_again_to_the_last_digit(edits: list[LoopEdit]) -> None:
    again = read(write(edits))
    assert again == tuple(edits)


def test_a_list_written_by_hand_is_understood() -> None:
    text = (
        "- accept: [12, 340]\n- reject: [3, 1/40]\n- {weigh: [12, 340], weight: 2}\n- add: [5, 300]\n- solve: at once\n"
    )
    other = KeyframeId(1, 40)
    assert read(text) == (Accept(12, 340), Reject(3, other), SetWeight(12, 340, 2.0), Add(5, 300), Solve())


def test_a_file_of_an_older_version_that_says_when_edits_were_made_is_read() -> None:
    assert read("- {accept: [12, 340], since: 7}\n") == (Accept(12, 340),)


def test_an_empty_file_has_no_edits() -> None:
    assert read("") == read("# nothing yet\n") == read(write([])) == ()


@pytest.mark.parametrize(
    ("entry", "what"),
    [
        ("acept: [1, 2]", "accept, reject, weigh or add"),
        ("{accept: [1, 2], reject: [1, 2]}", "accept, reject, weigh or add"),
        ("accept: [2, 1]", "older one first"),
        ("accept: [-1, 1]", "older one first"),
        ("accept: [1/3, 3]", "older one first"),
        ("accept: [x/1, 3]", "two keyframes"),
        ("accept: [1, 2, 3]", "two keyframes"),
        ("accept: [1.5, 2]", "two keyframes"),
        ("{accept: [1, 2], weight: 3}", "accept has no weight"),
        ("weigh: [1, 2]", "weight is None"),
        ("{weigh: [1, 2], weight: 0}", "greater than 0"),
        ("{weigh: [1, 2], weight: .nan}", "greater than 0"),
        ("{add: [1, 2], register: perhaps}", "true or false"),
        ("{add: [1, 2], guess: [[1, 0], [0, 1]]}", "4x4"),
        ("{add: [1, 2], guess: [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}", "rigid 4x4 transform"),
        ("solve: twice", "at once"),
        ("{solve: at once, accept: [1, 2]}", "solve: at once"),
        ("12", "accept, reject, weigh or add"),
    ],
)
def test_an_entry_that_cannot_be_used_is_named(entry: str, what: str) -> None:
    with pytest.raises(HemislamError) as caught:
        read(f"- accept: [1, 2]\n- {entry}\n", "edits.yaml")
    assert str(caught.value).startswith("edits.yaml, entry 2: ") and what in str(caught.value)


@pytest.mark.parametrize("text", ["a: [1", "accept: [1, 2]", "12"])
def test_anything_but_a_list_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(HemislamError, match=r"edits\.yaml.*- accept: \[12, 340\]"):
        read(text, "edits.yaml")
