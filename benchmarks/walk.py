"""Time per frame over a long walk: it must not grow with the map.

Loops are searched within the frames that are keyframes, so that this work counts too: it appears in the mean but not in
the median. On a shared machine, early and late frames of the walk would be processed hours apart. Therefore a second
engine waits at the early frames; when the first one reaches the late frames, both work in turn, frame by frame.
"""

from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from app.mapping.feed import Feed, FeedInfo
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.simulator.suite import PAPER, make_twin
from app.slam.engine import Engine
from app.slam.loops.service import InlineLoops
from app.slam.params import Params
from app.slam.types import Measurement, StepResult
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import FOLDER

TWIN = "outdoor_3"
"""The longest of the paper's sequences: 9,530 frames and 869 m."""
EVERY_BLOCK = 6
"""9,600 firings per scan: the map grows just as much, and the recording is made within minutes."""
AROUND = 250
EARLY, LATE = 1000, 9000
PLACES = (3000, 5000, 7000)
"""Frames in between, whose times depend on the machine's load at that moment."""


def run() -> list[Line]:
    compile_kernels()
    return measure(_recording())


def measure(path: Path) -> list[Line]:
    """Whole-frame time in ms around some frames, and the ratio of late to early times."""
    params = resolve_params(path, None, None, [])
    waiting, walking = _Walk(path, params), _Walk(path, params)
    early: list[Measurement] = []
    times: dict[int, list[float]] = {place: [] for place in (0, EARLY, *PLACES, LATE)}
    with open_recording(path, params) as source, tqdm(desc=TWIN, unit=" frames", leave=False, disable=None) as bar:
        bar.total = LATE + AROUND
        scans = (entry for entry in source.measurements() if isinstance(entry, Measurement))
        for frame, entry in enumerate(islice(scans, LATE + AROUND)):
            if frame < EARLY - AROUND:
                waiting.step(entry)
            elif frame < EARLY + AROUND:
                early.append(entry)
            place = next((place for place in (*PLACES, LATE) if place - AROUND <= frame < place + AROUND), 0)
            work = [(walking, entry, place)]
            if place == LATE:
                work.append((waiting, early[frame - (LATE - AROUND)], EARLY))
            for walk, scan, there in work if frame % 2 else reversed(work):
                times[there].append(walk.step(scan).timings_ms["total"])
            bar.update()
    waiting.session.close()
    walking.session.close()
    on = f"{TWIN}: {frame + 1:,} frames, {9600:,} firings a scan"
    lines = [Line.of(f"frames around {place:,}", on, "ms", window) for place, window in times.items() if place]
    for name, middle in (("median", np.median), ("mean", np.mean)):
        ratio = float(middle(times[LATE]) / middle(times[EARLY]))
        lines.append(Line.of(f"{LATE:,} over {EARLY:,}, {name}", on, "ratio", [ratio]))
    return lines


class _Walk(Feed):
    """A session that gets its measurements one by one."""

    def __init__(self, path: Path, params: Params) -> None:
        self._path = path
        self._next: Measurement | None = None
        self.session = Session(self, Engine(params), loops=InlineLoops)

    @property
    def info(self) -> FeedInfo:
        return FeedInfo(self._path)

    def next(self) -> Measurement | None:
        return self._next

    def step(self, measurement: Measurement) -> StepResult:
        self._next = measurement
        result = self.session.advance()
        assert isinstance(result, StepResult)
        return result


def _recording() -> Path:
    FOLDER.mkdir(parents=True, exist_ok=True)
    (twin,) = (twin for twin in PAPER if twin.scene == TWIN)
    with tqdm(desc=f"Simulating {TWIN}", unit=" scans", leave=False, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return make_twin(twin, FOLDER, every_block=EVERY_BLOCK, progress=progress).recording
