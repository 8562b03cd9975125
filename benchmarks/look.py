"""Time from a click on a map of 3 million points to its coordinates on the page; comparing two maps of a million."""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import viser

from app.evaluation.cloud_distance import compare
from app.server.folders import Folders
from app.server.fork import Workspace
from app.server.keeping import KeepMeasure
from app.server.protocol import Chunk, Command, Snapshot
from app.server.setup import Setup
from app.slam.types import F64
from app.ui.measure import POINT
from app.ui.workbench import Workbench
from benchmarks.client import listening
from benchmarks.record import Line

KEYFRAMES, POINTS = 600, 5_000
CLICKS = 20
EYE = np.array([90.0, -30.0, 20.0])


class _Engine:
    """Keeps measures at once, and does nothing else."""

    engine_alive = True

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot

    def send(self, command: Command) -> None:
        if isinstance(command, KeepMeasure):
            now = self.snapshot
            self.snapshot = replace(now, revision=now.revision + 1, measures=(*now.measures, command.measure))

    def wait(self, revision: int, timeout: float) -> Snapshot:
        if self.snapshot.revision <= revision:
            time.sleep(timeout)
        return self.snapshot


def run() -> list[Line]:
    on = f"{KEYFRAMES * POINTS:,} points of {KEYFRAMES} keyframes"
    rng = np.random.default_rng(0)
    surface, other = _surface(rng), _surface(rng)
    begin = time.process_time()
    compare(surface, surface + np.array([0.0, 0.0, 2.0]), other)
    return [
        Line.of("click to its coordinates sent to the page", on, "ms", 1e3 * np.array(_clicks(rng))),
        Line.of(
            "comparison of two maps, CPU time",
            f"{len(surface):,} points on 40 x 25 m",
            "s",
            [time.process_time() - begin],
        ),
    ]


def _surface(rng: np.random.Generator) -> F64:
    points = rng.uniform(0.0, 1.0, (1_000_000, 3)) * [40.0, 25.0, 0.0]
    return np.asarray(points + rng.normal(0.0, 0.01, points.shape))


def _clicks(rng: np.random.Generator) -> list[float]:
    """Seconds from each click to the label that a page was sent."""
    chunks, poses = [], np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    poses[:, 0, 3] = 0.3 * np.arange(KEYFRAMES)
    for k in range(KEYFRAMES):
        points = rng.uniform(-20.0, 20.0, (POINTS, 3)).astype(np.float32)
        points[:, 2] = rng.choice([-1.2, 3.0], POINTS)
        labels, rings = (points[:, 2] < 0).astype(np.uint8), np.zeros(POINTS, np.uint16)
        chunks.append(Chunk(k, k, k, points, labels, np.zeros(POINTS, np.float32), rings, np.eye(4)))
    engine: Any = _Engine(Snapshot(chunks=tuple(chunks), keyframe_poses=poses))
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    found = []
    with TemporaryDirectory() as folder:
        forks = Workspace(engine, Setup(), lambda _: engine)
        workbench = Workbench(server, forks, Folders([Path(folder)]))
        workbench.start()
        with listening(f"http://127.0.0.1:{server.get_port()}/") as page:
            _until(lambda: workbench._scene.chunks.points > 0)
            time.sleep(15.0)  # until the page has received everything
            for number in range(CLICKS):
                workbench._measure.begin(POINT)
                aim = np.array([60.0 + 3 * number, 0.0, -1.2]) - EYE
                heard, begin = len(page.heard), time.monotonic()
                client = SimpleNamespace(camera=SimpleNamespace(fov=1.0))
                event: Any = SimpleNamespace(client=client, ray_origin=tuple(EYE), ray_direction=tuple(aim))
                workbench._measure.clicked(event)
                found.append(_label(page, heard, number) - begin)
        workbench.close()
    server.stop()
    return found


def _label(page: Any, heard: int, number: int) -> float:
    """Time at which the page was sent the label of this measure."""
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        for at, message in page.entries(heard):
            if message["type"] == "LabelMessage" and message["name"].endswith(f"/{number}/label"):
                return float(at)
        time.sleep(0.002)
    raise RuntimeError("the click met nothing")


def _until(holds: Any) -> None:
    deadline = time.monotonic() + 120.0
    while not holds():
        if time.monotonic() > deadline:
            raise RuntimeError("the map is not drawn")
        time.sleep(0.1)
