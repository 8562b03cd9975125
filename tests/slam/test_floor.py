"""The floor around an upright scanner: collected while walking, not confused with walls, kept under people's feet."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.slam import ground, lie
from app.slam.engine import Engine
from app.slam.floor import Floor
from app.slam.kernels.floor import CELLS, EDGE_M
from app.slam.metrics import GroundScore
from app.slam.sections import GroundParams
from app.slam.types import NON_GROUND, SEED, GroundResult, ImuSamples, Scan, StepResult

from .scenes import YARD, Rig, Scene, box, corridor, params_for, upright

HEIGHT = 1.3
"""m, of the scanner above the floor."""
PARAMS = GroundParams()
RIG = Rig(T_imu_lidar=np.eye(4))


def at(x: float, y: float = 0.0, tilt: float = 0.0) -> np.ndarray:
    """T_odom_lidar."""
    return lie.transform(Rotation.from_euler("y", tilt, degrees=True).as_matrix(), np.array([x, y, 0.0]))


def segment(
    scan: Scan, T_odom_lidar: np.ndarray, floor: Floor | None = None, params: GroundParams = PARAMS
) -> GroundResult:
    return ground.segment(scan.points, scan.ring, -T_odom_lidar[2, :3], params, floor, T_odom_lidar)


def walk(scene: Scene, xs: np.ndarray, floor: Floor | None = None) -> tuple[GroundResult, Scan]:
    """The last scan of a walk along x, and what was found in it."""
    for k, x in enumerate(xs):
        scan = upright(scene, (x, 0.0), seed=k)
        result = segment(scan, at(x), floor)
        floor = result.floor
    return result, scan


def step(engine: Engine, k: int) -> StepResult:
    """The k-th frame of a scanner at rest in the yard."""
    stamps = k * 100_000_000 + np.arange(0, 100_000_001, 5_000_000)
    samples = ImuSamples(stamps, np.zeros((21, 3)), np.tile([0.0, 0.0, 9.81], (21, 1)))
    return engine.step(replace(upright(YARD, seed=k), stamp_ns=(k + 1) * 100_000_000), samples)


def score(result: GroundResult, scan: Scan) -> GroundScore:
    assert scan.truth_ground is not None
    return GroundScore.of(result.labels, scan.truth_ground)


@pytest.mark.parametrize("tilt", [-8.0, 0.0, 8.0])
def test_the_ground_far_out_is_found_in_a_second_of_scans_at_rest(tilt: float) -> None:
    T, floor = at(0.0, tilt=tilt), None
    for k in range(10):
        scan = upright(YARD, tilt=tilt, seed=k)
        result = segment(scan, T, floor)
        floor = result.floor
        assert result.found, result.reason
        assert (T[:3, :3] @ result.centroid)[2] == pytest.approx(-HEIGHT, abs=0.05)
        assert np.degrees(np.arccos(np.clip(result.normal @ T[2, :3], -1, 1))) < 0.5
    assert score(result, scan).recall > 0.85
    assert score(result, scan).precision > 0.9
    assert floor is not None
    assert 0.5 < np.count_nonzero(result.labels == SEED) / np.count_nonzero(result.labels) < 1.0
    assert result.seeds == np.count_nonzero(result.labels == SEED)
    heights = floor.known[floor.known[..., 1] > 0][:, 0]
    assert (np.abs(heights + HEIGHT) < 0.05).mean() > 0.99  # little beside the floor is remembered


@pytest.mark.parametrize("wall", [3.0, 0.9])
def test_in_a_room_too_small_to_see_the_floor_no_point_is_ground(wall: float) -> None:
    """Of a wall 0.9 m away, only 11 cm are below the scanner: the lowest of them look like a cone, not like a floor."""
    room = Scene(box(-5.0, -wall, -1.3, 5.0, wall, 1.4))
    floor = None
    for k in range(10):
        scan = upright(room, seed=k)
        result = segment(scan, at(0.0), floor)
        floor = result.floor
        assert scan.truth_ground is not None and not scan.truth_ground.any()
        assert not result.found and not result.labels.any()
        assert "seed" in result.reason


def test_a_few_points_of_floor_far_along_a_corridor_are_found_when_walking_it() -> None:
    """They are a thousandth of the points, and none is nearer than 10 m."""
    result, scan = walk(corridor(60.0, pillars=True), np.arange(0.0, 20.0, 0.12))
    assert scan.truth_ground is not None and 0 < scan.truth_ground.mean() < 0.02
    assert score(result, scan).f1 > 0.9
    lone = ground.segment(scan.points, scan.ring, np.array([0.0, 0.0, -1.0]), PARAMS)
    assert score(lone, scan).f1 < 0.5  # one scan alone does not tell


def test_what_was_seen_from_afar_is_known_underfoot() -> None:
    """A probe of points where the scanner stands, which it has only seen from 10 m away."""
    result, scan = walk(corridor(60.0, pillars=False), np.arange(0.0, 20.0, 0.12))
    rng = np.random.default_rng(0)
    xy = rng.uniform([0.2, -0.5], [0.6, 0.5], (200, 2))  # not straight down, where no earlier scan is asked
    for height, expected in ((-HEIGHT, True), (-HEIGHT + 0.2, False)):
        probe = np.column_stack([xy, np.full(200, height)]).astype(np.float32)
        points = np.concatenate([probe, scan.points])
        probed = Scan(0, points, *(np.zeros(len(points), kind) for kind in (np.int32, np.float32, np.uint16)))
        labels = segment(probed, at(20.0), result.floor, GroundParams(alpha=1)).labels
        assert ((labels[:200] != NON_GROUND).mean() > 0.95) == expected


def test_a_person_who_comes_takes_no_floor_away() -> None:
    hall = box(-5.0, -8.0, -HEIGHT, 60.0, 8.0, 3.0)
    person = box(20.0, 1.05, -HEIGHT, 20.4, 1.45, 0.5)
    result, _ = walk(Scene(hall), np.arange(0.0, 18.0, 0.12))
    result, scan = walk(Scene(hall, (person,)), np.arange(18.0, 19.8, 0.12), result.floor)
    assert score(result, scan).f1 > 0.9
    assert result.floor is not None
    i, j = np.floor(np.array([20.2, 1.25]) / EDGE_M).astype(int) - result.floor.corner
    assert np.isfinite(result.floor.seen[:, i, j, 3]).any()  # the person is seen
    assert result.floor.found[i, j] == pytest.approx(-HEIGHT, abs=0.05)


def test_a_height_that_scans_contradict_is_forgotten() -> None:
    """The face of a block, seen from afar in few points, passes for floor until more of it is seen."""
    floor = Floor.unknown(at(0.0))
    wrong = floor.known.copy()
    wrong[:, :] = (-HEIGHT + 0.3, 50)
    floor = replace(floor, known=wrong)
    for k in range(10):
        result = segment(upright(YARD, seed=k), at(0.0), floor)
        floor = result.floor
        assert floor is not None
    seen = np.isfinite(floor.found) & (floor.seen[0, ..., 0] > 3)
    assert seen.sum() > 100
    assert np.median(floor.found[seen]) == pytest.approx(-HEIGHT, abs=0.03)


def test_floor_that_is_left_behind_is_forgotten() -> None:
    result, _ = walk(YARD, np.array([0.0, 0.1, 0.2]))
    assert result.floor is not None and (result.floor.known[..., 1] > 0).any()
    far = segment(upright(YARD), at(1000.0), result.floor).floor
    assert far is not None and not (far.known[..., 1] > 0).any()
    np.testing.assert_array_equal(far.corner, np.array([2000, 0]) - CELLS // 2)


def test_a_floor_found_once_does_not_change_when_the_next_scan_comes() -> None:
    result, _ = walk(YARD, np.array([0.0, 0.1]))
    assert result.floor is not None
    before = [np.array(value) for value in (result.floor.seen, result.floor.known, result.floor.found)]
    segment(upright(YARD, (0.2, 0.0)), at(0.2), result.floor)
    for value, was in zip((result.floor.seen, result.floor.known, result.floor.found), before, strict=True):
        np.testing.assert_array_equal(value, was)


def test_the_ground_can_be_switched_on_while_a_frame_is_looked_at() -> None:
    engine = Engine(params_for(RIG))
    for k in range(12):
        result = step(engine, k)
    engine.params = params_for(RIG, {"ground.enabled": False})
    off = step(engine, 12)
    engine.params = params_for(RIG)
    assert not off.cloud.labels.any()
    assert engine.relabel(off).ground.share == pytest.approx(result.ground.share, rel=0.1)
    engine.close()


def test_the_engine_carries_the_floor_over_a_checkpoint_and_labels_a_frame_again_as_before() -> None:
    engine = Engine(params_for(RIG))
    for k in range(14):
        step(engine, k)
    state = engine.checkpoint()
    result = step(engine, 14)
    assert result.ground.found
    again = engine.relabel(result)
    np.testing.assert_array_equal(again.cloud.labels, result.cloud.labels)
    engine.restore(state)
    np.testing.assert_array_equal(step(engine, 14).cloud.labels, result.cloud.labels)
    for name, value in (("sigma", 0.002), ("scan_lines", 1), ("enabled", False)):
        engine.params = params_for(RIG, {f"ground.{name}": value})
        assert engine.relabel(result).ground.share < result.ground.share, name
    engine.close()
