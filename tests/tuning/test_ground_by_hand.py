"""Ground parameters tuned on five hand-labelled frames are as good on all other frames as those from a fine grid.

Tests app/tuning/tune.py and app/evaluation/run_job.py with marks of the brush.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.evaluation.evaluate import Subject
from app.evaluation.job import Job, finished
from app.evaluation.run_job import run_job
from app.mapping.opening import open_session
from app.mapping.painted import UNMARKED, Stroke, marks
from app.sensors.simulator.lidar import Lidar, firing_pattern
from app.sensors.simulator.raycast import Raycaster
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.trajectory import Walker, seconds, walk
from app.slam import ground
from app.slam.loops.service import InlineLoops
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.types import F64, GROUND, NON_GROUND, Scan, StepResult
from app.tuning.objectives import OBJECTIVES
from app.tuning.space import parse_dimensions
from app.tuning.trial import front
from app.tuning.tune import Part, SearchPlan, search
from tests.cli.conftest import write_walk

F1 = OBJECTIVES["ground-f1"]
VARIED = "ground.alpha=5:80,ground.sigma=0.005:0.15"
BY_HAND, OTHERS = range(1, 20, 4), range(0, 20, 2)


class Frames:
    """Labels frames with a setting and scores that against their marks; stands for runs."""

    def __init__(self, scans: Sequence[Scan], downs: Sequence[F64], drawn: Mapping[int, Any]) -> None:
        self._frames = [
            (scan, down, drawn[scan.stamp_ns])
            for scan, down in zip(scans, downs, strict=True)
            if scan.stamp_ns in drawn
        ]

    def score(self, settings: Sequence[Mapping[str, Any]], part: Part) -> list[tuple[tuple[float | None, ...], str]]:
        return [((self.f1(setting),), "") for setting in settings]

    def f1(self, setting: Mapping[str, Any]) -> float:
        params, total = Params().with_values(setting).ground, GroundScore()
        for scan, down, drawn in self._frames:
            labels = ground.segment(scan.points, scan.ring, down, params).labels
            total += GroundScore.of(labels[drawn != UNMARKED], drawn[drawn != UNMARKED])
        return total.f1


def knee_high_on_slopes() -> tuple[list[Scan], list[F64]]:
    """Scans of a scanner 0.5 m above rolling ground, and where down is in each."""
    scene = build_scene("outdoor", seed=3)
    walker, rng = Walker(height=0.5), np.random.default_rng(3)
    trajectory = walk(scene.path, 26.0, rng, walker=walker, closed=scene.closed, height=scene.height)
    pattern, caster = firing_pattern(every_block=12), Raycaster(scene.mesh, scene.movers)
    scans = [Lidar().turn(pattern, caster, trajectory, 3.0 + 1.1 * k, 0, np.random.default_rng(k)) for k in range(20)]
    _, rotations = trajectory.poses(seconds(np.array([scan.end_ns for scan in scans])))
    return scans, [R.T @ np.array([0.0, 0.0, -1.0]) for R in rotations]


def by_hand(scan: Scan) -> tuple[Stroke, Stroke]:
    """What a patient person marks: all the ground, and all else as not ground."""
    assert scan.truth_ground is not None
    floor = scan.truth_ground == 1
    return Stroke.of(scan.stamp_ns, floor, GROUND), Stroke.of(scan.stamp_ns, ~floor, NON_GROUND)


def test_five_labelled_frames_find_what_a_fine_grid_over_all_others_finds() -> None:
    scans, downs = knee_high_on_slopes()

    def frames(numbers: range) -> Frames:
        drawn = marks(stroke for number in numbers for stroke in by_hand(scans[number]))
        return Frames(scans, downs, drawn)

    few, others = frames(BY_HAND), frames(OTHERS)
    walk = Subject("walk", Path("walk.mcap"), Params())
    done, _ = search(few.score, SearchPlan([walk], parse_dimensions(VARIED), (F1,), trials=48))
    found = others.f1(front(done, (F1,))[0].values)
    grid = [
        others.f1({"ground.alpha": float(alpha), "ground.sigma": float(sigma)})
        for alpha in np.linspace(5, 80, 9)
        for sigma in np.geomspace(0.005, 0.15, 12)
    ]
    assert found > max(grid) - 0.01
    assert found > others.f1({}) + 0.01, "the usual parameters do not fit this sensor"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


def test_a_run_is_scored_against_the_marked_points_of_marked_frames_alone(recording: Path, tmp_path: Path) -> None:
    """Marks that repeat the engine's own labels are met to the last point; opposite ones never."""
    session, seen = open_session(recording, Params(), 0.0, 1.0, loops=InlineLoops), dict[int, np.ndarray]()
    while session.peek() is not None:
        if isinstance(result := session.advance(), StepResult):
            seen[result.stamp_ns] = result.cloud.labels != NON_GROUND
    session.close()
    stamps = list(seen)[3:5]

    def score(name: str, as_engine: bool) -> GroundScore:
        drawn = []
        for stamp in stamps:
            labels = (seen[stamp] == as_engine).astype(np.uint8)
            labels[::2] = UNMARKED
            drawn.append((stamp, labels.tobytes()))
        job = Job(recording, "x", "walk", name, Params(), tmp_path / name, duration_s=1.0, marks=tuple(drawn))
        run_job(job, lambda done, total: None)
        run = finished(job)
        assert run is not None
        return sum((GroundScore(**one) for one in run["ground"]), GroundScore())

    assert score("same", True).f1 == 1.0
    same = score("again", True)
    assert same.true_positive == sum(int(seen[stamp][1::2].sum()) for stamp in stamps)
    assert score("opposite", False).f1 == 0.0
