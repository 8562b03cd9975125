"""A loop's numbers and words as one piece of bytes: the upper rows of its pose, the upper triangle of its covariance,
then other numbers, counts, choices and text."""

import struct
from collections.abc import Sequence
from typing import Final

import numpy as np

from app.slam.types import F64

NUMBERS: Final = 10
COUNTS: Final = 6
CHOICES: Final = 3

_LAST_ROW: Final = np.eye(4)[3].tobytes()
_UPPER: Final = np.triu_indices(6)
_ENTRY: Final = np.empty((6, 6), np.intp)
"""Where in the triangle an entry is."""
_ENTRY[_UPPER] = _ENTRY.T[_UPPER] = np.arange(21)

_NUMBERS: Final = struct.Struct(f"={NUMBERS}d")
_COUNTS: Final = struct.Struct(f"={COUNTS}i")
_TWO: Final = struct.Struct("=2i")
_NUMBERS_AT: Final = 8 * (12 + 21)
_COUNTS_AT: Final = _NUMBERS_AT + _NUMBERS.size
_CHOICES_AT: Final = _COUNTS_AT + _COUNTS.size
_TWO_AT: Final = _CHOICES_AT - _TWO.size
_TEXT_AT: Final = _CHOICES_AT + CHOICES


def pack(
    T: F64, covariance: F64, numbers: Sequence[float], counts: Sequence[int], choices: Sequence[int], text: str
) -> bytes:
    """As bytes, from which everything comes back to the last bit.

    Args:
        T: (4, 4), rigid. covariance: (6, 6), symmetric. choices: 0 to 255 each.
    """
    return b"".join(
        (
            np.asarray(T, np.float64)[:3].tobytes(),
            np.asarray(covariance, np.float64)[_UPPER].tobytes(),
            _NUMBERS.pack(*numbers),
            _COUNTS.pack(*counts),
            bytes(choices),
            text.encode(),
        )
    )


def pose(packed: bytes) -> F64:
    """(4, 4), read-only."""
    return np.frombuffer(packed[: 8 * 12] + _LAST_ROW, np.float64).reshape(4, 4)


def covariance(packed: bytes) -> F64:
    """(6, 6), read-only."""
    whole = np.frombuffer(packed, np.float64, 21, 8 * 12)[_ENTRY]
    whole.setflags(write=False)
    return whole


def numbers(packed: bytes) -> tuple[float, ...]:
    return _NUMBERS.unpack_from(packed, _NUMBERS_AT)


def counts(packed: bytes) -> tuple[int, ...]:
    return _COUNTS.unpack_from(packed, _COUNTS_AT)


def first_counts(packed: bytes) -> tuple[int, int]:
    """The first two of them, which is asked most often."""
    return _TWO.unpack_from(packed, _COUNTS_AT)


def last_counts(packed: bytes) -> tuple[int, int]:
    return _TWO.unpack_from(packed, _TWO_AT)


def choice(packed: bytes, index: int) -> int:
    return packed[_CHOICES_AT + index]


def text(packed: bytes) -> str:
    return packed[_TEXT_AT:].decode()
