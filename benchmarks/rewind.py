"""Go back to 50 random frames and continue, with loops and parameter changes; compare with an uninterrupted run.

Every file saved at the end must be the same, byte for byte; the first difference ends the check.
"""

import json
import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import Command, Save, Seek, SetParams, SetSpeed, Snapshot, StepFrame
from app.server.publisher import Publisher
from app.slam.loops.types import Verdict
from app.slam.params import Params
from app.slam.warmup import compile_kernels
from benchmarks.record import Line

SAMPLE = next((Path(__file__).resolve().parents[1] / "sample_data").glob("*.mcap"))
FRAMES = 50
BUDGET = 64 << 20
"""Memory for checkpoints, bytes: so little that most are restored from disk."""
CHANGES: tuple[Mapping[str, Any], ...] = (
    {"ground.sigma": 0.02},
    {"scan.voxel_size": 0.6, "filter.plane_tilt": 4.0},
    {"keyframe.distance": 0.4},
    {"loops.drift_translation": 0.7},
    {"filter.max_iterations": 3, "ground.alpha": 35.0},
)
"""Parameter changes, made one after another, evenly spread over the recording."""
MOVES_WITH_TIME = ("timings_ms", "peak_memory_mb", "machine")
"""Entries of report.json that differ between any two runs."""

Plan = Mapping[int, Mapping[str, Any]]


class Walk:
    """A session on a recording, with loop search in its own process."""

    def __init__(self, path: Path) -> None:
        self.params = resolve_params(path, None, None, [])
        self._page, self._fold = Publisher(self.params), Fold(Snapshot(params=self.params))
        self.controller = Controller(self._page, self.params, self._open)
        self.controller.open(path, None)
        self.do(SetSpeed(math.inf))

    @staticmethod
    def _open(
        path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None = None, /
    ) -> Session:
        session = open_session(path, params, *(part or (0.0, None)), truth=truth, checkpoint_bytes=BUDGET)
        if session.loops is not None:
            session.loops.results()  # waits for the process to start
        return session

    def do(self, command: Command) -> Snapshot:
        """Work until nothing is pending."""
        self.controller.handle(command)
        while (wait := self.controller.work()) is not None:
            time.sleep(wait)
            if self._page.filled:
                self._fold.apply(self._page.take())
        self._fold.apply(self._page.take())
        return self._fold.snapshot

    def on_to_the_end(self, plan: Plan) -> Snapshot:
        """Play as if for the first time, changing parameters at the planned frames."""
        snapshot = self.do(SetParams({}))
        while not snapshot.transport.finished:
            here = snapshot.transport.frame
            if here in plan:
                self.do(SetParams(dict(plan[here])))
            snapshot = self.do(StepFrame(min((frame for frame in plan if frame > here), default=10**9) - here))
        return snapshot

    def saved(self, folder: Path) -> dict[str, bytes]:
        """The files by name, without the entries that differ between any two runs."""
        assert not self.do(Save(folder)).saved[-1].error
        files = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "timings.csv"}
        report = json.loads(files["report.json"])
        files["report.json"] = json.dumps({k: v for k, v in report.items() if k not in MOVES_WITH_TIME}).encode()
        return files


def run(recording: Path | None = None, frames: int = FRAMES) -> list[Line]:
    """Raises AssertionError: a run that went back ended differently."""
    path = recording or SAMPLE
    compile_kernels()
    walk = Walk(path)
    with tempfile.TemporaryDirectory(prefix="hemislam-rewind-") as folder:
        total = walk.do(SetParams({})).recording.frames  # type: ignore[union-attr]  # a recording is open
        plan = {total * (k + 1) // (len(CHANGES) + 1): change for k, change in enumerate(CHANGES)}
        ended = walk.on_to_the_end(plan)
        expected = walk.saved(Path(folder) / "never_stopped")
        loops = sum(edge.verdict is Verdict.ACCEPTED for edge in ended.loops.edges)
        assert loops, f"{path.name} has no loop that could be lost; choose another recording"
        rng = np.random.default_rng(0)
        last = ended.transport.frame
        for index, frame in enumerate(tqdm(rng.integers(0, last, frames).tolist(), desc="Restored", disable=None)):
            there = walk.do(Seek(frame))
            assert there.transport.frame == frame
            walk.do(SetParams(_chosen_at(frame, plan, walk.params)))
            walk.on_to_the_end(plan)
            again = walk.saved(Path(folder) / str(index))
            differ = [name for name in sorted(expected | again) if expected.get(name) != again.get(name)]
            assert not differ, f"restored at frame {frame} and continued, these differ: {', '.join(differ)}"
    walk.controller.close()
    on = f"{path.stem}: {last + 1:,} frames, {loops} loops, {len(CHANGES)} changes of parameters, {len(expected)} files"
    return [Line(f"of {frames} restored and continued", on, "differ", 0.0, 0.0, 0.0, frames)]


def _chosen_at(frame: int, plan: Plan, first: Params) -> dict[str, Any]:
    """All planned parameters as they were chosen when the run reached a frame."""
    names = {name for change in plan.values() for name in change}
    chosen = {name: first.value(name) for name in names}
    for at, change in sorted(plan.items()):
        if at < frame:
            chosen |= change
    return chosen
