"""Compare only the ground segmentation with Patchwork++ from PyPI; `hemislam evaluate --baseline` compares odometry.

`make bench-peers` installs it into build/peers, which is last on the path, and runs this. Patchwork++ gets the same
deskewed, levelled clouds and the sensor's height; everything else keeps its defaults.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from app.baselines.poses import mounting
from app.baselines.systems import FOLDER
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.types import Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line, show
from benchmarks.scenes import SCENES, recording


def run(paths: list[Path], preset: str | None = None, duration_s: float | None = None) -> list[Line]:
    compile_kernels()
    return [line for path in paths for line in _ground(path, resolve_params(path, preset, None, []), duration_s)]


def _ground(path: Path, params: Params, duration_s: float | None) -> list[Line]:
    """Compare Patchwork++ and our method on the same deskewed, levelled clouds with the labels in the recording."""
    import pypatchworkpp

    settings = pypatchworkpp.Parameters()
    settings.verbose = False
    settings.sensor_height = 1.2
    settings.min_range = params.sensor.min_range
    peer = pypatchworkpp.patchworkpp(settings)
    engine = Engine(params)
    ours_ms, theirs_ms = [], []
    ours, theirs = GroundScore(), GroundScore()
    with open_recording(path, params) as source:
        for entry in source.measurements(0.0, duration_s):
            if not isinstance(entry, Measurement):
                continue
            result = engine.step(entry.scan, entry.imu)
            if result.truth_ground is None:
                return []
            R_level_lidar = (result.T_map_imu @ mounting(params))[:3, :3]
            cloud = result.cloud.points @ R_level_lidar.T.astype(np.float32)
            table = np.column_stack([cloud, result.cloud.intensity]).astype(np.float32)
            begin = time.perf_counter()
            peer.estimateGround(table)
            theirs_ms.append((time.perf_counter() - begin) * 1e3)
            ours_ms.append(result.timings_ms["ground"])
            labels = np.zeros(len(cloud), np.uint8)
            labels[np.asarray(peer.getGroundIndices()).ravel()] = 1
            theirs += GroundScore.of(labels, result.truth_ground)
            ours += GroundScore.of(result.cloud.labels, result.truth_ground)
    engine.close()
    on = f"{path.stem}, ground alone"
    return [
        Line.of("hemislam, time per frame", on, "ms", ours_ms),
        Line.of("hemislam, F1", on, "", [ours.f1]),
        Line.of("patchwork++, time per frame", on, "ms", theirs_ms),
        Line.of("patchwork++, F1", on, "", [theirs.f1]),
        Line.of("patchwork++ over hemislam, time", on, "ratio", [np.median(theirs_ms) / np.median(ours_ms)]),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Patchwork++ on the same recording.")
    parser.add_argument("recordings", nargs="*", type=Path, help="default: the simulated scenes of the benchmarks")
    parser.add_argument("--preset", help="as for hemislam itself")
    parser.add_argument("--duration", type=float, help="seconds of each recording; default: all of it")
    given = parser.parse_args()
    sys.path.append(str(FOLDER))  # last, so that hemislam's versions of shared packages take priority
    try:
        show(run(given.recordings or [recording(scene) for scene in SCENES], given.preset, given.duration))
    except ImportError as error:
        sys.exit(f"Patchwork++ is not installed ({error}); `make bench-peers` does that.")


if __name__ == "__main__":
    main()
