"""Times of one frame with 57,632 firings and with a sixth of them, stage by stage, and of reading it from the file."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.robosense import BPEARL
from app.slam.engine import Engine
from app.slam.types import TIMINGS, FrameStatus, Measurement, Scan
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import SCENES, recording


def run() -> list[Line]:
    compile_kernels()
    return [line for scene in SCENES for every in (1, 6) for line in measure(recording(scene), scene, every)]


def measure(path: Path, name: str, every: int = 1) -> list[Line]:
    """Time of reading and of every stage in ms, over the frames in which the filter ran.

    Args:
        every: use only every k-th block of firings.
    """
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
                result = engine.step(_thinned(entry.scan, every), entry.imu)
                if result.status is FrameStatus.TRACKING:
                    stages.append([result.timings_ms[stage] for stage in TIMINGS])
                    points.append(result.points_in)
                bar.update()
    engine.close()
    on = f"{name}: frames of {np.median(points):,.0f} returns"
    table = np.array(stages)
    lines = [Line.of(stage, on, "ms", table[:, column]) for column, stage in enumerate(TIMINGS)]
    return lines if every > 1 else [*lines, Line.of("reading", on, "ms", reading)]


def _thinned(scan: Scan, every: int) -> Scan:
    if every == 1:
        return scan
    keep = scan.offsets_ns // BPEARL.block_ns % every == 0
    labels = None if scan.truth_ground is None else scan.truth_ground[keep]
    return replace(
        scan,
        points=scan.points[keep],
        offsets_ns=scan.offsets_ns[keep],
        intensity=scan.intensity[keep],
        ring=scan.ring[keep],
        truth_ground=labels,
    )
