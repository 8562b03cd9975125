"""Growing arrays do not change arrays that were handed out."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.slam.rows import Rows


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 600)), max_size=8))
def test_views_stay_as_they_are_when_rows_are_added_or_truncated(steps: list[tuple[int, int]]) -> None:
    rows, expected, seen = Rows((2,), np.float64), np.empty((0, 2)), []
    for number, (length, added) in enumerate(steps):
        rows.truncate(length)
        rows.extend(np.full((added, 2), float(number)))
        expected = np.concatenate((expected[:length], np.full((added, 2), float(number))))
        seen.append((rows.view(), expected))
    for view, then in seen:
        np.testing.assert_array_equal(view, then)
        assert not view.flags.writeable
