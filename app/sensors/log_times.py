"""Log times of a file that step back, or are far from those around them, as a bit that was turned makes them."""

import numpy as np

from app.slam.types import I64

FAR_NS = 10_000_000_000
"""Few messages that were logged this long before or after all others have wrong log times."""
WILD_NS = 2_000_000_000
"""So has a message that was logged this long before or after its neighbours in the file."""
FEW = 20
"""So many messages, a tenth of a second of a walk, are no part of a recording of their own."""
SET_BACK_NS = 500_000_000
"""Log times on one topic that step back by more do so because the recorder's clock was set."""
LATEST_NS = 2**62
"""The year 2116; later log times are cut to it, so that integers hold their differences."""
_REACH = 10
"""A log time is compared with this many before it and after it."""


def sound_span(times: I64) -> tuple[int, int, int]:
    """Of (n,) log times in any order, without a few at the ends that are far from all others: the first, the end after
    the last, and how many these few are."""
    times = np.sort(np.clip(times, 0, LATEST_NS))
    begins = np.array([0, *np.flatnonzero(np.diff(times) > FAR_NS) + 1, len(times)])
    parts = np.flatnonzero(np.diff(begins) > FEW)
    first, stop = (begins[parts[0]], begins[parts[-1] + 1]) if len(parts) else (0, len(times))
    return int(times[first]), int(times[stop - 1]) + 1, len(times) - int(stop - first)


def mended(times: I64) -> dict[int, int]:
    """Better ones for those of (n,) log times in the order of a file that are far from their neighbours; by number."""
    if len(times) <= 2 * _REACH:
        return {}
    padded = np.pad(times, _REACH, mode="reflect")
    steps = np.flatnonzero(np.abs(np.diff(times)) > WILD_NS)
    near = np.unique(np.clip(steps[:, None] + np.arange(-_REACH, _REACH + 2), 0, len(times) - 1))
    around = padded[near[:, None] + np.arange(2 * _REACH + 1)]
    middle = np.median(around, axis=1)
    usual = np.median(np.abs(around - middle[:, None]), axis=1)
    wild = np.abs(times[near] - middle) > np.maximum(WILD_NS, 10 * usual)
    better: dict[int, int] = {}
    for number, instead in zip(near[wild].tolist(), middle[wild].tolist(), strict=True):
        better[number] = better.get(number - 1, int(times[number - 1])) if number else int(instead)
    return better
