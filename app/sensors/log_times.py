"""Log times of a file that step back, or are far from those around them, as a bit that was turned makes them."""

from collections.abc import Iterator, Sequence
from itertools import chain, pairwise
from typing import Any

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


def of_messages(readers: Sequence[Any]) -> I64:
    """Log times of all messages of the bags and databases that rosbags has opened."""
    bags = chain.from_iterable(getattr(reader, "indexes", {}).values() for reader in readers)
    times = [np.array([entry.time for entry in index], np.int64) for index in bags]
    for storage in _storages(readers):
        if (database := getattr(storage, "dbconn", None)) is not None:
            rows = database.execute("SELECT CAST(timestamp AS INTEGER) FROM messages")
            times.append(np.fromiter(chain.from_iterable(rows), np.int64))
    return np.concatenate([np.empty(0, np.int64), *times])


def may_be_disordered(readers: Sequence[Any]) -> bool:
    """Whether chunks of an MCAP that rosbags has opened step back in time, last too long, or are few and far away;
    or whether there are none."""
    for chunks in (storage.chunks for storage in _storages(readers) if hasattr(storage, "chunks")):
        if not chunks or any(chunk.message_end_time - chunk.message_start_time > FAR_NS for chunk in chunks):
            return True
        for before, after in pairwise(sorted(chunks, key=lambda chunk: chunk.chunk_start_offset)):
            back_ns = before.message_end_time - after.message_start_time
            shared = before.message_index_offsets.keys() & after.message_index_offsets.keys()
            few = min(sum(chunk.channel_count.values()) for chunk in (before, after)) <= FEW
            if back_ns > (SET_BACK_NS if shared else FAR_NS) or (few and -back_ns > FAR_NS):
                return True
    return False


def _storages(readers: Sequence[Any]) -> Iterator[Any]:
    """Those of ROS 2."""
    for reader in readers:
        storage = getattr(reader, "storage", None)
        yield from getattr(storage, "storages", [storage])
