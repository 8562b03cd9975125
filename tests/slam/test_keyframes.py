"""Keyframes: when one is due, and that the store returns exactly the stored data."""

import errno
import io
import tempfile
import threading
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.errors import refusal
from app.slam.keyframes import KeyframeStore, is_due
from app.slam.loops.submap import Submaps
from app.slam.sections import KeyframeParams
from app.slam.types import Cloud, Keyframe


def keyframe(index: int, points: int = 100) -> Keyframe:
    rng = np.random.default_rng(index)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    cloud = Cloud(
        points=rng.normal(size=(points, 3)).astype(np.float32),
        labels=rng.integers(0, 3, points).astype(np.uint8),
        intensity=rng.uniform(0, 255, points).astype(np.float32),
        ring=rng.integers(0, 65535, points).astype(np.uint16),
        offsets_ns=rng.integers(0, 10**8, points).astype(np.int32),
    )
    stamp_ns = 1_700_000_000_123_456_789 + index
    return Keyframe(index, 7 * index, stamp_ns, T, np.linalg.inv(T), rng.normal(size=(6, 6)), cloud)


def assert_same(a: Keyframe, b: Keyframe) -> None:
    for part, other in ((a, b), (a.cloud, b.cloud)):
        for field in fields(part):
            mine, theirs = getattr(part, field.name), getattr(other, field.name)
            if isinstance(mine, np.ndarray):
                np.testing.assert_array_equal(mine, theirs)
                assert mine.dtype == theirs.dtype
                assert mine.flags.c_contiguous
            elif not isinstance(mine, Cloud):
                assert mine == theirs


@given(st.lists(st.integers(0, 300), max_size=8))
def test_what_was_stored_comes_back_to_the_bit(sizes: list[int]) -> None:
    store = KeyframeStore()
    kept = [keyframe(i, n) for i, n in enumerate(sizes)]
    for one in kept:
        store.append(one)
    assert len(store) == len(kept)
    for i in reversed(range(len(kept))):
        assert_same(store[i], kept[i])
    store.close()


def test_iterating_streams_all_of_them_in_order() -> None:
    store = KeyframeStore()
    for i in range(5):
        store.append(keyframe(i))
    assert [k.index for k in store] == [0, 1, 2, 3, 4]
    with pytest.raises(IndexError):
        store[5]


def test_truncated_and_filled_again_it_holds_the_new_ones() -> None:
    store = KeyframeStore()
    for i in range(6):
        store.append(keyframe(i, points=50 * (i + 1)))
    store.truncate(2)
    assert len(store) == 2
    replacement = Keyframe(2, *(getattr(keyframe(40, points=500), f.name) for f in fields(Keyframe)[1:]))
    store.append(replacement)
    assert_same(store[0], keyframe(0, 50))
    assert_same(store[1], keyframe(1, 100))
    assert_same(store[2], replacement)
    store.truncate(0)
    assert list(store) == []
    store.append(keyframe(0))
    assert_same(store[0], keyframe(0))


def test_reading_while_writing_gives_whole_keyframes() -> None:
    """A save in another thread reads while the engine appends."""
    store, wrong = KeyframeStore(), []
    store.append(keyframe(0))

    def read() -> None:
        for _ in range(200):
            i = len(store) - 1
            try:
                assert_same(store[i], keyframe(i))
            except AssertionError as error:
                wrong.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for i in range(1, 200):
        store.append(keyframe(i))
    reader.join()
    assert wrong == []


def test_clouds_are_not_kept_in_memory() -> None:
    store = KeyframeStore()
    for i in range(20):
        store.append(keyframe(i, points=20_000))
    held = sum(v.nbytes for v in vars(store).values() if isinstance(v, np.ndarray))
    held += sum(len(v) * v.itemsize for v in vars(store).values() if hasattr(v, "itemsize") and hasattr(v, "append"))
    assert held < 10_000
    assert not any(isinstance(v, list) and v for v in vars(store).values())


@pytest.mark.parametrize(
    ("metres", "degrees", "due"),
    [(0.49, 0, False), (0.51, 0, True), (0, 14, False), (0, 16, True), (0.3, 10, False), (0.51, 16, True)],
)
def test_a_keyframe_is_due_after_walking_or_turning_far_enough(metres: float, degrees: float, due: bool) -> None:
    last = keyframe(3)
    moved = np.eye(4)
    moved[:3, 3] = metres * np.array([0.6, 0.0, -0.8])
    moved[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix()
    assert is_due(last.T_odom_imu, last.T_odom_imu @ moved, KeyframeParams(distance=0.5, angle=15)) is due


def test_the_first_frame_is_a_keyframe() -> None:
    assert is_due(None, np.eye(4), KeyframeParams())


def test_after_going_back_the_later_ones_can_be_gone_forth_to_until_others_take_their_place() -> None:
    store = KeyframeStore()
    for i in range(6):
        store.append(keyframe(i))
    store.truncate(2)
    store.append(keyframe(2))
    store.truncate(6)
    for i in range(6):
        assert_same(store[i], keyframe(i))
    store.truncate(2)
    store.append(keyframe(2, points=99))
    with pytest.raises(IndexError):
        store.truncate(6)
    store.close()


class Full(io.BytesIO):
    """A file whose disk is full."""

    def write(self, content: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_folder_of_temporary_files_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda prefix: Full())
    for store in (KeyframeStore(), Submaps(0.1, 20.0, 60.0)):
        with pytest.raises(OSError, match="No space left") as caught:
            store.append(keyframe(0))
        assert f"({tempfile.gettempdir()}, for temporary files; TMPDIR chooses another folder)" in refusal(caught.value)
