"""The numbers of the timeline: what is shown of every frame, thinned to columns in which spikes stay visible."""

import base64
from dataclasses import dataclass
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


def values(series: dict[str, F64]) -> dict[str, F64]:
    """(n,) by `Strip.key`, in its unit; nan where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "residual": 1e3 * series["residual_rms"],
            "inliers": 100 * series["inliers"] / np.where(series["used"] > 0, series["used"], np.nan),
            "uncertain": 100 / np.sqrt(series["degeneracy"]),
            "ground": 100 * series["ground_share"],
            "gap": 1e3 * series["imu_gap_s"],
            "dropped": series["dropped"],
            "took": series["total_ms"],
            "error": 100 * series["error_m"],
        }


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

    Attributes:
        total: frames of the recording. present: the newest frame of the snapshot seen last, or -1.
    """

    def __init__(self) -> None:
        self._session = -1
        self._forget(-1, 1)

    def _forget(self, session: int, total: int) -> None:
        self._session, self.total, self.present = session, total, -1
        self._truth: Path | None = None
        self._stamps = np.full(total, np.nan)
        self._values = {strip.key: np.full(total, np.nan) for strip in STRIPS}
        self._loops: dict[Pair, tuple[int, Verdict]] = {}

    def see(self, snapshot: Snapshot) -> None:
        """Take in what a snapshot says of all frames up to its newest."""
        total = max(snapshot.recording.frames if snapshot.recording else 1, 1)
        if snapshot.session != self._session or total != self.total:
            self._forget(snapshot.session, total)
        truth = snapshot.recording.truth if snapshot.recording else None
        if truth != self._truth:
            self._truth = truth
            self._values["error"][:] = np.nan  # what there was is the distance to another
        n = min(len(snapshot.series.get("stamp_s", ())), total)
        if n:
            self._stamps[:n] = snapshot.series["stamp_s"][:n]
            for key, column in values(snapshot.series).items():
                self._values[key][:n] = column[:n]
        self.present = n - 1
        later = {pair: entry for pair, entry in self._loops.items() if entry[0] > self.present}
        self._loops = later | loop_frames(snapshot.loops.edges, snapshot.chunks)

    def columns(self, most: int = COLUMNS) -> "Columns":
        """Everything, thinned to at most so many columns of equally many frames."""
        count = min(self.total, most)
        starts = np.arange(count) * self.total // count
        loops: dict[str, list[int]] = {verdict: [0] * count for verdict in Verdict}
        for frame, verdict in self._loops.values():
            loops[verdict][int(np.searchsorted(starts, frame, side="right")) - 1] += 1
        return Columns(
            starts=starts,
            stamps=self._stamps[starts],
            low={key: np.fmin.reduceat(column, starts) for key, column in self._values.items()},
            high={key: np.fmax.reduceat(column, starts) for key, column in self._values.items()},
            loops=loops,
        )

    def troubles(self, limits: dict[str, float]) -> list[int]:
        """Frames where something begins to be bad, or a loop was decided; ascending."""
        frames = {frame for frame, verdict in self._loops.values() if verdict is not Verdict.CANDIDATE}
        for strip in STRIPS:
            if (limit := limits.get(strip.key)) is not None:
                column = self._values[strip.key]
                bad = column > limit if strip.worse == "high" else column < limit
                frames |= set(np.flatnonzero(bad & ~np.concatenate(([False], bad[:-1]))).tolist())
        return sorted(frames)


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
