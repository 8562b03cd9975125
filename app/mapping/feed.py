"""Where measurements come from. A session knows nothing else of its source."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from app.sensors.findings import Finding
from app.sensors.live.status import LiveState, Status
from app.sensors.recording import Measurements, Place, open_recording
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement


@dataclass(frozen=True, slots=True)
class Quiet:
    """There is no scan at the moment. status: what the source reports instead, if anything."""

    status: Status | None = None


@dataclass(frozen=True, slots=True)
class FeedInfo:
    """What is known about a source besides its measurements.

    Attributes:
        path: of the recording, or a name for a live source. start_ns: time of the first point; 0: unknown.
        duration_s: of the whole recording. frames: scans expected in the part that is processed. Both are None if the
            source has no end yet.
        start_s, part_s: start and length of the part that is processed (None: to the end).
        findings: what is unusual about the source. fixes: whether it holds satellite fixes.
    """

    path: Path
    start_ns: int = 0
    duration_s: float | None = None
    frames: int | None = None
    start_s: float = 0.0
    part_s: float | None = None
    findings: tuple[Finding, ...] = field(default=())
    fixes: bool = False

    @property
    def end_s(self) -> float | None:
        """Of the part that is processed, s after `start_ns`; None if the source has no end yet."""
        if self.duration_s is None or self.part_s is None:
            return self.duration_s
        return min(self.start_s + self.part_s, self.duration_s)


class Feed(Protocol):
    """A source of measurements in order of time. Subclass it: only `info` and `next` are required.

    Attributes:
        repeatable: whether `go_to`, or another feed of the same source, gives the same measurements again. Only then
            can a session go back, or be repeated from its file.
    """

    repeatable: bool = False

    @property
    def info(self) -> FeedInfo: ...

    def next(self) -> Measurement | DroppedScan | Quiet | None:
        """The next measurement, a scan that cannot be used, or `Quiet`; None at the end.

        Raises:
            HemislamError: the source is damaged here, or has gone; it cannot be read any further.
        """
        ...

    def place(self) -> Any:
        """Where the feed is between two measurements: a value that can be pickled."""
        return None

    def go_to(self, place: Any) -> None:
        """Continue from a place, exactly as the feed did when it was there."""
        return

    def live_state(self) -> LiveState | None:
        """The state of a live source; None for others. Raises HemislamError: it has ended."""
        return None

    def close(self) -> None:
        """Release all resources."""
        return


AHEAD = 4
"""Number of measurements that are read ahead. Each takes a few MB."""


class _Ahead(Iterator[Measurement | DroppedScan | None]):
    """The same entries, then None, read ahead by a thread."""

    def __init__(self, entries: Iterator[Measurement | DroppedScan]) -> None:
        self._entries = entries
        self._reader = ThreadPoolExecutor(1, "read")
        self._coming = deque(self._reader.submit(next, entries, None) for _ in range(AHEAD))

    def __next__(self) -> Measurement | DroppedScan | None:
        self._coming.append(self._reader.submit(next, self._entries, None))
        return self._coming.popleft().result()

    def close(self) -> None:
        self._reader.shutdown(cancel_futures=True)


class FileFeed(Feed):
    """A recording, or a part of it. Raises HemislamError: it cannot be used.

    Args:
        read_ahead: a thread reads the next measurements while frames are processed. Such a feed cannot go back.
    """

    repeatable = True

    def __init__(
        self,
        path: Path,
        params: Params,
        start_s: float = 0.0,
        duration_s: float | None = None,
        *,
        read_ahead: bool = False,
    ) -> None:
        self._recording = recording = open_recording(path, params)
        rest = max(0.0, recording.duration_s - start_s)
        share = (rest if duration_s is None else min(rest, duration_s)) / max(recording.duration_s, 1e-9)
        self._info = FeedInfo(
            path=recording.path,
            start_ns=recording.start_ns,
            duration_s=recording.duration_s,
            frames=round(recording.scan_count * share),
            start_s=start_s,
            part_s=duration_s,
            findings=recording.findings,
            fixes=bool(recording.gnss_topic),
        )
        self._measurements = self._read(None)
        self._ahead = _Ahead(self._measurements) if read_ahead else None

    @property
    def info(self) -> FeedInfo:
        return self._info

    def next(self) -> Measurement | DroppedScan | None:
        return next(self._ahead or self._measurements, None)

    def place(self) -> Place:
        return self._measurements.place()

    def go_to(self, place: Place) -> None:
        self._measurements = self._read(place)

    def close(self) -> None:
        if self._ahead:
            self._ahead.close()
        self._recording.close()

    def _read(self, after: Place | None) -> Measurements:
        return self._recording.measurements(self._info.start_s, self._info.part_s, after=after)
