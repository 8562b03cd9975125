"""How processes take memory from the system that may run for hours: what is free is not hoarded."""

import contextlib
import ctypes
import sys
from typing import Final

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
"""Numbers of glibc's `mallopt`."""
LARGE: Final = 128 << 10
"""Bytes from which on an array has pages of its own, which go back to the system with it."""
LARGE_OF_MAP: Final = 16 << 10
"""The same where the map for pages is held: as it is thinned, smaller arrays of points take the place of others."""


def give_back(large: int = LARGE) -> None:
    """Have what is freed used again or given back, in this process, from now on; does nothing without glibc.

    By itself glibc gives each thread a heap of its own, and keeps on them also what is large once it has seen it
    freed. Arrays that grow with the walk, and are put in place of one another, then leave holes that none of the later
    ones fits in.

    Args:
        large: bytes from which on an array has pages of its own. Making these anew takes time.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(AttributeError, OSError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in ((_MMAP_THRESHOLD, large), (_TRIM_THRESHOLD, LARGE), (_ARENA_MAX, 2)):
            mallopt(option, value)


def tidy() -> None:
    """Give back the holes between what is held, too, which glibc keeps; a fraction of a millisecond, for now and then.

    Does nothing without glibc.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
