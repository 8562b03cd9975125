"""Diagnostics: strips of measurements at every frame of the recording, shown above the transport.

Frames are thinned to columns in which spikes stay visible.
"""

import base64
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from app.server.protocol import Seek, Snapshot
from app.slam.errors import HemislamError
from app.slam.loops.types import Pair, Verdict
from app.slam.types import F64, I64
from app.ui.html import panel
from app.ui.widgets import Changes, Page, add_command

_PERIOD_S: Final = 0.5
COLUMNS: Final = 480
"""Any recording is thinned to at most this many columns."""
OPEN_CM, OPEN = 1e3, "> 10 m"
"""A direction more uncertain than this counts as unconstrained; the exact value would mean nothing."""
DEGENERATE_CM: Final = 10.0
"""A direction more uncertain than this is called degenerate (`app.slam.iekf.DEGENERATE_SIGMA`)."""
_NOTES: Final = 50
_NOTE_LETTERS: Final = 120

Series = dict[str, F64]


@dataclass(frozen=True, slots=True)
class Strip:
    """One row of the timeline.

    Attributes:
        name, unit, hint: shown to the user. digits: decimal places. colour: CSS.
        least: the upper end of the scale is at least this. value: (n,) in the strip's unit, NaN where there is none.
        limit: beyond it, a value is bad. worse: the bad direction. bars: draw single events instead of a curve.
        most: a value, and the words that replace numbers from this value on.
    """

    key: str
    name: str
    unit: str
    digits: int
    colour: str
    least: float
    hint: str
    value: Callable[[Series], F64]
    limit: Callable[[Snapshot], float] | None = None
    worse: Literal["high", "low"] = "high"
    bars: bool = False
    most: tuple[float, str] | None = None


def _inliers(series: Series) -> F64:
    return 100 * series["inliers"] / np.where(series["used"] > 0, series["used"], np.nan)


def uncertainty_cm(degeneracy: F64) -> F64:
    """1 σ of the direction that a scan constrains least; at most `OPEN_CM`."""
    with np.errstate(divide="ignore"):
        return np.minimum(100 / np.sqrt(np.maximum(degeneracy, 0.0)), OPEN_CM)


def _period_ms(snapshot: Snapshot) -> float:
    recording = snapshot.recording
    return 1e3 * recording.duration_s / max(recording.frames, 1) if recording else float("inf")


STRIPS: Final = (
    Strip("residual", "residual", "mm", 1, "#40b8f0", 20.0, "Distance of the points to the map's planes, RMS.",
          lambda s: 1e3 * s["residual_rms"]),
    Strip("inliers", "inliers", "%", 0, "#6384ff", 100.0, "Points that were matched to a plane in the map.",
          _inliers, worse="low"),
    Strip("uncertain", "degeneracy", "cm", 1, "#ce70dc", 6.0,
          "Uncertainty of the direction that this scan alone constrains least; over 10 cm is degenerate.",
          lambda s: uncertainty_cm(s["degeneracy"]), lambda _: DEGENERATE_CM, most=(OPEN_CM, OPEN)),
    Strip("ground", "ground", "%", 0, "#34c7aa", 100.0, "Points labelled ground. Red: no plane was found.",
          lambda s: 1e2 * s["ground_share"], lambda _: 1e-9, worse="low"),
    Strip("gap", "IMU gap", "ms", 0, "#98cd5a", 20.0, "Longest time between the IMU samples of the frame.",
          lambda s: 1e3 * s["imu_gap_s"], lambda snapshot: 1e3 * snapshot.params.imu.max_gap),
    Strip("dropped", "dropped", "scans", 0, "#ff785c", 1.0, "Scans dropped just before the frame.",
          lambda s: s["dropped"], lambda _: 0.5, bars=True),
    Strip("took", "frame time", "ms", 1, "#b8c0cc", 20.0, "Time of the engine. Red: slower than the sensor.",
          lambda s: s["total_ms"], _period_ms),
    Strip("error", "error", "cm", 1, "#ff5c8d", 5.0, "Distance to the truth, aligned to the trajectory so far.",
          lambda s: 1e2 * s["error_m"]),
)  # fmt: skip
"""The strips in the order shown; the row of loops comes last."""

_STAMP: Final = "stamp"
_VALUES: Final[dict[str, Callable[[Series], F64]]] = {
    **{strip.key: strip.value for strip in STRIPS},
    _STAMP: lambda s: s["stamp_s"],
}


def limits(snapshot: Snapshot) -> dict[str, float]:
    """Limits by the strips' keys: a value above its limit is bad, or below it if low values are worse."""
    return {strip.key: strip.limit(snapshot) for strip in STRIPS if strip.limit is not None}


class History:
    """Every frame seen in a session. After going back, later frames stay until they are processed again.

    Attributes:
        total: frames in the recording. present: the newest frame of the last snapshot, or -1.
    """

    def __init__(self) -> None:
        self.total = 1
        self.present = -1
        self._session = -1
        self._truth: Path | None = None
        self._columns: dict[str, F64] = {}  # (total,) per strip and for stamps, NaN where unknown
        self._loops: dict[Pair, tuple[int, Verdict]] = {}  # frame and verdict of each candidate

    def see(self, snapshot: Snapshot) -> None:
        """Store a snapshot's values of all frames up to its newest."""
        recording, series = snapshot.recording, snapshot.series
        if snapshot.session != self._session:
            self._session, self._columns, self._loops = snapshot.session, {}, {}
        self.total = max(recording.frames if recording else 1, 1)
        count = min(len(series["stamp_s"]), self.total)
        truth = recording.truth if recording else None
        for key, value in _VALUES.items():
            column, before = np.full(self.total, np.nan), self._columns.get(key, np.empty(0))[: self.total]
            column[: len(before)] = before
            column[:count] = value(series)[:count]
            self._columns[key] = column
        if truth != self._truth:
            self._columns["error"][count:] = np.nan  # these are distances to another truth
        later = {pair: entry for pair, entry in self._loops.items() if entry[0] >= count}
        edges, chunks = snapshot.loops.edges, snapshot.chunks
        here = [edge for edge in edges if edge.decided_at < len(chunks)]  # the others concern later keyframes
        self._loops = later | {edge.pair: (chunks[edge.decided_at].frame, edge.verdict) for edge in here}
        self._truth, self.present = truth, count - 1

    def columns(self) -> "Columns":
        """All frames, thinned to columns with equal numbers of frames."""
        count = min(self.total, COLUMNS)
        starts = np.arange(count) * self.total // count
        loops: dict[str, list[int]] = {verdict: [0] * count for verdict in Verdict}
        for frame, verdict in self._loops.values():
            loops[verdict][int(np.searchsorted(starts, frame, side="right")) - 1] += 1
        low = {strip.key: np.fmin.reduceat(self._columns[strip.key], starts) for strip in STRIPS}
        high = {strip.key: np.fmax.reduceat(self._columns[strip.key], starts) for strip in STRIPS}
        return Columns(starts=starts, stamps=self._columns[_STAMP][starts], low=low, high=high, loops=loops)

    def troubles(self, limits: dict[str, float]) -> list[int]:
        """First frame of each stretch in which any value except the frame time is bad: the red triangles."""
        bad = np.zeros(self.total, bool)
        for strip in STRIPS:
            limit = limits.get(strip.key)
            if strip.key in self._columns and strip.key != "took" and limit is not None:
                column = self._columns[strip.key]
                bad |= column > limit if strip.worse == "high" else column < limit
        return np.flatnonzero(bad & ~np.concatenate(([False], bad[:-1]))).tolist()


@dataclass(frozen=True, slots=True)
class Columns:
    """Attributes:
    starts: (c,) first frame of each column. stamps: (c,) s since the recording's start.
    low, high: (c,) least and greatest value in a column by `Strip.key`, NaN where there is none.
    loops: number of loops in each column, by verdict.
    """

    starts: I64
    stamps: F64
    low: dict[str, F64]
    high: dict[str, F64]
    loops: dict[str, list[int]]


def message(history: History, snapshot: Snapshot) -> dict[str, Any]:
    """Values for the page's script (`templates/transport.js`) to draw, ready for JSON."""
    columns, bad = history.columns(), limits(snapshot)
    recording = snapshot.recording
    strips = []
    for strip in STRIPS:
        low, high = columns.low[strip.key], columns.high[strip.key]
        if not np.isfinite(high).any() and strip.key == "error":
            continue  # no truth, no strip
        finite = high[np.isfinite(high)]
        usual = float(np.percentile(finite, 98)) if len(finite) else 0.0
        strips.append(
            {
                **{name: getattr(strip, name) for name in ("name", "unit", "digits", "colour", "hint", "bars", "most")},
                "low": strip.worse == "low",
                "top": strip.least if strip.worse == "low" else max(strip.least, 1.2 * usual),
                "limit": bad.get(strip.key),
                "data": packed(np.concatenate((low, high))),
            }
        )
    return {
        "frames": history.total,
        "present": history.present,
        "start": recording.start_s if recording else 0.0,
        "duration": recording.duration_s if recording else 1.0,
        "starts": columns.starts.tolist(),
        "stamps": packed(columns.stamps),
        "strips": strips,
        "loops": {name: counts for name, counts in columns.loops.items() if any(counts)},
        "notes": [[note.frame, note.text[:_NOTE_LETTERS]] for note in snapshot.notes[-_NOTES:]],
    }


def packed(numbers: F64) -> str:
    """Base64 of little-endian 32-bit floats."""
    return base64.b64encode(numbers.astype("<f4").tobytes()).decode()


class TimelinePanel:
    """The numbers of the strips; `templates/transport.js` draws them above the transport and marks its track."""

    def __init__(self, page: Page) -> None:
        gui = page.gui
        self._page = page
        self._history = History()
        self._changes = Changes(page.now, _PERIOD_S)
        self._latest = Snapshot()
        self._data = gui.add_html(panel("timeline_data", ""))
        add_command(gui, "Go to the next problem", lambda _: self._jump(1), hotkey="N")
        add_command(gui, "Go to the previous problem", lambda _: self._jump(-1), hotkey="B")

    def draw(self, snapshot: Snapshot) -> None:
        """Send changes, at most twice a second. Called often."""
        if snapshot.transport.frame < self._latest.transport.frame:
            self._history.see(self._latest)  # the last frames before going back
        self._latest = snapshot
        if not self._changes(
            snapshot.result, snapshot.loops.edges, snapshot.notes, snapshot.recording, snapshot.params.imu
        ):
            return
        self._history.see(snapshot)
        text = json.dumps(message(self._history, snapshot), separators=(",", ":")) if snapshot.result else ""
        self._data.content = panel("timeline_data", text)

    def _jump(self, by: int) -> None:
        snapshot = self._page.snapshot()
        here, frames = snapshot.transport.frame, self._history.troubles(limits(snapshot))
        there = next((frame for frame in frames[::by] if (frame - here) * by > 0), None)
        if there is None:
            raise HemislamError(f"The diagnostics show no problem {'after' if by > 0 else 'before'} this frame.")
        self._page.send(Seek(there))
