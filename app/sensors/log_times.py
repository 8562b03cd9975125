"""Log times of a file that step back, or are far from those around them, as after a flipped bit."""

import numpy as np

from app.slam.types import I64

FAR_NS = 10_000_000_000
"""If a few messages were logged this long before or after all others, their log times are wrong."""
WILD_NS = 2_000_000_000
"""If a message was logged this long before or after its neighbours in the file, its log time is wrong."""
FEW = 20
"""This many messages, a tenth of a second of a walk, are too few to be a separate part of a recording."""
SET_BACK_NS = 500_000_000
"""If log times on one topic step back by more, the recorder's clock was set."""
LATEST_NS = 2**62
"""The year 2116; later times are left out or cut to it, so that integers hold their differences."""
_REACH = 10
"""A log time is compared with this many before it and as many after it."""


def sound_span(times: I64) -> tuple[int, int, int]:
    """The span of (n,) log times in any order, without a few at either end that are far from all others: the first, the
    end after the last, and the number left out."""
    times = np.sort(np.clip(times, 0, LATEST_NS))
    begins = np.array([0, *np.flatnonzero(np.diff(times) > FAR_NS) + 1, len(times)])
    parts = np.flatnonzero(np.diff(begins) > FEW)
    first, stop = (begins[parts[0]], begins[parts[-1] + 1]) if len(parts) else (0, len(times))
    return int(times[first]), int(times[stop - 1]) + 1, len(times) - int(stop - first)


def overlap(times: I64) -> tuple[int, int] | None:
    """The span that (n,) log times in file order cover twice, since the clock was set back; None if it was not."""
    for at in (np.flatnonzero(np.diff(times) < -SET_BACK_NS) + 1).tolist():
        before, after = np.median(times[max(at - 5, 0) : at]), np.median(times[at : at + 5])  # a few may be wrong
        if min(at, len(times) - at) > FEW and times[0] < after < before - SET_BACK_NS:
            return int(times[at]), int(times[at - 1])
    return None


def mended(times: I64) -> dict[int, int]:
    """Better values, by index, for those of (n,) log times in file order that are far from their neighbours."""
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
