"""Work on independent parts of an array, on several processors at once."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from app.slam.provenance import cores

_HELPERS = min(3, cores() - 1)
_pool = ThreadPoolExecutor(max(_HELPERS, 1), "part")


def in_parts(work: Callable[[int, int], None], n: int, size: int) -> None:
    """Call `work(begin, end)` for all parts of range(n), each at most `size` long, on several threads.

    No part may depend on another, so that the result does not depend on which thread takes which. `work` releases the
    interpreter's lock for most of its time. The caller takes parts too and waits only for those begun, so a busy
    processor does not hold it up.
    """
    begins = iter(range(0, n, size))

    def take() -> None:
        for begin in begins:
            work(begin, min(begin + size, n))

    helpers = [_pool.submit(take) for _ in range(_HELPERS)]
    take()
    for helper in helpers:
        if not helper.cancel():
            helper.result()
