"""The time a frame takes over the length of a walk: it must stay as it is, however large the map has grown.

Loops are searched within the frames that are keyframes, so that their work counts too: they show in the mean and
not in the median.
"""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.simulator.suite import PAPER, make_twin
from app.slam.engine import Engine
from app.slam.loops.service import InlineLoops
from app.slam.types import Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import FOLDER

TWIN = "outdoor_3"
"""9,530 frames and 869 m, the longest of the paper's sequences."""
EVERY_BLOCK = 6
"""9,600 firings a scan: the map grows just as much, and the recording is made within minutes."""
AROUND = 250
PLACES = (1000, 3000, 5000, 7000, 9000)


def run() -> list[Line]:
    compile_kernels()
    return measure(_recording())


def measure(path: Path) -> list[Line]:
    """Whole-frame time in ms around some frames, and that at the last of them over that at the first."""
    params = resolve_params(path, None, None, [])
    engine = Engine(params, InlineLoops)
    totals: list[float] = []
    with open_recording(path, params) as source, tqdm(desc=TWIN, unit=" frames", leave=False, disable=None) as bar:
        bar.total = source.scan_count
        for entry in source.measurements():
            if isinstance(entry, Measurement):
                totals.append(engine.step(entry.scan, entry.imu).timings_ms["total"])
                bar.update()
    engine.close()
    times = np.array(totals)
    windows = {place: times[place - AROUND : place + AROUND] for place in PLACES if place + AROUND <= len(times)}
    on = f"{TWIN}: {len(times):,} frames, {9600:,} firings a scan"
    lines = [Line.of(f"frames around {place:,}", on, "ms", window) for place, window in windows.items()]
    first, last = windows[min(windows)], windows[max(windows)]
    for name, middle in (("median", np.median), ("mean", np.mean)):
        ratio = float(middle(last) / middle(first))
        lines.append(Line.of(f"{max(windows):,} over {min(windows):,}, {name}", on, "ratio", [ratio]))
    return lines


def _recording() -> Path:
    FOLDER.mkdir(parents=True, exist_ok=True)
    (twin,) = (twin for twin in PAPER if twin.scene == TWIN)
    with tqdm(desc=f"Simulating {TWIN}", unit=" scans", leave=False, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return make_twin(twin, FOLDER, every_block=EVERY_BLOCK, progress=progress).recording
