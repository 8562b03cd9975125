"""Points per second, size and memory of exports of a synthetic map."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.export.exports import of_formats, save_results
from app.export.results import Results
from app.slam.params import Params
from app.slam.provenance import peak_memory_mb
from app.slam.run_log import RunInfo, RunLog
from app.slam.types import Cloud, Keyframe
from benchmarks.record import Line

POINTS = 57_632
"""Points of a full revolution of an RS-Bpearl."""
KEYFRAMES = 347
"""20 million points."""
FORMATS = ("laz", "las", "e57", "ply")
RUNS = 3
LARGE = 1736
"""100 million points; exported once, as LAZ."""


class Walk:
    """Keyframes along a street, a metre apart, all made from one scan of ground and walls with 1 cm noise."""

    def __init__(self, count: int) -> None:
        self._count, rng = count, np.random.default_rng(1)
        angle = np.linspace(0, 2 * np.pi, POINTS, dtype=np.float32)
        below = np.tile(np.linspace(0.2, 1.4, 32, dtype=np.float32), POINTS // 32)
        reach = np.minimum(1.3 / np.sin(below), 8 / np.abs(np.cos(angle)).clip(0.1)).astype(np.float32)
        points = np.stack([reach * np.cos(angle), reach * np.sin(angle), -reach * np.sin(below)], axis=1)
        points = (points + rng.normal(0, 0.01, points.shape)).astype(np.float32)
        intensity = rng.integers(0, 255, POINTS).astype(np.float32)
        ring = np.tile(np.arange(32, dtype=np.uint16), POINTS // 32)
        offsets_ns = np.linspace(0, 100_000_000, POINTS).astype(np.int32)
        cloud = Cloud(points, (points[:, 2] < -1.2).astype(np.uint8), intensity, ring, offsets_ns)
        self._first = Keyframe(0, 0, 1_700_000_000_000_000_000, np.eye(4), np.eye(4), np.eye(6), cloud)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Keyframe:
        T = np.eye(4)
        T[1, 3] = index
        return replace(self._first, index=index, T_odom_imu=T, stamp_ns=self._first.stamp_ns + index * 1_000_000_000)


def run() -> list[Line]:
    lines = []
    for kind, keyframes, runs in (*((kind, KEYFRAMES, RUNS) for kind in FORMATS), ("laz", LARGE, 1)):
        rate, size, more = zip(*(_measure(kind, keyframes) for _ in range(runs)), strict=True)
        on = f"{kind}: {keyframes * POINTS / 1e6:.0f} million points"
        lines += [Line.of("export", on, "million points/s", rate), Line.of("size", on, "bytes a point", size)]
        lines.append(Line.of("memory beyond what was there, at most", on, "MB", more))
    return lines


def _measure(kind: str, keyframes: int) -> tuple[float, float, float]:
    """Million points per second, bytes per point and MB."""
    exports, info = of_formats([kind]), RunInfo(Path("walk.mcap"), Params())
    with tempfile.TemporaryDirectory() as folder:
        save_results(Path(folder), Results(RunLog([]), Walk(2), info), exports, replace=True)  # compiles and imports
        before, begin = _resident_mb(), time.perf_counter()
        save_results(Path(folder), Results(RunLog([]), Walk(keyframes), info), exports, replace=True)
        seconds = time.perf_counter() - begin
        size = sum(path.stat().st_size for path in Path(folder).iterdir())
    points = keyframes * POINTS
    return points / seconds / 1e6, size / points, peak_memory_mb() - before


def _resident_mb() -> float:
    """Present memory of this process; Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6
