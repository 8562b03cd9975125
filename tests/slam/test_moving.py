"""Moving points are found because rays pass through their places.

Tests app/slam/moving.py and app/slam/kernels/free_space.py.

The scans are cast by open3d into a room with a person; a cast without the person shows which rays hit them.
"""

from collections.abc import Callable

import numpy as np
import pytest

from app.sensors.simulator.lidar import firing_pattern
from app.sensors.simulator.mesh import MeshBuilder
from app.sensors.simulator.raycast import Mover, Raycaster
from app.sensors.simulator.scenes.props import person_mesh
from app.slam import lie, moving
from app.slam.sections import MovingParams
from app.slam.types import F64, GROUND, NON_GROUND, Cloud, Keyframe, Mask

PATTERN = firing_pattern(every_block=6)
FORWARD = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""The hemisphere looks along +x."""
EYE = np.array([1.0, 0.0, 1.3])
STEP_S = 0.5
PARAMS = MovingParams()
Pose = Callable[[F64], tuple[F64, F64]]


def room() -> MeshBuilder:
    mesh = MeshBuilder()
    mesh.quad([[0, -4, 0], [20, -4, 0], [20, 4, 0], [0, 4, 0]], 0.4, ground=True)
    mesh.quad([[0, -4, 3], [20, -4, 3], [20, 4, 3], [0, 4, 3]], 0.4)
    for a, b in (((0, -4), (20, -4)), ((20, -4), (20, 4)), ((20, 4), (0, 4)), ((0, 4), (0, -4))):
        mesh.quad([[*a, 0], [*b, 0], [*b, 3], [*a, 3]], 0.4)
    mesh.box((9.0, 2.0, 1.0), (0.4, 0.4, 2.0), 0.4)  # a pillar, and a pole
    mesh.cylinder((12.0, -2.0, 0.0), 0.04, 2.5, 0.4)
    return mesh


def person(pose: Pose) -> Mover:
    return Mover(person_mesh(), pose)


def at(x: Callable[[F64], F64], y: Callable[[F64], F64]) -> Pose:
    return lambda t: (np.column_stack([x(t), y(t), 0 * t]), 0 * t)


def walk(
    scene_at: Callable[[float], Raycaster], *, count: int = 16, upright: bool = False, noise: float = 0.01
) -> list[Keyframe]:
    """Keyframes of someone who walks along x, with noise (m) of ranges and half as much of poses."""
    rng, found = np.random.default_rng(0), []
    R = np.eye(3) if upright else FORWARD
    for index in range(count):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, EYE + np.array([STEP_S * index, 0.1 * np.sin(index), 0.03 * np.cos(index)])
        directions = PATTERN.directions @ R.T
        time = np.full(len(directions), STEP_S * index)
        hits = scene_at(STEP_S * index).cast(np.broadcast_to(T[:3, 3], directions.shape), directions, time)
        seen = np.isfinite(hits.distance) & (hits.distance > 0.3)
        ranges = (hits.distance + noise * rng.normal(size=len(seen)))[seen]
        n = len(ranges)
        labels = np.where(hits.ground[seen] > 0, GROUND, NON_GROUND).astype(np.uint8)
        points = (ranges[:, None] * PATTERN.directions[seen]).astype(np.float32)
        cloud = Cloud(points, labels, np.zeros(n, np.float32), PATTERN.ring[seen], np.zeros(n, np.int32))
        T_odom_imu = T.copy()
        T_odom_imu[:3, :3] = T[:3, :3] @ lie.exp(0.002 * rng.normal(size=3))
        T_odom_imu[:3, 3] += 0.5 * noise * rng.normal(size=3)
        found.append(Keyframe(index, index, int(1e9 * STEP_S) * index, T_odom_imu, np.eye(4), np.eye(6), cloud))
    return found


def found_in(keyframes: list[Keyframe], params: MovingParams = PARAMS) -> list[Mask]:
    sights = [moving.sight(one) for one in keyframes]
    looks = ([sights[place] for place in moving.around(index, len(sights))] for index in range(len(sights)))
    return [moving.find(one, others, params) for one, others in zip(keyframes, looks, strict=True)]


def on(keyframe: Keyframe, pose: Pose, within: float = 0.45) -> Mask:
    """Which points are on the person, who stands free: above the ground and near his axis."""
    T = keyframe.T_odom_imu
    points = keyframe.cloud.points @ T[:3, :3].T + T[:3, 3]
    (place,), _ = pose(np.array([STEP_S * keyframe.index]))
    beside = np.linalg.norm(points[:, :2] - place[:2], axis=1) < within
    return np.asarray(beside & (keyframe.cloud.labels == NON_GROUND) & (points[:, 2] > 0.1) & (points[:, 2] < 2.0))


def shares(keyframes: list[Keyframe], masks: list[Mask], pose: Pose) -> tuple[float, float]:
    """Of the person's points those that were found, and of all others."""
    mine = np.concatenate([on(one, pose) for one in keyframes])
    called = np.concatenate(masks)
    return float(called[mine].mean()), float(called[~mine].mean())


@pytest.mark.parametrize("upright", [False, True])
def test_a_person_who_walks_across_is_found_and_the_wall_behind_is_not(upright: bool) -> None:
    pose = at(lambda t: 8.0 + 0 * t, lambda t: -1.5 + 0.6 * t)
    scene = Raycaster(room().build(), (person(pose),))
    keyframes = walk(lambda _: scene, count=10, upright=upright)
    found, wrong = shares(keyframes, found_in(keyframes), pose)
    assert found > 0.85 and wrong < 1e-3


def test_a_person_who_walks_ahead_at_the_same_pace_is_found() -> None:
    pose = at(lambda t: 3.0 + t, lambda t: 0.3 * np.sin(t))
    scene = Raycaster(room().build(), (person(pose),))
    keyframes = walk(lambda _: scene)
    found, wrong = shares(keyframes, found_in(keyframes), pose)
    assert found > 0.9 and wrong < 1e-3


def test_someone_who_stands_still_all_the_time_stays() -> None:
    pose = at(lambda t: 8.0 + 0 * t, lambda t: 0.8 + 0 * t)
    scene = Raycaster(room().build(), (person(pose),))
    found, wrong = shares(keyframes := walk(lambda _: scene), found_in(keyframes), pose)
    assert found < 0.02 and wrong < 1e-3


def test_nothing_moves_in_an_empty_room_with_a_pole_in_it() -> None:
    scene = Raycaster(room().build())
    called = np.concatenate(found_in(walk(lambda _: scene, noise=0.02)))
    assert called.mean() < 5e-4


def test_a_door_that_is_opened_moves_only_while_it_swings() -> None:
    """Shut for five keyframes, on its way for two, then open: the leaf stood as long as others saw past it."""
    turns = dict.fromkeys(range(5), 0.0) | {5: 0.5, 6: 1.0} | dict.fromkeys(range(7, 12), 1.5)

    def doorway(turn: float) -> Raycaster:
        mesh, hinge, width = room(), np.array([10.0, -0.5]), 1.0
        for y in (-2.25, 2.25):
            mesh.box((10.0, y, 1.5), (0.1, 3.5, 3.0), 0.4)
        middle = hinge + width / 2 * np.array([np.sin(turn), np.cos(turn)])
        mesh.box((*middle, 1.0), (0.05, width, 2.0), 0.4, yaw=-turn)
        return Raycaster(mesh.build())

    scenes = {turn: doorway(turn) for turn in set(turns.values())}
    keyframes = walk(lambda t: scenes[turns[round(t / STEP_S)]], count=12)
    masks = found_in(keyframes)
    swinging, else_ = (
        np.concatenate([masks[index][keyframes[index].cloud.labels == NON_GROUND] for index in which])
        for which in ((5, 6), (*range(5), *range(7, 12)))
    )
    assert np.count_nonzero(swinging) > 60 and np.count_nonzero(else_) < 0.02 * np.count_nonzero(swinging)


def test_the_slider_asks_for_more_keyframes_that_see_through() -> None:
    pose = at(lambda t: 8.0 + 0 * t, lambda t: -1.5 + 0.6 * t)
    scene = Raycaster(room().build(), (person(pose),))
    keyframes = walk(lambda _: scene, count=6)
    counts = [sum(int(mask.sum()) for mask in found_in(keyframes, MovingParams(seen_through=k))) for k in (1, 3, 6)]
    assert counts[0] >= counts[1] > counts[2] == 0


def test_a_keyframe_alone_and_one_without_points_have_nothing_that_moves() -> None:
    scene = Raycaster(room().build())
    (one, other) = walk(lambda _: scene, count=2)
    assert not moving.find(one, [], PARAMS).any()
    empty = Cloud(*(getattr(other.cloud, name)[:0] for name in ("points", "labels", "intensity", "ring", "offsets_ns")))
    nothing = Keyframe(1, 1, 1, other.T_odom_imu, np.eye(4), np.eye(6), empty)
    assert moving.find(nothing, [moving.sight(one)], PARAMS).shape == (0,)
    assert not moving.find(one, [moving.sight(nothing)], PARAMS).any()
