"""Time to go to any frame of a ten-minute recording with loops, and the cost of checkpoints during playback."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from app.mapping.checkpoints import Checkpoints
from app.mapping.feed import FileFeed
from app.mapping.loops import RestartingLoops
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.server.protocol import Play, Seek, Snapshot, StepFrame
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.engine import Engine
from app.slam.types import Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import long_recording

SEEKS, STEPS = 60, 40
SMALL_BUDGET = 128 << 20
PATIENCE_S = 7200.0
MIB = 1 << 20


def run(recording: Path | None = None) -> list[Line]:
    """Args: recording: to use instead of the simulated ten minutes."""
    path = recording or long_recording()
    return [*seeking(path), *cost(path, SMALL_BUDGET)]


def seeking(path: Path, settled: Callable[[EngineProcess], None] = lambda engine: None) -> list[Line]:
    """Time from the command to the snapshot that shows the frame, through the engine's process.

    Args:
        settled: called after everything has been played, before times are measured.
    """
    engine = EngineProcess(Setup(recording=path, params=resolve_params(path, None, None, []), speed=math.inf))
    rng = np.random.default_rng(0)
    try:
        _until(engine, lambda now: now.recording is not None and now.progress is None)
        engine.send(Play())
        _until(engine, lambda now: now.transport.finished)
        settled(engine)
        last = engine.snapshot.transport.frame
        on = f"{path.stem}: {last + 1:,} frames, {len(engine.snapshot.chunks):,} keyframes"
        seeks = [_timed(engine, Seek(frame), frame) for frame in rng.integers(0, last, SEEKS).tolist()]
        steps = []
        for frame in rng.integers(STEPS, last, 3).tolist():
            _timed(engine, Seek(frame), frame)
            steps += [_timed(engine, StepFrame(-1), frame - back) for back in range(1, STEPS + 1)]
        return [
            Line.of("seek to a random frame", on, "ms", seeks),
            Line.of("step back one frame", on, "ms", steps),
        ]
    finally:
        engine.close()


def _timed(engine: EngineProcess, command: Seek | StepFrame, frame: int) -> float:
    begin = time.perf_counter()
    engine.send(command)
    _until(engine, lambda now: now.transport.frame == frame and now.progress is None)
    return (time.perf_counter() - begin) * 1e3


def _until(engine: EngineProcess, holds: Callable[[Snapshot], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds(snapshot := engine.snapshot):
        if not snapshot.engine_alive or time.monotonic() > deadline:
            raise RuntimeError(f"the wanted state was not reached: {snapshot.transport} {snapshot.notices[-1:]}")
        engine.wait(snapshot.revision, 1.0)


class _Timed(Checkpoints):
    """Measures the seconds spent on making and storing checkpoints."""

    seconds = _begin = 0.0

    def wanted(self, frame: int, *, near: bool = False) -> bool:
        self._begin = time.perf_counter()
        return super().wanted(frame, near=near)

    def add(self, frame: int, state: object) -> None:
        super().add(frame, state)
        self.seconds += time.perf_counter() - self._begin


def cost(path: Path, budget: int, frames: int | None = None) -> list[Line]:
    """The share of time spent on checkpoints, and the space that they need with a memory budget (bytes).

    Args:
        frames: to play; None: all.
    """
    params = resolve_params(path, None, None, [])
    compile_kernels()
    steps, held = 0.0, [0.0]
    checkpoints = _Timed(budget)
    session = Session(FileFeed(path, params), Engine(params), loops=RestartingLoops, checkpoints=checkpoints)
    if session.loops:
        session.loops.results()  # waits for the process to start
    checkpoints.seconds = 0.0
    with tqdm(desc="Checkpoints", total=frames, unit=" frames", leave=False, disable=None) as bar:
        while (entry := session.peek()) is not None and (frames is None or session.frame < frames):
            if isinstance(entry, Measurement):
                begin = time.perf_counter()
                session.advance()
                steps += time.perf_counter() - begin
                held.append(checkpoints.nbytes / MIB)
                bar.update()
    on = f"{path.stem}: {session.frame + 1:,} frames, checkpoints within {budget // MIB} MiB of memory"
    session.close()
    return [
        Line.of("share of the frame time", on, "%", [100 * checkpoints.seconds / (steps - checkpoints.seconds)]),
        Line.of("in memory and on disk", on, "MiB", held),
    ]
