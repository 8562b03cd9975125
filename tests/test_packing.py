"""Values as bytes."""

import numpy as np
import pytest

from app.packing import LARGE, pack, unpack


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_with_their_numbers_and_type(order: str) -> None:
    small = np.asarray(np.arange(16.0).reshape(4, 4), order=order)  # type: ignore[call-overload]
    large = np.arange(LARGE, dtype=np.int32)
    got = unpack([bytes(part) for part in pack({"T": small, "rows": (large, "text")})])
    assert np.array_equal(got["T"], small) and got["T"].dtype == small.dtype
    assert np.array_equal(got["rows"][0], large) and got["rows"][0].dtype == large.dtype
    assert got["rows"][1] == "text"


def test_a_large_array_is_kept_beside_the_pickle_and_not_copied() -> None:
    sent = np.arange(LARGE // 8, dtype=np.int64)
    parts = pack((sent, np.arange(3)))
    assert len(parts) == 2 and np.shares_memory(np.frombuffer(parts[1], np.int64), sent)
