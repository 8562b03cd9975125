"""The pose graph agrees with an independent solver, survives failures, and accepts factors on one pose.

Tests app/slam/loops/factors.py, app/slam/loops/solvers.py, app/slam/loops/detection.py.
"""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from app.slam import lie
from app.slam.kernels import manifold
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.factors import Factor, PositionPrior, Step, residuals
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.solvers import g2o_text, optimise
from app.slam.loops.types import LOOP_HUBER
from app.slam.types import F64


def random_pose(rng: np.random.Generator, spread: float) -> F64:
    return lie.transform(lie.exp(rng.normal(scale=spread, size=3)), rng.normal(scale=spread, size=3))


def covariance(rng: np.random.Generator, scale: float) -> F64:
    A = rng.normal(size=(6, 6))
    return scale**2 * (A @ A.T / 6 + np.eye(6))


def chain(count: int, seed: int = 0, noise: float = 0.02) -> tuple[list[Factor], list[Factor]]:
    """Odometry round a circle, measured with noise, and loops across it."""
    rng = np.random.default_rng(seed)
    step = lie.transform(lie.exp(np.array([0.0, 0.0, 2 * np.pi / count])), np.array([1.0, 0.0, 0.0]))
    truth = [np.eye(4)]
    for _ in range(count - 1):
        truth.append(truth[-1] @ step)

    def measured(i: int, j: int) -> F64:
        return lie.inverse(truth[i]) @ truth[j] @ random_pose(rng, noise)

    odometry = [Factor(k - 1, k, measured(k - 1, k), covariance(rng, 0.05)) for k in range(1, count)]
    loops = [Factor(i, j, measured(i, j), covariance(rng, 0.02)) for i, j in ((0, count - 1), (1, count // 2))]
    return odometry, loops


def graph_of(odometry: list[Factor], loops: list[Factor], window: int = 0) -> PoseGraph:
    graph = PoseGraph(np.eye(4), window)
    for factor in odometry:
        graph.do(factor)
        graph.do([loop for loop in loops if loop.second == factor.second])
    return graph


def errors(x: F64, factors: list[Factor]) -> F64:
    """Whitened errors, rotation and translation of inv(measured) inv(T_i) T_j by the SE(3) logarithm (Barfoot 2017)."""
    poses = [np.eye(4)] + [lie.transform(lie.exp(v[:3]), v[3:]) for v in x.reshape(-1, 6)]
    out = []
    for factor in factors:
        E = lie.inverse(factor.T_first_second) @ lie.inverse(poses[factor.first]) @ poses[factor.second]
        w = lie.log(E[:3, :3])
        # left Jacobian of SO(3): J(w) = Jr(-w)
        v = manifold.right_jacobian_inverse(-w) @ E[:3, 3]
        out.append(np.linalg.solve(np.linalg.cholesky(factor.covariance), np.concatenate([w, v])))
    return np.concatenate(out)


def test_the_optimum_is_that_of_an_independent_least_squares_solver() -> None:
    odometry, loops = chain(12)
    graph = graph_of(odometry, loops)
    start = np.concatenate([np.concatenate([lie.log(T[:3, :3]), T[:3, 3]]) for T in graph.poses[1:]])
    solved = least_squares(lambda x: errors(x, odometry + loops), start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    oracle = np.array([np.eye(4)] + [lie.transform(lie.exp(v[:3]), v[3:]) for v in solved.reshape(-1, 6)])
    batch = optimise(np.eye(4), odometry + loops, graph.poses)
    np.testing.assert_allclose(batch, oracle, atol=1e-6)
    np.testing.assert_allclose(graph.poses, oracle, atol=2e-3)
    assert np.abs(graph_of(odometry, []).poses - oracle).max() > 0.05, "the loops matter"


@pytest.mark.parametrize("robust", [False, True])
def test_loops_between_the_same_two_poses_are_one_factor_that_says_what_they_say_together(robust: bool) -> None:
    odometry, loops = chain(12, noise=0.01)
    rng = np.random.default_rng(1)
    again = [
        replace(
            loops[1],
            T_first_second=loops[1].T_first_second @ lie.exp_se3(rng.normal(0.0, 0.01, 6)),
            covariance=loops[1].covariance * weight,
            robust=robust,
        )
        for weight in (1.0, 0.3, 2.0, 1.0)
    ]
    graph, once = graph_of(odometry, []), graph_of(odometry, [])
    for closing in (again[:1], loops[:1], again[1:3], again[3:]):
        graph.do(closing)
    once.do([loops[0], again[0]])
    all_at_once = optimise(np.eye(4), [*odometry, loops[0], *again], graph.poses)
    np.testing.assert_allclose(graph.poses, all_at_once, atol=1e-3)
    assert np.abs(once.poses - all_at_once).max() > 5e-3, "that there are more is felt"
    assert held(graph) == held(once)


def test_against_odometry_they_pull_as_far_as_each_would_alone() -> None:
    step = lie.transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    odometry = [Factor(k, k + 1, step, np.eye(6) * 0.05**2) for k in range(5)]
    aside = lie.transform(np.eye(3), np.array([5.0, 3.0, 0.0]))
    graph = graph_of(odometry, [])
    for _ in range(4):
        graph.do([Factor(0, 5, aside, np.eye(6) * 0.1**2, robust=True)])
    loops = [Factor(0, 5, aside, np.eye(6) * 0.1**2, robust=True)] * 4
    apart = optimise(np.eye(4), odometry + loops, graph.poses)
    assert 0.2 < apart[5, 1, 3] < 2.8, "neither has its way"
    assert graph.poses[5, 1, 3] == pytest.approx(apart[5, 1, 3], rel=0.1)


def held(graph: PoseGraph) -> int:
    """Factors that the solver has."""
    factors = graph._solver._isam.getFactorsUnsafe()  # type: ignore[union-attr]
    return sum(factors.at(k) is not None for k in range(factors.size()))


def test_a_factors_error_is_what_it_says() -> None:
    odometry, loops = chain(6)
    poses = graph_of(odometry, loops).poses
    x = np.concatenate([np.concatenate([lie.log(T[:3, :3]), T[:3, 3]]) for T in poses[1:]])
    for factor, residual in zip(odometry + loops, residuals(odometry + loops, poses), strict=True):
        assert residual.sigmas == pytest.approx(np.linalg.norm(errors(x, [factor])), rel=1e-6)


def test_doing_it_again_gives_the_same_poses_to_the_last_bit() -> None:
    odometry, loops = chain(40)
    graph = graph_of(odometry, loops)
    again = PoseGraph(np.eye(4))
    again.follow(graph.steps)
    np.testing.assert_array_equal(graph.poses, again.poses)
    again.poses  # noqa: B018 - looking must not change what comes
    for g in (graph, again):
        g.do([Factor(5, 30, np.eye(4), np.eye(6) * 0.1, robust=True)])
    np.testing.assert_array_equal(graph.poses, again.poses)


def test_odometry_alone_moves_no_pose_that_is_there() -> None:
    odometry, loops = chain(40)
    graph = graph_of(odometry[:20], [Factor(0, 15, odometry[0].T_first_second, np.eye(6) * 0.1)])
    before = graph.poses
    for factor in odometry[20:]:
        graph.do(factor)
    np.testing.assert_array_equal(graph.poses[: len(before)], before)
    T = before[-1]
    for factor, pose in zip(odometry[20:], graph.poses[len(before) :], strict=True):
        T = T @ factor.T_first_second
        np.testing.assert_allclose(pose, T, atol=1e-12)
    graph.do(loops)
    assert np.abs(graph.poses[: len(before)] - before).max() > 0.01
    assert len(before) == 21, "what was seen stays as it was"


def straight(count: int, sigma: float) -> list[Factor]:
    step = lie.transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    return [Factor(k - 1, k, step, np.eye(6) * sigma**2) for k in range(1, count)]


def along(x: float) -> F64:
    return lie.transform(np.eye(3), np.array([x, 0.0, 0.0]))


def test_a_robust_loop_pulls_with_bounded_force() -> None:
    def last(x: float, robust: bool = True) -> float:
        graph = graph_of(straight(11, 0.1), [Factor(0, 10, along(x), np.eye(6) * 0.05**2, robust=robust)])
        return float(graph.poses[10, 0, 3])

    # the chain is a spring of variance 10 x 0.1^2, the loop one of 0.05^2; far off, a constant force LOOP_HUBER / sigma
    assert last(10.3) == pytest.approx(10 + 0.3 * 0.1 / (0.1 + 0.0025), abs=1e-3)
    assert last(30.0) == pytest.approx(10 + 10 * 0.1**2 * LOOP_HUBER / 0.05, abs=0.02)
    assert last(30.0, robust=False) > 29.0, "without the loss it would follow"


@pytest.mark.parametrize("window", [0, 8])
@pytest.mark.parametrize("broken", ["covariance", "measurement", "key"])
def test_a_loop_that_breaks_the_solver_is_left_out_and_the_rest_goes_on(broken: str, window: int) -> None:
    odometry, loops = chain(20)
    bad = {
        "covariance": Factor(14, 18, np.eye(4), np.full((6, 6), np.nan), robust=True),
        "measurement": Factor(14, 18, np.full((4, 4), np.nan), np.eye(6), robust=True),
        "key": Factor(14, 99, np.eye(4), np.eye(6), robust=True),
    }[broken]
    graph, clean = graph_of(odometry[:18], loops, window), graph_of(odometry[:18], loops, window)
    good = Factor(13, 18, lie.inverse(clean.poses[13]) @ clean.poses[18], np.eye(6) * 0.01, robust=True)
    assert graph.do([good, bad]) == (bad,)
    assert clean.do([good]) == ()
    for factor in odometry[18:]:
        assert graph.do(factor) == clean.do(factor) == ()
    np.testing.assert_array_equal(graph.poses, clean.poses)


def test_a_step_that_breaks_the_solver_leaves_a_pose_all_the_same() -> None:
    odometry, _ = chain(10)
    graph = graph_of(odometry[:5], [])
    bad = Factor(5, 6, odometry[5].T_first_second, np.zeros((6, 6)) * np.nan)
    assert graph.do(bad) == (bad,)
    assert graph.do(odometry[6]) == ()
    assert len(graph) == len(graph.poses) == 8
    assert np.isfinite(graph.poses).all()


def test_a_window_leaves_old_poses_where_they_are_and_solves_for_the_new_ones() -> None:
    odometry, _ = chain(30)
    graph = graph_of(odometry, [], window=10)
    before = graph.poses
    off = lie.inverse(before[2]) @ before[29] @ along(0.5)
    graph.do([Factor(2, 29, off, np.eye(6) * 0.01**2, robust=True)])
    moved = np.linalg.norm((graph.poses - before)[:, :3, 3], axis=1)
    assert (moved[:20] == 0).all()
    assert moved[29] > 0.1


def test_a_window_wider_than_the_walk_is_no_window() -> None:
    odometry, loops = chain(20)
    wide, whole = graph_of(odometry, loops, window=50).poses, graph_of(odometry, loops).poses
    assert np.abs(whole - graph_of(odometry, []).poses).max() > 0.4
    np.testing.assert_allclose(wide, whole, atol=0.01)  # a stretch of odometry is linearised where it was measured


@pytest.mark.parametrize("count", [20, 200])
def test_leaving_out_poses_that_no_loop_ties_changes_next_to_nothing(count: int) -> None:
    odometry, loops = chain(count, noise=0.005)
    graph = graph_of(odometry, loops)
    for first in (count // 4, count // 3):  # splits a stretch, and ends at one that is tied from then on
        T = lie.inverse(graph.poses[first]) @ graph.poses[-2] @ random_pose(np.random.default_rng(first), 0.003)
        graph.do([Factor(first, count - 2, T, np.eye(6) * 0.01**2)])
    factors = odometry + [loop for step in graph.steps if isinstance(step, tuple) for loop in step]

    def cost(poses: F64) -> float:
        return sum(residual.sigmas**2 for residual in residuals(factors, poses))

    best = optimise(np.eye(4), factors, graph.poses)
    moved = np.abs(best - graph_of(odometry, []).poses).max()
    assert np.abs(graph.poses - best).max() < 0.01 * moved
    assert cost(graph.poses) - cost(best) < 0.01, "a hundredth of what one measurement that is off by its sigma adds"


def test_the_g2o_file_holds_the_poses_and_factors(tmp_path: Path) -> None:
    odometry, loops = chain(8)
    poses = graph_of(odometry, loops).poses
    (tmp_path / "graph.g2o").write_text(
        g2o_text(poses, [*odometry, Factor(0, 5, along(3.0), np.eye(6) * 0.04, robust=True)])
    )
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert (values.size(), graph.size()) == (8, 8)
    np.testing.assert_allclose([values.atPose3(k).matrix() for k in range(8)], poses, atol=1e-5)
    last = graph.at(7)
    np.testing.assert_allclose(last.measured().matrix(), along(3.0), atol=1e-5)
    np.testing.assert_allclose(last.noiseModel().covariance(), np.eye(6) * 0.04, rtol=1e-4)


def test_the_parking_garage_fed_pose_by_pose_ends_at_the_batch_optimum(shared_data: Path) -> None:
    read, values = gtsam.readG2o(str(shared_data / "pose_graphs" / "parking-garage.g2o"), True)
    count = 500
    odometry: dict[int, Factor] = {}
    loops: list[Factor] = []
    for k in range(read.size()):
        factor = read.at(k)
        i, j = factor.keys()
        if max(i, j) >= count:
            continue
        T, noise = factor.measured(), factor.noiseModel().covariance()
        if i > j:
            adjoint = T.AdjointMap()
            i, j, T, noise = j, i, T.inverse(), adjoint @ noise @ adjoint.T
        ours = Factor(i, j, T.matrix(), noise)
        if j == i + 1 and j not in odometry:
            odometry[j] = ours
        else:
            loops.append(ours)
    first = values.atPose3(0).matrix()
    graph = PoseGraph(first)
    for j in range(1, count):
        assert graph.do(odometry[j]) == graph.do([loop for loop in loops if loop.second == j]) == ()
    factors = [*odometry.values(), *loops]
    batch = optimise(first, factors, [values.atPose3(k).matrix() for k in range(count)])

    def cost(poses: F64) -> float:
        return sum(residual.sigmas**2 for residual in residuals(factors, poses))

    assert cost(graph.poses) == pytest.approx(cost(batch), rel=1e-3)
    assert cost(graph_of(list(odometry.values()), []).poses) > 10 * cost(batch)


def test_positions_of_single_poses_move_the_trajectory_as_an_independent_solver_does() -> None:
    """Odometry along a circle that is 10 % too long, and GNSS-like positions of every fourth pose."""
    odometry, _ = chain(24, noise=0.002)
    longer = [replace(f, T_first_second=f.T_first_second @ along(0.1)) for f in odometry]
    truth, alone = graph_of(odometry, []).poses, graph_of(longer, []).poses
    rng = np.random.default_rng(0)
    noise = np.diag([0.02, 0.02, 0.04]) ** 2
    priors = [
        PositionPrior(KeyframeId(0, k), truth[k, :3, 3] + rng.multivariate_normal(np.zeros(3), noise), noise)
        for k in range(0, 24, 4)
    ]
    graph = graph_of(longer, [])
    for prior in priors:
        assert graph.do([prior]) == ()

    def whitened(x: F64) -> F64:
        positions = np.concatenate([np.zeros(3), x.reshape(-1, 6)[:, 3:].ravel()]).reshape(-1, 3)
        off = [(positions[p.keyframe] - p.p_map_imu) / np.sqrt(np.diag(p.covariance)) for p in priors]
        return np.concatenate([errors(x, longer), *off])

    start = np.concatenate([np.concatenate([lie.log(T[:3, :3]), T[:3, 3]]) for T in alone[1:]])
    solved = least_squares(whitened, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    oracle = np.array([np.eye(4)] + [lie.transform(lie.exp(v[:3]), v[3:]) for v in solved.reshape(-1, 6)])
    np.testing.assert_allclose(optimise(np.eye(4), [*longer, *priors], alone), oracle, atol=1e-5)
    moved = np.abs(oracle - alone).max()
    assert moved > 0.1
    assert np.abs(graph.poses - oracle).max() < 0.05 * moved
    error, error_alone = (np.linalg.norm((poses - truth)[:, :3, 3], axis=1).mean() for poses in (oracle, alone))
    assert error < 0.5 * error_alone


@pytest.mark.parametrize("window", [0, 8])
def test_a_position_that_breaks_the_solver_or_has_no_pose_is_left_out(window: int) -> None:
    odometry, _ = chain(20)
    graph = graph_of(odometry, [], window)
    before = graph.poses
    good = PositionPrior(KeyframeId(0, 18), before[18, :3, 3] + 0.1, np.eye(3) * 0.01)
    bad = PositionPrior(KeyframeId(0, 18), np.full(3, np.nan), np.eye(3))
    missing = PositionPrior(KeyframeId(0, 20), np.zeros(3), np.eye(3))
    assert set(map(id, graph.do([good, bad, missing]))) >= {id(bad)}
    assert np.isfinite(graph.poses).all()
    assert np.linalg.norm(graph.poses[18, :3, 3] - before[18, :3, 3]) > 0.01


def test_steps_say_what_was_done() -> None:
    odometry, (across, short) = chain(8)
    last = (across, replace(short, loop=(0, 5)), replace(short, robust=False))
    given: list[Step] = [*odometry[:4], (short,), *odometry[4:], last]
    graph, again = PoseGraph(np.eye(4)), PoseGraph(np.eye(4))
    for step in given:
        assert graph.do(step) == ()
    assert graph.do([]) == ()
    assert again.follow(graph.steps) == ()
    for steps in (graph.steps, again.steps):
        assert [isinstance(step, Factor) for step in steps] == [isinstance(step, Factor) for step in given]
        assert list(map(numbers, steps)) == list(map(numbers, given))


def numbers(step: Step) -> list[object]:
    """All that factors say, to compare with ==, to the last bit."""
    return [
        (one.first, one.second, one.robust, one.loop, one.T_first_second.tobytes(), one.covariance.tobytes())
        for one in ((step,) if isinstance(step, Factor) else step)
    ]


def test_steps_that_go_on_from_those_before_are_added_and_others_done_from_the_start() -> None:
    odometry, loops = chain(20)
    bad = (Factor(3, 9, np.full((4, 4), np.nan), np.eye(6), robust=True),)
    steps: list[Step] = [*odometry[:15], tuple(loops[1:]), bad, *odometry[15:], tuple(loops[:1])]
    graph = PoseGraph(np.eye(4))
    for count in (5, 16, 18, len(steps), 10, len(steps)):
        once = PoseGraph(np.eye(4))
        assert graph.follow(steps[:count]) == once.follow(steps[:count]) == (bad if count > 16 else ())
        np.testing.assert_array_equal(graph.poses, once.poses)
    other = [*steps[:15], *steps[17:]]
    graph.follow(other)
    assert np.abs(graph.poses - once.poses).max() > 1e-3
    graph.follow(steps)
    np.testing.assert_array_equal(graph.poses, once.poses)
