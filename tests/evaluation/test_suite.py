"""Suites of walks: twins of the paper's sequences with the same lengths, and walks with revisits; the same every time.

Tests app/cli/options.py, app/evaluation/paper.py.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from app.evaluation.paper import SEQUENCES
from app.sensors.simulator.imperfections import IMPERFECT, Imperfections
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.simulate import simulate, trajectory_through, unit_of
from app.sensors.simulator.suite import PAPER, REVISITS, Twin, find_suite, fitting_speed, make_twin, unit_seed
from app.sensors.simulator.trajectory import Walker
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.trajectory import read_tum

TWINS = {twin.scene: twin for twin in PAPER}


def walked(twin: Twin, seed: int = 0) -> np.ndarray:
    """True positions at 10 Hz of the whole walk."""
    walker = Walker(speed=fitting_speed(twin, seed), back=twin.back)
    trajectory = trajectory_through(build_scene(twin.scene, seed), twin.duration_s, seed, walker)
    return trajectory.poses(np.arange(0.05, twin.duration_s, 0.1))[0]


def test_the_suite_is_table_1() -> None:
    assert list(TWINS) == list(SEQUENCES)
    for name, sequence in SEQUENCES.items():
        twin = TWINS[name]
        assert (twin.frames, twin.length_m) == (sequence.frames, sequence.length_m)
        assert twin.duration_s == pytest.approx(sequence.duration_s, abs=0.1)
    with pytest.raises(HemislamError, match="no suite `papre`; there is paper, revisits"):
        find_suite("papre")


@pytest.mark.parametrize(("name", "seed"), [("indoor_1", 0), ("indoor_2", 3), ("outdoor_1", 1)])
def test_a_twin_is_as_long_as_its_sequence(name: str, seed: int) -> None:
    path = walked(TWINS[name], seed)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert length == pytest.approx(TWINS[name].length_m, rel=0.002)


def came_back_within(path: np.ndarray, metres: float) -> bool:
    """Whether a place is seen again after a minute; `path` is at 2 Hz."""
    tree = KDTree(path[:, :2])
    return any(abs(i - j) > 120 for i, j in tree.query_pairs(metres))


def test_the_fourth_walk_outdoors_has_no_loop_and_the_first_has() -> None:
    assert not came_back_within(walked(TWINS["outdoor_4"])[::5], 15.0)
    assert came_back_within(walked(TWINS["outdoor_1"])[::5], 2.0)


@pytest.mark.parametrize("twin", REVISITS, ids=lambda twin: twin.name)
def test_walks_of_the_other_suite_come_back_the_same_way_or_the_opposite_one(twin: Twin) -> None:
    path = walked(twin)[::5, :2]
    step = np.gradient(path, axis=0)
    ahead = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    pairs = np.array([pair for pair in KDTree(path).query_pairs(2.0) if abs(pair[0] - pair[1]) > 60])  # half a minute
    same_way = np.einsum("ij,ij->i", ahead[pairs[:, 0]], ahead[pairs[:, 1]])
    assert (same_way < -0.9).mean() > 0.2 if twin.back else (same_way > 0.9).mean() > 0.2


def test_a_twin_is_made_once_and_the_same_every_time(tmp_path: Path) -> None:
    twin = Twin("indoor_2", 80, 3.0)
    first, again = tmp_path / "first", tmp_path / "again"
    first.mkdir()
    again.mkdir()
    made = make_twin(twin, first, every_block=30)
    assert made.new
    truth = read_tum(made.recording.with_name("indoor_2_truth.tum"))
    assert len(truth) == 80
    before = made.recording.stat().st_mtime_ns
    assert not make_twin(twin, first, every_block=30).new
    assert made.recording.stat().st_mtime_ns == before
    assert make_twin(twin, again, every_block=30).recording.read_bytes() == made.recording.read_bytes()
    other = make_twin(twin, again, seed=1, every_block=30)
    assert other.recording.name == "indoor_2-seed1.mcap"
    assert other.recording.read_bytes() != made.recording.read_bytes()
    assert make_twin(twin, first, every_block=15).new  # other firings, another recording


def test_each_imperfect_walk_has_a_scanner_of_its_own(tmp_path: Path) -> None:
    """With one scanner for a suite, its mean errors would be those of that scanner."""
    walks = [(twin, seed) for twin in (*PAPER, *REVISITS) for seed in (0, 1)]
    turns = np.array([lie.log(unit_of(IMPERFECT, unit_seed(*walk)).mounting[:3, :3]) for walk in walks])
    assert len(np.unique(turns.round(9), axis=0)) == len(walks)
    assert np.abs(np.degrees(turns.mean(axis=0))).max() < 3 * 0.7 / np.sqrt(3 * len(walks))

    twin, errors = Twin("indoor_2", 50, 1.0), Imperfections(gyro_scale=0.1)
    made = make_twin(twin, tmp_path, every_block=30, imperfections=errors).recording.read_bytes()
    walker = Walker(speed=fitting_speed(twin, 0))
    for seed, same in ((unit_seed(twin, 0), True), (None, False)):
        simulate(
            "indoor_2", tmp_path / "own.mcap", duration_s=twin.duration_s, every_block=30, walker=walker,
            imperfections=errors, unit_seed=seed,
        )  # fmt: skip
        assert ((tmp_path / "own.mcap").read_bytes() == made) is same
