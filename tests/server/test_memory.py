"""What a process that runs for hours holds does not grow by more than it has to."""

import ctypes
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from test_chunks import chunk, walk

from app.memory import LARGE, LARGE_OF_MAP, give_back, tidy
from app.server import chunks, wire
from app.server.chunks import EMPTY_LEVEL
from app.server.delta import Fold, Outbox
from app.slam.params import Params

ON_PAGES = """
import ctypes, sys
import numpy as np
from app.memory import give_back
if sys.argv[1] != "as it is":
    give_back(int(sys.argv[1]))
fields = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
class Info(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in fields]
libc = ctypes.CDLL(None)
libc.mallinfo2.restype = Info
np.ones(20 << 20, np.uint8)  # freed at once: from now on glibc takes arrays up to this size from its heap
before = libc.mallinfo2().hblkhd
kept = [np.ones(20 << 10, np.uint8) for _ in range(500)], np.ones(1 << 20, np.uint8)
print(libc.mallinfo2().hblkhd - before)
"""


# Other C libraries have no mallinfo2, nor anything that `give_back` and `tidy` could ask for; CI has glibc.
of_glibc = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="of glibc")


@of_glibc
def test_a_large_array_has_pages_of_its_own_that_go_back_with_it() -> None:
    def on_pages(large: str) -> int:
        done = subprocess.run([sys.executable, "-c", ON_PAGES, large], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert 1 << 20 <= on_pages(str(LARGE)) < 2 << 20
    assert on_pages(str(LARGE_OF_MAP)) >= 9 << 20
    assert on_pages("as it is") == 0, "the test would see it"


HOLES = """
import re, sys
from pathlib import Path
from app.memory import tidy
def held():
    return int(re.search(r"RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) << 10
kept = [bytearray(20_000) for _ in range(2000)]
kept = kept[::20] + [kept[-1]]  # what is held lies between what was freed, at the end, too
before = held()
tidy()
print(before - held())
"""


@of_glibc
def test_holes_between_what_is_held_are_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 20_000_000, "of the 38 MB that were freed"


def test_elsewhere_than_with_glibc_nothing_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name: asked.append(name) or object())
    give_back()
    tidy()
    assert asked == ([None, None] if sys.platform == "linux" else [])


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_small_array_comes_through_a_pipe_as_one_that_holds_nothing_but_its_numbers(order: str) -> None:
    sent = np.asarray(np.arange(16.0).reshape(4, 4), order=order)  # type: ignore[call-overload]
    sent.setflags(write=False)
    got = wire.unpack(wire.pack({"T": sent}))["T"]
    assert np.array_equal(got, sent) and got.dtype == sent.dtype
    assert got.base is None


def test_a_large_array_travels_beside_the_rest_and_is_not_copied() -> None:
    sent = np.arange(wire.LARGE // 8, dtype=np.int64)
    parts = wire.pack((sent, np.arange(3)))
    assert len(parts) == 2 and np.shares_memory(np.frombuffer(parts[1], np.int64), sent)


@pytest.fixture
def few_shown(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(chunks, "MOST_SHOWN", 20)
    yield 20


def test_keyframes_that_hold_no_points_any_more_hold_no_arrays_of_their_own(few_shown: int) -> None:
    outbox, fold, poses = Outbox(Params()), Fold(point_budget=10**9), walk(60)
    outbox.begin()
    for index in range(60):
        outbox.chunk(chunk(index, 50))
        outbox.put(keyframe_poses=poses[: index + 1])
        fold.apply(wire.unpack(wire.pack(outbox.take())))
    shown = fold.snapshot.chunks
    empty = [one for one in shown if one.level == EMPTY_LEVEL]
    assert len(shown) == 60 and len(empty) == 60 - few_shown
    for name in ("points", "labels", "intensity", "ring", "T_imu_lidar"):
        assert len({id(getattr(one, name)) for one in empty}) == 1
    assert all(np.array_equal(one.T_imu_lidar, np.eye(4)) for one in shown)
    assert [one.frame for one in empty] == [5 * one.index for one in empty]
