"""A reader that follows a log with its cursor ends with exactly the rows of the log."""

from hypothesis import given
from hypothesis import strategies as st

from app.slam.log import Cursor, Log

APPEND, TRUNCATE, SYNC = "append", "truncate", "sync"
STEPS = st.lists(
    st.tuples(st.sampled_from([APPEND, TRUNCATE, SYNC]), st.lists(st.integers(), max_size=5), st.integers(0, 20)),
    max_size=40,
)


class Reader:
    def __init__(self) -> None:
        self.rows: list[int] = []
        self.cursor = Cursor()
        self.received = 0

    def sync(self, log: Log[int]) -> None:
        change = log.since(self.cursor)
        self.rows[change.keep :] = change.rows
        self.cursor = change.cursor
        self.received += len(change.rows)


@given(STEPS)
def test_a_reader_that_syncs_at_random_moments_ends_with_equal_rows(steps: list[tuple[str, list[int], int]]) -> None:
    log, lazy, attentive = Log[int](), Reader(), Reader()
    expected: list[int] = []
    for what, rows, length in steps:
        if what == APPEND:
            log.extend(rows)
            expected += rows
        elif what == TRUNCATE:
            log.truncate(length)
            del expected[length:]
        else:
            lazy.sync(log)
            assert lazy.rows == expected
        attentive.sync(log)
    lazy.sync(log)
    assert list(log) == expected == lazy.rows == attentive.rows
    assert lazy.received <= attentive.received, "a reader that waits longer is sent no more"


def test_rows_that_stay_are_not_sent_again() -> None:
    log = Log(range(100))
    reader = Reader()
    reader.sync(log)
    log.truncate(80)
    log.extend(range(5))
    assert log.since(reader.cursor)[:2] == (80, (0, 1, 2, 3, 4))
    reader.sync(log)
    assert log.since(reader.cursor)[:2] == (85, ())


def test_rows_that_were_replaced_are_sent_even_if_the_length_is_the_same() -> None:
    log = Log([1, 2, 3])
    cursor = log.cursor
    log.truncate(1)
    log.extend([4, 5])
    assert log.since(cursor)[:2] == (1, (4, 5))


def test_a_truncation_that_removes_nothing_makes_no_new_version() -> None:
    log = Log([1, 2])
    cursor = log.cursor
    log.truncate(2)
    log.truncate(7)
    assert log.cursor == cursor
    empty = Log[int]()
    empty.truncate(-1)
    assert empty.cursor == Cursor()


def test_a_reader_of_a_longer_log_of_another_process_keeps_what_this_one_has() -> None:
    assert Log("abc").since(Cursor(0, 5))[:2] == (3, ())
