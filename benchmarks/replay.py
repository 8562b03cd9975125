"""A whole recording through the engine's process, as fast as possible, without a page."""

import math
import time

from app.sensors.presets import resolve_params
from app.server.protocol import Play
from app.server.setup import Setup
from app.server.worker import EngineProcess
from benchmarks.record import Line
from benchmarks.scenes import SCENES, recording


def run() -> list[Line]:
    return [measure(scene) for scene in SCENES]


def measure(scene: str) -> Line:
    """Speed as a multiple of real time."""
    path = recording(scene)
    engine = EngineProcess(Setup(recording=path, params=resolve_params(path, None, None, []), speed=math.inf))
    try:
        snapshot = engine.snapshot
        while snapshot.engine_alive and (snapshot.recording is None or snapshot.progress is not None):
            snapshot = engine.wait(snapshot.revision)
        begin = time.perf_counter()
        engine.send(Play())
        while snapshot.engine_alive and not snapshot.transport.finished:
            snapshot = engine.wait(snapshot.revision)
        seconds = time.perf_counter() - begin
        if snapshot.recording is None or not snapshot.engine_alive:
            raise RuntimeError(f"the engine's process ended: {snapshot.notices[-1:]}")
        return Line.of("replay without a page", scene, "x real time", [snapshot.recording.duration_s / seconds])
    finally:
        engine.close()
