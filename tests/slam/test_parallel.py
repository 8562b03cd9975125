"""Several threads process parts of an array, each part once.

Tests app/slam/parallel.py.
"""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.slam import parallel
from app.slam.parallel import in_parts


@given(n=st.integers(0, 200), size=st.integers(1, 50))
def test_every_part_is_worked_on_once(n: int, size: int) -> None:
    done: list[int] = []
    in_parts(lambda begin, end: done.extend(range(begin, end)), n, size)
    assert sorted(done) == list(range(n))


def test_two_parts_run_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_HELPERS", 1)  # also on a machine with one processor
    meeting, came = threading.Barrier(2, timeout=60.0), set[int]()

    def work(begin: int, end: int) -> None:
        meeting.wait()  # fails unless another part is at work
        came.add(threading.get_ident())

    in_parts(work, 2, 1)
    assert len(came) == 2


def test_threads_that_are_busy_hold_nobody_up() -> None:
    released, done = threading.Event(), []
    blocked = [parallel._pool.submit(released.wait, 60.0) for _ in range(parallel._HELPERS)]
    try:
        in_parts(lambda begin, end: done.append(begin), 5, 1)
        assert done == [0, 1, 2, 3, 4]
        assert not any(thread.done() for thread in blocked), "the parts did not wait for these"
    finally:
        released.set()


@pytest.mark.parametrize("part", range(4))
def test_a_failure_in_any_part_reaches_the_caller(part: int) -> None:
    def work(begin: int, end: int) -> None:
        if begin == part:
            raise ArithmeticError(f"part {begin}")

    with pytest.raises(ArithmeticError, match=f"part {part}"):
        in_parts(work, 4, 1)
