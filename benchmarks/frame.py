"""One frame of 57,632 firings, stage by stage, and reading it from the file."""

import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.results import TIMINGS
from app.slam.types import FrameStatus, Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import SCENES, recording


def run() -> list[Line]:
    compile_kernels()
    return [line for scene in SCENES for line in measure(recording(scene), scene)]


def measure(path: Path, name: str) -> list[Line]:
    """Reading and every stage in ms, over the frames on which the filter was at work."""
    params = resolve_params(path, None, None, [])
    engine = Engine(params)
    reading: list[float] = []
    stages: list[list[float]] = []
    points: list[int] = []
    with open_recording(path, params) as source, tqdm(desc=name, unit=" frames", leave=False, disable=None) as bar:
        entries = source.measurements()
        while True:
            begin = time.perf_counter()
            entry = next(entries, None)
            if entry is None:
                break
            reading.append((time.perf_counter() - begin) * 1e3)
            if isinstance(entry, Measurement):
                result = engine.step(entry.scan, entry.imu)
                if result.status is FrameStatus.TRACKING:
                    stages.append([result.timings_ms[stage] for stage in TIMINGS])
                    points.append(result.points_in)
                bar.update()
    engine.close()
    on = f"{name}: frames of {np.median(points):,.0f} returns"
    table = np.array(stages)
    return [
        *(Line.of(stage, on, "ms", table[:, column]) for column, stage in enumerate(TIMINGS)),
        Line.of("reading", on, "ms", reading),
    ]
