"""The simulated RS-Bpearl's firings, ranges, labels and moving bodies.

Tests app/sensors/robosense.py, app/sensors/simulator/lidar.py, app/sensors/simulator/mesh.py,
app/sensors/simulator/raycast.py, app/sensors/simulator/scenes/cloister.py, app/sensors/simulator/scenes/museum.py,
app/sensors/simulator/scenes/offices.py, app/sensors/simulator/scenes/outdoors.py,
app/sensors/simulator/scenes/props.py, app/sensors/simulator/scenes/rooms.py.
"""

import numpy as np
import pytest

from app.sensors.live.difop import ChannelAngles
from app.sensors.robosense import BPEARL, BPV4
from app.sensors.simulator.lidar import P_IMU_LIDAR, Lidar, Pattern, firing_pattern
from app.sensors.simulator.mesh import Mesh, MeshBuilder
from app.sensors.simulator.raycast import Mover, Raycaster
from app.sensors.simulator.scenes import SCENES, build_scene
from app.sensors.simulator.scenes.props import pedestrian, rectangle
from app.sensors.simulator.trajectory import R_BODY_IMU, SmoothTrajectory, Walker, seconds, walk
from app.slam.errors import HemislamError
from app.slam.types import F64, I64, Scan

EPOCH_NS = 1_700_000_000_000_000_000
COARSE = firing_pattern(every_block=12)


def still(yaw: float = 0.0) -> SmoothTrajectory:
    """The IMU at (0, 0, 1.25), looking along +x turned by yaw."""
    t = np.linspace(-1.0, 2.0, 31)
    return SmoothTrajectory(t, np.tile([0.0, 0.0, 1.25, yaw, 0.0, 0.0], (31, 1)))


def hurried() -> SmoothTrajectory:
    """2 m/s forward, 1.5 rad/s of yaw, nodding."""
    t = np.linspace(-1.0, 2.0, 151)
    zero = np.zeros_like(t)
    return SmoothTrajectory(
        t, np.column_stack([2 * t, zero, 1.25 + zero, 1.5 * t, 0.2 * np.sin(6 * t), 0.1 * np.cos(5 * t)])
    )


def wall_at(x: float, reflectivity: float = 0.6) -> Mesh:
    mesh = MeshBuilder()
    mesh.quad([(x, -200, -200), (x, 200, -200), (x, 200, 200), (x, -200, 200)], reflectivity)
    return mesh.build()


def fire(
    lidar: Lidar, mesh: Mesh, trajectory: SmoothTrajectory, *movers: Mover, seed: int = 0, pattern: Pattern = COARSE
) -> Scan:
    return lidar.turn(pattern, Raycaster(mesh, movers), trajectory, 0.05, EPOCH_NS, np.random.default_rng(seed))


def stamps(scan: Scan) -> I64:
    """(n,) absolute ns of each point."""
    return scan.stamp_ns + scan.offsets_ns.astype(np.int64)


def in_world(returns: Scan, trajectory: SmoothTrajectory, stamps_ns: np.ndarray | None = None) -> F64:
    """Points by the true pose at `stamps_ns`, by default each point's own."""
    positions, rotations = trajectory.poses(seconds((stamps(returns) if stamps_ns is None else stamps_ns) - EPOCH_NS))
    return positions + np.einsum("nij,nj->ni", rotations, returns.points + P_IMU_LIDAR)


def test_a_turn_has_57632_firings_at_10_hz_and_half_as_many_at_20() -> None:
    assert len(firing_pattern(rate_hz=10).offsets_ns) == 57_632
    assert len(firing_pattern(rate_hz=20).offsets_ns) == 900 * 32
    assert len(firing_pattern(every_block=6).offsets_ns) == 301 * 32


def test_firing_times_are_the_vendors() -> None:
    pattern = firing_pattern()
    assert pattern.offsets_ns[[0, 1, 8, 15, 16, 31]].tolist() == [0, 2_560, 25_680, 43_600, 1_280, 44_880]
    assert pattern.offsets_ns[32] == 55_520
    assert pattern.offsets_ns.max() == 1800 * 55_520 + 44_880
    newer = firing_pattern(BPV4).offsets_ns
    assert newer[[0, 1, 31, 32]].tolist() == [0, 1_668, 51_708, 55_560]


def test_rings_rank_the_elevations_from_the_base_plane_up() -> None:
    rings = ChannelAngles.nominal(BPEARL).rings
    assert rings[0] == 31 and rings[31] == 0 and rings[15] == 16
    pattern = firing_pattern(every_block=50)
    elevation = np.degrees(np.arcsin(pattern.directions[:, 2]))
    lowest, highest = elevation[pattern.ring == 0], elevation[pattern.ring == 31]
    assert np.allclose(lowest, 2.3125) and np.allclose(highest, 89.5)
    by_ring = [elevation[pattern.ring == ring].mean() for ring in range(32)]
    np.testing.assert_allclose(np.diff(by_ring)[:30], 2.8125, atol=1e-6)


def test_the_azimuth_turns_from_x_towards_minus_y_while_a_block_fires() -> None:
    pattern = firing_pattern()
    azimuth = np.degrees(np.arctan2(-pattern.directions[:, 1], pattern.directions[:, 0])) % 360
    np.testing.assert_allclose(azimuth[450 * 32], 450 * 0.05552 * 3.6, atol=1e-9)
    np.testing.assert_allclose(azimuth[31] - azimuth[0], 0.04488 * 3.6, atol=1e-9)
    levers = pattern.levers.reshape(-1, 32, 3)
    assert (levers == levers[:, :1]).all(), "the lever turns with the block, not with the firing"
    np.testing.assert_allclose(levers[0, 0], [BPEARL.rx, 0.0, BPEARL.rz])


@pytest.mark.parametrize("step", [0.005, 0.0025])
def test_a_wall_is_measured_where_it_stands_to_half_a_step(step: float) -> None:
    trajectory = still(yaw=0.3)
    returns = fire(Lidar(range_noise=0.0, range_step=step, lossless=True), wall_at(5.0), trajectory)
    beam = np.einsum("nij,nj->ni", trajectory.poses(seconds(COARSE.offsets_ns))[1], COARSE.directions)
    hits = 5.0 / np.maximum(beam[:, 0], 1e-9) < 99.0  # every beam that points at it returns
    assert abs(len(returns.points) - hits.sum()) < 0.01 * hits.sum()
    assert np.abs(in_world(returns, trajectory)[:, 0] - 5.0).max() < step / 2 + 1e-4


def test_range_noise_has_the_spread_asked_for() -> None:
    trajectory = still()
    returns = fire(Lidar(range_noise=0.02, range_step=0.0, lossless=True), wall_at(5.0), trajectory)
    off = in_world(returns, trajectory)[:, 0] - 5.0
    beam = returns.points - [0, 0, BPEARL.rz]
    along = off / (beam[:, 2] / np.linalg.norm(beam, axis=1))
    assert abs(along.std() - 0.02) < 0.001
    assert abs(along.mean()) < 0.001


@pytest.mark.parametrize("rate_hz", [10, 20])
def test_points_of_a_hurried_turn_lie_on_the_wall_by_their_own_poses_only(rate_hz: int) -> None:
    lidar, pattern = Lidar(range_noise=0.0, lossless=True), firing_pattern(rate_hz=rate_hz, every_block=12)
    trajectory = hurried()
    returns = fire(lidar, wall_at(5.0), trajectory, pattern=pattern)
    assert len(returns.points) > 1000
    assert np.abs(in_world(returns, trajectory)[:, 0] - 5.0).max() < 0.003
    end = np.full(len(returns.points), returns.end_ns)
    assert np.abs(in_world(returns, trajectory, end)[:, 0] - 5.0).max() > 0.1


def test_far_dark_and_grazing_surfaces_return_less() -> None:
    lidar = Lidar()
    near = len(fire(lidar, wall_at(5.0, 0.5), still()).points)
    far = len(fire(lidar, wall_at(60.0, 0.5), still()).points)
    dark = len(fire(lidar, wall_at(5.0, 0.01), still()).points)
    assert far < 0.8 * near and dark < 0.8 * near
    ahead = fire(lidar, wall_at(29.0, 0.1), still()).points
    assert ahead[:, 2].min() > 25.0 and len(ahead) > 20, "30 m on a target of 10 %"
    assert not len(fire(lidar, wall_at(45.0, 0.1), still()).points) > 0.02 * len(COARSE.offsets_ns)


def test_brighter_materials_look_brighter() -> None:
    lidar = Lidar()
    dim, bright = (fire(lidar, wall_at(4.0, r), still()).intensity for r in (0.2, 0.8))
    assert np.median(bright) > 3 * np.median(dim)
    assert bright.max() <= 255 and (bright == np.rint(bright)).all()


def test_a_moving_plate_is_hit_where_it_is_at_each_firing() -> None:
    plate = MeshBuilder()
    plate.quad([(0, -9, -9), (0, 9, -9), (0, 9, 9), (0, -9, 9)], 0.6)

    def pose(t: F64) -> tuple[F64, F64]:
        zero = np.zeros_like(t)
        return np.column_stack([5.0 - 8.0 * t, zero, zero]), zero

    trajectory = still()
    returns = fire(Lidar(range_noise=0.0, lossless=True), wall_at(70.0, 1e-4), trajectory, Mover(plate.build(), pose))
    x = in_world(returns, trajectory)[:, 0]
    struck = x < 6.0
    assert struck.sum() > 1000
    expected = 5.0 - 8.0 * seconds(stamps(returns)[struck] - EPOCH_NS)
    assert np.ptp(expected) > 0.7
    assert np.abs(x[struck] - expected).max() < 0.003


def test_a_person_who_walks_is_seen_to_walk() -> None:
    someone = pedestrian(rectangle(2.0, -30.0, 4.0, 30.0), speed=1.4, start=30.0)
    caster = Raycaster(wall_at(200.0), (someone,))
    lidar, pattern, trajectory = Lidar(), firing_pattern(every_block=2), still()
    middles = []
    for start_s in (0.0, 1.0):
        returns = lidar.turn(pattern, caster, trajectory, start_s, EPOCH_NS, np.random.default_rng(0))
        seen = in_world(returns, trajectory)
        assert len(seen) > 30
        assert seen[:, 2].min() > -0.1 and seen[:, 2].max() < 1.8
        middles.append(seen.mean(axis=0))
    moved = middles[1] - middles[0]
    assert abs(moved[1] - 1.4) < 0.15 and abs(moved[0]) < 0.15


def test_the_floor_is_labelled_ground_and_nothing_else_is() -> None:
    scene = build_scene("room", seed=2)
    trajectory = walk(scene.path, 4.0, np.random.default_rng(0), walker=Walker())
    lidar = Lidar(range_noise=0.0)
    caster = Raycaster(scene.mesh, scene.movers)
    returns = lidar.turn(COARSE, caster, trajectory, 3.0, EPOCH_NS, np.random.default_rng(0))
    z = in_world(returns, trajectory)[:, 2]
    ground = returns.truth_ground == 1
    assert 0.1 < ground.mean() < 0.6
    assert np.abs(z[ground]).max() < 0.01
    assert (z[~ground] > -0.01).all() and np.quantile(z[~ground], 0.05) > 0.03
    assert not ground[z > 2.7].any(), "the ceiling is not ground"


@pytest.mark.parametrize("name", SCENES)
def test_scenes_can_be_walked_without_running_into_things(name: str) -> None:
    scene = build_scene(name, seed=1)
    length = np.linalg.norm(np.diff(np.vstack([scene.path, scene.path[:1]]), axis=0), axis=1).sum()
    lap_s = length / Walker().speed + 4.0
    trajectory = walk(
        scene.path, lap_s, np.random.default_rng(1), walker=Walker(), closed=scene.closed, height=scene.height
    )
    t = np.arange(0.0, lap_s, 0.4)
    positions, rotations = trajectory.poses(t)
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    level = np.column_stack([np.cos(around), np.sin(around), np.zeros(24)])
    origins, directions = np.repeat(positions, 24, axis=0), np.tile(level, (len(t), 1))
    clear = Raycaster(scene.mesh).cast(origins, directions, np.repeat(t, 24)).distance
    assert clear.min() > 0.4

    down = Raycaster(scene.mesh).cast(positions, np.tile([0.0, 0.0, -1.0], (len(t), 1)), t)
    assert (down.ground == 1).all()
    assert np.abs(down.distance - Walker().height).max() < 0.15
    assert rotations[:, 2, 2].max() < 0.5, "it looks forward, not up"


def test_the_same_seed_builds_the_same_scene_and_another_seed_another() -> None:
    first, again, other = (build_scene("corridor", seed).mesh for seed in (1, 1, 2))
    assert np.array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)


def test_an_unknown_scene_is_named_with_what_there_is() -> None:
    with pytest.raises(HemislamError, match="no scene `corridr`; did you mean `corridor`"):
        build_scene("corridr", 0)


def test_an_open3d_that_cannot_be_loaded_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "open3d.core", None)
    with pytest.raises(HemislamError, match=r"libusb-1.0-0 libegl1 libgl1"):
        Raycaster(wall_at(1.0))


def test_the_lidar_looks_where_the_body_walks() -> None:
    np.testing.assert_array_equal(R_BODY_IMU @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_array_equal(R_BODY_IMU @ [1, 0, 0], [0, 0, -1])
    assert np.linalg.det(R_BODY_IMU) == 1.0
