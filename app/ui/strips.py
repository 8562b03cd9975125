"""The numbers of the timeline: what is shown of every frame, thinned to columns in which spikes stay visible."""

import base64
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from app.server.protocol import Chunk, Snapshot
from app.slam.loops.types import LoopEdge, Pair, Verdict
from app.slam.types import F64, I64

COLUMNS: Final = 480
"""Most columns that a recording is thinned to, however long."""
DEGENERATE_CM: Final = 5.0
"""A direction more uncertain than this is called degenerate (`app.slam.iekf.DEGENERATE_SIGMA`)."""
_NOTES: Final = 50
_NOTE_LETTERS: Final = 120
_UNKNOWN: Final = 65535
_STEPS: Final = 65534


@dataclass(frozen=True, slots=True)
class Strip:
    """One row of the timeline.

    Attributes:
        name, unit, hint: for people. digits: after the point. colour: CSS.
        worse: which way is bad. least: the scale ends here at least. bars: single events, not a curve.
    """

    key: str
    name: str
    unit: str
    digits: int
    colour: str
    least: float
    hint: str
    worse: Literal["high", "low"] = "high"
    bars: bool = False


STRIPS: Final = (
    Strip("residual", "residual", "mm", 1, "#40b8f0", 20.0, "Distance of the points to the map's planes, RMS."),
    Strip("inliers", "inliers", "%", 0, "#6384ff", 100.0, "Points that found a plane in the map.", worse="low"),
    Strip("uncertain", "degeneracy", "cm", 1, "#ce70dc", 6.0,
          "How uncertain this scan alone leaves the direction it holds least; over 5 cm is degenerate."),
    Strip("ground", "ground", "%", 0, "#34c7aa", 100.0, "Points labelled ground. Red: no plane was found.",
          worse="low"),
    Strip("gap", "IMU gap", "ms", 0, "#98cd5a", 20.0, "Longest time between the IMU samples of the frame."),
    Strip("dropped", "dropped", "scans", 0, "#ff785c", 1.0, "Scans left out just before the frame.", bars=True),
    Strip("took", "frame time", "ms", 1, "#b8c0cc", 20.0, "Of the engine. Red: slower than the sensor."),
    Strip("error", "error", "cm", 1, "#ff5c8d", 5.0, "Distance to the truth, aligned to the walk so far."),
)  # fmt: skip
"""In the order shown; the loops' row comes last."""


_STAMP: Final = "stamp"
_KEYS: Final = (*(strip.key for strip in STRIPS), _STAMP)
_MEASURED: Final = {
    "residual": ("residual_rms", 1e3),
    "ground": ("ground_share", 1e2),
    "gap": ("imu_gap_s", 1e3),
    "dropped": ("dropped", 1.0),
    "took": ("total_ms", 1.0),
    "error": ("error_m", 1e2),
    _STAMP: ("stamp_s", 1.0),
}
"""The readout that a strip shows in another unit, and by which factor."""


def value(key: str, series: dict[str, F64]) -> F64:
    """(n,) of a strip, in its unit; nan where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        match key:
            case "inliers":
                return 100 * series["inliers"] / np.where(series["used"] > 0, series["used"], np.nan)
            case "uncertain":
                return 100 / np.sqrt(series["degeneracy"])
            case _:
                name, scale = _MEASURED[key]
                return scale * series[name]


def limits(snapshot: Snapshot) -> dict[str, float]:
    """From where on a strip's value is bad, by key: over it, or under it where low is worse."""
    recording = snapshot.recording
    period_ms = 1e3 * recording.duration_s / max(recording.frames, 1) if recording else float("inf")
    return {
        "uncertain": DEGENERATE_CM,
        "ground": 1e-9,
        "gap": 1e3 * snapshot.params.imu.max_gap,
        "dropped": 0.5,
        "took": period_ms,
    }


class History:
    """All frames that were seen in a session: those that were gone back over stay until they are replaced.

    Only these are kept here. All others are in the snapshot seen last.

    Attributes:
        total: frames of the recording.
    """

    def __init__(self) -> None:
        self.total = 1
        self._forget()

    def _forget(self) -> None:
        self._seen = Snapshot(session=-1)
        self._later: dict[str, F64] = {}  # by strip, of frames after `present`
        self._later_loops: dict[Pair, tuple[int, Verdict]] = {}

    @property
    def present(self) -> int:
        """The newest frame of the snapshot seen last, or -1."""
        return min(len(self._seen.series.get("stamp_s", ())), self.total) - 1

    def see(self, snapshot: Snapshot) -> None:
        """Take in what a snapshot says of all frames up to its newest."""
        self.total = max(snapshot.recording.frames if snapshot.recording else 1, 1)
        if snapshot.session != self._seen.session:
            self._forget()
        count = len(snapshot.series.get("stamp_s", ()))
        if self._later or count <= self.present:
            self._later = {key: self._known(key)[count:] for key in _KEYS}
            self._later_loops = {pair: entry for pair, entry in self._loops().items() if entry[0] >= count}
        if self._later and _truth(snapshot) != _truth(self._seen):
            self._later["error"][:] = np.nan  # what there was is the distance to another
        self._seen = replace(snapshot, result=None, trajectory=None, keyframe_poses=None)  # large, and not needed here

    def _known(self, key: str) -> F64:
        """(n,) of a strip, or stamps, of all frames that there were."""
        series = self._seen.series
        parts = [value(key, series)] if series else []
        return np.concatenate((*parts, self._later.get(key, np.empty(0))))

    def _column(self, key: str) -> F64:
        """(total,), nan where there is none."""
        known = self._known(key)[: self.total]
        return np.concatenate((known, np.full(self.total - len(known), np.nan)))

    def _loops(self) -> dict[Pair, tuple[int, Verdict]]:
        """The frames at which candidates got their verdicts, and these."""
        return self._later_loops | loop_frames(self._seen.loops.edges, self._seen.chunks)

    def columns(self, most: int = COLUMNS) -> "Columns":
        """Everything, thinned to at most so many columns of equally many frames."""
        count = min(self.total, most)
        starts = np.arange(count) * self.total // count
        loops: dict[str, list[int]] = {verdict: [0] * count for verdict in Verdict}
        for frame, verdict in self._loops().values():
            loops[verdict][int(np.searchsorted(starts, frame, side="right")) - 1] += 1
        low, high = {}, {}
        for strip in STRIPS:
            column = self._column(strip.key)
            low[strip.key], high[strip.key] = np.fmin.reduceat(column, starts), np.fmax.reduceat(column, starts)
        return Columns(starts=starts, stamps=self._column(_STAMP)[starts], low=low, high=high, loops=loops)

    def troubles(self, limits: dict[str, float]) -> list[int]:
        """Frames where something begins to be bad, or a loop was decided; ascending."""
        frames = {frame for frame, verdict in self._loops().values() if verdict is not Verdict.CANDIDATE}
        for strip in STRIPS:
            if (limit := limits.get(strip.key)) is not None:
                column = self._column(strip.key)
                bad = column > limit if strip.worse == "high" else column < limit
                frames |= set(np.flatnonzero(bad & ~np.concatenate(([False], bad[:-1]))).tolist())
        return sorted(frames)


def _truth(snapshot: Snapshot) -> Path | None:
    return snapshot.recording.truth if snapshot.recording else None


@dataclass(frozen=True, slots=True)
class Columns:
    """Attributes:
    starts: (c,) first frame of each column. stamps: (c,) s since the recording's start.
    low, high: (c,) least and greatest value of a column by `Strip.key`, nan where there is none.
    loops: how many of each verdict.
    """

    starts: I64
    stamps: F64
    low: dict[str, F64]
    high: dict[str, F64]
    loops: dict[str, list[int]]


def loop_frames(edges: tuple[LoopEdge, ...], chunks: tuple[Chunk, ...]) -> dict[Pair, tuple[int, Verdict]]:
    """The frame at which each candidate got its verdict, and that; those of keyframes not yet here are left out."""
    return {edge.pair: (chunks[edge.decided_at].frame, edge.verdict) for edge in edges if edge.decided_at < len(chunks)}


def message(history: History, snapshot: Snapshot) -> dict[str, Any]:
    """What the page's script draws (`app.ui.timeline_script`), as JSON-ready values.

    Numbers are whole steps of 1/65534 of a strip's largest value, 65535 for none.
    """
    columns, bad = history.columns(), limits(snapshot)
    recording = snapshot.recording
    strips = []
    for strip in STRIPS:
        low, high = columns.low[strip.key], columns.high[strip.key]
        if not np.isfinite(high).any() and strip.key == "error":
            continue  # no truth, no strip
        largest = float(np.fmax.reduce(high, initial=0.0))
        finite = high[np.isfinite(high)]
        usual = float(np.percentile(finite, 98)) if len(finite) else 0.0
        strips.append(
            {
                "name": strip.name,
                "unit": strip.unit,
                "digits": strip.digits,
                "colour": strip.colour,
                "hint": strip.hint,
                "low": strip.worse == "low",
                "bars": strip.bars,
                "top": strip.least if strip.worse == "low" else max(strip.least, 1.2 * usual),
                "limit": bad.get(strip.key),
                "largest": largest,
                "data": packed(np.concatenate((low, high)), largest),
            }
        )
    duration = recording.duration_s if recording else 1.0
    return {
        "frames": history.total,
        "present": history.present,
        "duration": duration,
        "starts": columns.starts.tolist(),
        "stamps": packed(columns.stamps, duration),
        "strips": strips,
        "loops": {name: counts for name, counts in columns.loops.items() if any(counts)},
        "notes": [[note.frame, note.text[:_NOTE_LETTERS]] for note in snapshot.notes[-_NOTES:]],
    }


def packed(numbers: F64, largest: float) -> str:
    """Base64 of little-endian 16-bit steps."""
    with np.errstate(invalid="ignore"):
        steps = np.round(np.clip(numbers / max(largest, 1e-12), 0.0, 1.0) * _STEPS)
    return base64.b64encode(np.where(np.isfinite(steps), steps, _UNKNOWN).astype("<u2").tobytes()).decode()
