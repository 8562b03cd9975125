"""Rows that grow: what is handed out stays as it is, and what is large is not in memory."""

import errno
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.slam.rows import ON_DISK, Rows, table


def _anonymous_mb() -> float:
    """What this process has written and no file holds."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1e3


@given(st.lists(st.integers(1, 5000), min_size=1, max_size=8))
def test_what_was_handed_out_stays_as_it_is_while_rows_are_added(lengths: list[int]) -> None:
    numbers = np.random.default_rng(0).random((sum(lengths), 5))
    grown, seen = table(5), []
    for end, length in zip(np.cumsum(lengths), lengths, strict=True):
        grown.extend(numbers[end - length : end])
        seen.append(grown.view())
    for view in seen:
        np.testing.assert_array_equal(view, numbers[: len(view)])
        assert not view.flags.writeable


# Elsewhere rows stay in memory, so there is nothing to hold them to; CI is Linux.
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere rows are kept in memory")
def test_large_rows_take_no_memory_of_their_own() -> None:
    before = _anonymous_mb()
    grown = Rows((4, 4), np.float64)
    for _ in range(100):
        grown.extend(np.ones((2500, 4, 4)))
    assert grown.view().nbytes == 32_000_000
    assert grown.view().sum() == 4_000_000
    assert _anonymous_mb() - before < 4


def test_without_a_disk_for_them_rows_are_kept_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    grown = Rows((), np.int64, np.arange(ON_DISK))
    np.testing.assert_array_equal(grown.view(), np.arange(ON_DISK))


def test_columns_of_large_rows_are_contiguous() -> None:
    numbers = np.random.default_rng(1).random((20_000, 3))
    grown = table(3)
    grown.extend(numbers)
    assert grown.view().nbytes > ON_DISK
    column = grown.view()[:, 1]
    assert column.flags.c_contiguous
    np.testing.assert_array_equal(column, numbers[:, 1])
