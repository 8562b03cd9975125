"""Points per second and memory of an export, on a made-up map: `python -m benchmarks.export [laz] [millions]`."""

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.export.results import Results, of_formats, save_results
from app.slam.params import Params
from app.slam.provenance import peak_memory_mb
from app.slam.run_log import RunInfo, RunLog
from app.slam.types import Cloud, Keyframe

POINTS = 57_632
"""Of a full revolution of an RS-Bpearl."""


class Walk:
    """Keyframes along a street, a metre apart, from one scan of its ground and walls with 1 cm noise."""

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


def _resident_mb() -> float:
    """Memory of this process now; Linux only."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main(kind: str = "laz", millions: str = "20") -> None:
    walk = Walk(round(float(millions) * 1e6 / POINTS))
    points = len(walk) * POINTS
    results = Results(RunLog([]), walk, RunInfo(Path("walk.mcap"), Params()))
    exports = of_formats([kind])
    with tempfile.TemporaryDirectory() as folder:
        save_results(Path(folder), replace(results, keyframes=Walk(2)), exports, replace=True)  # compiles and imports
        before, begin = _resident_mb(), time.perf_counter()
        save_results(Path(folder), results, exports, replace=True)
        seconds = time.perf_counter() - begin
        more = peak_memory_mb() - before
        size = sum(path.stat().st_size for path in Path(folder).iterdir()) / points
    print(f"{kind}: {points / 1e6:.1f} million points, {points / seconds / 1e6:.2f} million/s, {size:.1f} bytes each,")
    print(f"at most {more:.0f} MB beyond what was there")


if __name__ == "__main__":
    main(*sys.argv[1:])
