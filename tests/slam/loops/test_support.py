"""Of many loops at one place: which tie poses of their own, which repeat another loop, which are only represented."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.backend import LoopBackend
from app.slam.loops.drift import Drift
from app.slam.loops.edits import Add, Reject, SetWeight, apply_edits
from app.slam.loops.factors import Factor, loop_factors
from app.slam.loops.solvers import optimise
from app.slam.loops.support import settle, sparsified, transported
from app.slam.loops.types import Evidence, LoopEdge, Origin, Verdict
from app.slam.loops.verdicts import FLOOR_M, FLOOR_YAW
from app.slam.sections import LoopsParams
from app.slam.types import F64
from tests.slam.loops.conftest import Walked, accepted

HALF, TURN = 8, 60


def there_and_back() -> F64:
    """(2 * TURN, 4, 4): a keyframe a metre along a line, and back along it."""
    poses = np.tile(np.eye(4), (2 * TURN, 1, 1))
    poses[:TURN, 0, 3] = np.arange(TURN)
    poses[TURN:, 0, 3] = np.arange(TURN)[::-1]
    poses[TURN:, :2, :2] = -np.eye(2)
    return poses


POSES = there_and_back()
PIECES = np.zeros(2 * len(POSES), np.int64)


def loop(older: int, off: F64 | None = None) -> LoopEdge:
    """Where the way back comes by a keyframe; off: (3,) m, by how much it was measured wrong."""
    newer = 2 * TURN - 1 - older
    T = lie.inverse(POSES[older]) @ POSES[newer]
    T[:3, 3] += np.zeros(3) if off is None else off
    covariance = np.diag([FLOOR_YAW**2] * 3 + [FLOOR_M**2] * 3)
    return LoopEdge(older, newer, newer, T, covariance, Evidence(), Verdict.ACCEPTED, "")


def come(loops: list[LoopEdge], poses: F64 = POSES, in_map: F64 | None = None) -> dict[int, LoopEdge]:
    """One after the other, by their older ends."""
    edges: dict[int, LoopEdge] = {}
    for edge in loops:
        (edges[edge.older],) = sparsified(
            [edge], edges.values(), poses, poses if in_map is None else in_map, PIECES, HALF
        )
    return edges


def test_of_loops_along_a_way_one_in_a_quarter_of_a_submap_counts_and_one_in_a_whole_one_ties_poses() -> None:
    """Unless the graph knows by the first of them how the way back lies."""
    apart_in_map = POSES.copy()
    apart_in_map[TURN:, 1, 3] = 0.5
    loops = [loop(older) for older in range(50, 0, -1)]
    assert [older for older, edge in come(loops).items() if edge.counts and not edge.repeats] == [50, 50 - 4 * HALF - 1]
    edges = come(loops, in_map=apart_in_map)
    apart = HALF // 2 + 1
    together = 2 * HALF // apart + 1
    for older, edge in edges.items():
        place, beyond = divmod(50 - older, apart)
        if beyond:
            assert edge.represented_by == loop(older + beyond).pair
        else:
            assert edge.counts
            first = place % together
            assert edge.repeats == (loop(older + first * apart).pair if first else None)


@pytest.mark.parametrize(
    ("off_m", "on", "told"),
    [
        (0.5 * FLOOR_M, 2 * HALF, True),
        (2 * FLOOR_M, 2 * HALF, True),
        (3 * FLOOR_M, 2 * HALF, False),
        (0.5 * FLOOR_M, 2 * HALF + 1, True),
        (2 * FLOOR_M, 2 * HALF + 1, False),
        (0.5 * FLOOR_M, 4 * HALF + 1, False),
    ],
)
def test_to_another_time_at_a_place_a_loop_counts_if_it_is_news_or_the_last_is_long_ago(
    off_m: float, on: int, told: bool
) -> None:
    third = np.concatenate([POSES, POSES])
    first = replace(loop(30), older=30, newer=2 * TURN + 30)
    older, newer = 2 * TURN - 1 - 31, 2 * TURN + 30 + on
    T = lie.inverse(third[older]) @ third[newer]
    T[1, 3] += off_m
    second = replace(first, older=older, newer=newer, T_older_newer=T)
    (edge,) = sparsified([second], [first], third, third, PIECES, HALF)
    assert edge.counts is not told and edge.represented_by == (first.pair if told else None)


@pytest.mark.parametrize(("off_m", "same"), [(0.05, True), (0.3, False)])
def test_what_measured_another_thing_ties_poses_of_its_own(off_m: float, same: bool) -> None:
    edges = come([loop(40), loop(34, np.array([0.0, off_m, 0.0]))])
    assert edges[34].counts and edges[34].repeats == (loop(40).pair if same else None)


def test_a_loop_laid_on_other_keyframes_errs_there_by_what_its_error_becomes() -> None:
    rng = np.random.default_rng(3)
    poses = lie.exp_se3(rng.normal(0.0, 1.0, (8, 6)))
    half = rng.normal(0.0, 0.1, (6, 6))
    ends = {"older": 1, "newer": 6, "decided_at": 6}
    edge = replace(loop(40), **ends, T_older_newer=lie.exp_se3(rng.normal(0.0, 1.0, 6)), covariance=half @ half.T)
    (T,), (covariance,) = transported([edge], replace(edge, older=0, newer=7), poses)
    errors = 1e-6 * np.linalg.cholesky(edge.covariance).T  # their squares add up to the covariance
    there = []
    for error in errors:
        off = replace(edge, T_older_newer=edge.T_older_newer @ lie.exp_se3(error))
        there.append(lie.log_se3(lie.inverse(T) @ transported([off], replace(off, older=0, newer=7), poses)[0][0]))
    np.testing.assert_allclose(1e12 * np.transpose(there) @ there, covariance, atol=1e-3 * np.abs(covariance).max())
    own = lie.inverse(poses[0]) @ poses[1] @ edge.T_older_newer @ lie.inverse(poses[6]) @ poses[7]
    np.testing.assert_allclose(T, own, atol=1e-12)


def test_whether_two_measured_the_same_does_not_depend_on_where_the_walk_lies() -> None:
    moved = lie.transform(lie.exp(np.array([0.3, -0.2, 2.0])), np.array([50.0, -20.0, 7.0])) @ POSES
    loops = [loop(older, np.array([0.0, off, 0.0])) for older, off in ((40, 0.0), (34, 0.12), (28, 0.17), (22, 0.3))]
    assert [edge.repeats for edge in come(loops).values()] == [edge.repeats for edge in come(loops, moved).values()]


def test_repeated_loops_hold_two_ways_together_nearly_as_well_as_each_alone() -> None:
    """Odometry errs at random on the way there and back, loops by what their submaps' keyframes err by on average: how
    far apart the two ways come to lie."""
    sigmas = np.array([np.radians(0.1)] * 3 + [0.01] * 3)
    apart: dict[str, list[float]] = {"each": [], "repeated": [], "alone": [], "none": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        steps, odometry = [], [POSES[0]]
        for k, (before, after) in enumerate(pairwise(POSES)):
            T = lie.inverse(before) @ after @ lie.exp_se3(rng.normal(0.0, sigmas))
            steps.append(Factor(k, k + 1, T, np.diag(sigmas**2)))
            odometry.append(odometry[-1] @ T)
        each_errs = rng.normal(0.0, 0.02 * np.sqrt(2 * HALF + 1), (TURN + 2 * HALF, 3))
        errs = {older: each_errs[older : older + 2 * HALF + 1].mean(axis=0) for older in range(50, 0, -HALF // 2 - 1)}
        found = come([loop(older, off) for older, off in errs.items()], np.array(odometry))
        edges = {edge.pair: edge for edge in found.values()}
        chosen = {
            "each": [replace(edge, repeats=None) for edge in edges.values()],
            "repeated": list(edges.values()),
            "alone": [edge for edge in edges.values() if edge.repeats is None],
            "none": [],
        }
        factors = {name: loop_factors(some, edges, np.array(odometry), window=0) for name, some in chosen.items()}
        assert len(factors["repeated"]) == len(factors["each"]) > 2 * len(factors["alone"])
        for name, loops in factors.items():
            poses = optimise(POSES[0], steps + loops, np.array(odometry))
            apart[name].append(float(np.mean((poses[:TURN, :3, 3] - poses[TURN:, :3, 3][::-1]) ** 2)))
    each, repeated, alone, none = (float(np.sqrt(np.mean(squares))) for squares in apart.values())
    assert each < 0.15 * none
    assert repeated < 1.25 * each and repeated < 0.9 * alone


def test_rejecting_what_others_repeat_has_them_tie_poses_of_their_own(walked: Walked, backend: LoopBackend) -> None:
    loops = accepted(backend)
    counting = [edge for edge in loops if edge.counts]
    assert 3 * sum(edge.repeats is None for edge in counting) < 2 * len(counting)
    first = next(edge.repeats for edge in counting if edge.repeats)
    repeating = {edge.pair for edge in counting if edge.repeats == first}
    assert ties(backend).count(first) == 1 + len(repeating)
    before = backend.poses
    backend.apply(Reject(*first))
    assert first not in ties(backend) and repeating <= set(ties(backend))
    backend.load(backend.edits.undo())
    np.testing.assert_array_equal(backend.poses, before)
    backend.apply(SetWeight(*max(repeating), 1.0))
    assert ties(backend).count(first) == len(repeating), "what the user has a word on ties poses of its own"
    assert ties(backend).count(max(repeating)) == 1


def ties(backend: LoopBackend) -> list[tuple[int, int]]:
    """Between which keyframes the graph has factors beyond odometry, as its file tells."""
    lines = (line.split() for line in backend.g2o().splitlines() if line.startswith("EDGE"))
    pairs = [(int(line[1]), int(line[2])) for line in lines]
    return [pair for pair in pairs if pair[1] > pair[0] + 1]


def test_no_loop_is_laid_on_one_that_the_user_made() -> None:
    made = replace(loop(40), origin=Origin.USER, edited=True)
    elsewhere = POSES.copy()
    elsewhere[TURN:, 1, 3] = 0.5
    (edge,) = sparsified([loop(34)], [made], POSES, elsewhere, PIECES, HALF)
    assert edge.counts and edge.repeats is None


def test_what_was_found_beside_a_loop_by_hand_counts_alone_once_that_is_undone() -> None:
    """Also if nothing else is in force, and whether it repeated the loop or was represented by it."""
    made = replace(loop(40), origin=Origin.USER, edited=True)
    beside = [replace(loop(38), represented_by=made.pair), replace(loop(34), repeats=made.pair)]
    found = {edge.pair: edge for edge in beside}
    add = Add(*made.pair)
    edited = apply_edits(found, [add], {add: made})
    assert edited[made.pair] is made
    assert edited[loop(38).pair].represented_by == made.pair and not edited[loop(38).pair].counts
    assert edited[loop(34).pair].repeats is None, "the user's word is not to be outvoted"
    undone = apply_edits(found, [], {add: made})
    assert all(edge.counts and edge.repeats is None for edge in undone.values())
    assert loop_factors(undone.values(), undone, POSES, window=0)


def test_who_stood_in_for_a_rejected_loop_hands_over_when_that_is_back() -> None:
    """What was found meanwhile was placed by it."""
    first, second, third = loop(40), replace(loop(38), represented_by=loop(40).pair), loop(36)
    found = {edge.pair: edge for edge in (first, second, replace(third, represented_by=second.pair))}
    rejected = apply_edits(found, [Reject(*first.pair)], {})
    assert rejected[second.pair].counts and rejected[third.pair].represented_by == second.pair
    back = apply_edits(found, [], {})
    assert [edge.represented_by for _, edge in sorted(back.items())] == [first.pair, first.pair, None]


def test_with_a_window_each_loop_is_between_its_own_keyframes() -> None:
    edges = {edge.pair: edge for edge in (loop(40), replace(loop(34), repeats=loop(40).pair))}
    for window, pairs in ((0, [loop(40).pair] * 2), (50, [*edges])):
        factors = loop_factors(edges.values(), edges, POSES, window=window)
        assert [factor.keyframes for factor in factors] == pairs
        assert [factor.name for factor in factors] == [*edges]


# --- judged together -----------------------------------------------------------------------------
SLIPPED = Evidence(overlap=0.8, residual_rms=0.03, slide=0.01, mahalanobis=9.0, gate_m=0.1, alternative_m=np.inf)


def judged(loops: list[LoopEdge], evidence: Evidence = SLIPPED, *others: LoopEdge) -> dict[int, LoopEdge]:
    """By their older ends, once all are there, others with evidence of their own; odometry walks as `POSES`."""
    found = {edge.pair: replace(edge, evidence=evidence) for edge in loops} | {edge.pair: edge for edge in others}
    found = {pair: replace(edge, verdict=Verdict.CANDIDATE) for pair, edge in found.items()}
    settled = settle(
        found, found, POSES, PIECES[: len(POSES)], Drift(0.01, 0.002, np.radians(0.02)), LoopsParams(), 2 * TURN - 1
    )
    return {edge.older: edge for edge in settled}


def test_one_loop_against_odometry_stays_undecided_and_says_so() -> None:
    (edge,) = judged([loop(40)]).values()
    assert edge.verdict is Verdict.CANDIDATE
    assert "odometry rules it out: 9.0 σ" in edge.reason and "0 others agree (4 needed)" in edge.reason


def test_loops_that_agree_over_a_stretch_outvote_odometry() -> None:
    edges = judged([loop(older) for older in range(40, 34, -1)])
    assert all(edge.verdict is Verdict.ACCEPTED and "outvote odometry" in edge.reason for edge in edges.values())


@pytest.mark.parametrize(("sigmas", "outvote"), [(5.0, False), (12.0, True)])
def test_a_longer_loop_to_another_place_keeps_others_from_outvoting_odometry_that_likes_it_better(
    sigmas: float, outvote: bool
) -> None:
    """Of places that look alike, the one that needs less drift over more odometry is likelier."""
    rival = replace(loop(10), newer=loop(38).newer, evidence=replace(SLIPPED, mahalanobis=sigmas))
    edges = judged([loop(older) for older in range(40, 34, -1)], SLIPPED, rival)
    assert edges.pop(10).verdict is Verdict.CANDIDATE
    assert {edge.verdict for edge in edges.values()} == {Verdict.ACCEPTED if outvote else Verdict.CANDIDATE}
    assert all(("likelier" in edge.reason) != outvote for edge in edges.values())


def test_loops_that_agree_at_one_spot_do_not_outvote_odometry() -> None:
    newer = 2 * TURN - 1 - 40
    at_one_spot = []
    for step in range(6):
        edge = loop(40 + step % 2)
        edge = replace(edge, older=38 + step, newer=newer + step % 3)
        T = lie.inverse(POSES[edge.older]) @ POSES[edge.newer]
        at_one_spot.append(replace(edge, T_older_newer=T))
    assert all(edge.verdict is Verdict.CANDIDATE for edge in judged(at_one_spot).values())


def test_with_odometry_half_as_many_are_enough() -> None:
    near = replace(SLIPPED, mahalanobis=1.0)
    assert {edge.verdict for edge in judged([loop(40), loop(39), loop(38)], near).values()} == {Verdict.ACCEPTED}
    assert {edge.verdict for edge in judged([loop(40), loop(39), loop(38)]).values()} == {Verdict.CANDIDATE}


def test_a_loop_that_others_contradict_is_not_accepted() -> None:
    off = np.array([0.0, 2.0, 0.0])
    edges = judged([*(loop(older) for older in (40, 39, 38, 37, 36, 35)), loop(34, off)])
    assert edges.pop(34).verdict is Verdict.CANDIDATE
    assert {edge.verdict for edge in edges.values()} == {Verdict.ACCEPTED}


def test_an_ambiguous_loop_that_agrees_neither_supports_nor_contradicts() -> None:
    """What was seen there may belong to a place that looks the same, but it lies where the others say."""
    near = replace(SLIPPED, mahalanobis=1.0)
    unsure = replace(near, alternative_m=4.0)
    sure = [loop(older) for older in (40, 39, 38)]

    def verdicts(ambiguous: list[LoopEdge]) -> set[Verdict]:
        found = {edge.pair: replace(edge, verdict=Verdict.CANDIDATE, evidence=near) for edge in sure}
        known = found | {edge.pair: replace(edge, verdict=Verdict.REJECTED, evidence=unsure) for edge in ambiguous}
        settled = settle(
            found, known, POSES, PIECES[: len(POSES)], Drift(0.01, 0.002, np.radians(0.02)), LoopsParams(), 2 * TURN - 1
        )
        return {edge.verdict for edge in settled}

    assert verdicts([loop(older) for older in (37, 36, 35)]) == {Verdict.ACCEPTED}
    elsewhere = np.array([0.0, 2.0, 0.0])
    assert verdicts([loop(older, elsewhere) for older in (37, 36, 35)]) == {Verdict.CANDIDATE}
    sure = sure[:2]
    assert verdicts([loop(older) for older in (37, 36, 35)]) == {Verdict.CANDIDATE}


def test_along_a_direction_that_both_leave_open_loops_need_not_agree() -> None:
    """In a corridor they say nothing of how far along it the walk is."""
    apart = [loop(older, np.array([0.8 * (older % 2), 0.0, 0.0])) for older in range(40, 34, -1)]
    near = replace(SLIPPED, mahalanobis=1.0)
    assert Verdict.ACCEPTED not in {edge.verdict for edge in judged(apart[:3], near).values()}
    along = np.diag([FLOOR_YAW**2] * 3 + [100.0, FLOOR_M**2, FLOOR_M**2])
    opened = [replace(edge, covariance=along) for edge in apart]
    assert {edge.verdict for edge in judged(opened, near).values()} == {Verdict.ACCEPTED}


def test_a_loop_that_leaves_a_direction_open_stands_for_none_that_does_not() -> None:
    along = np.diag([FLOOR_YAW**2] * 3 + [100.0, FLOOR_M**2, FLOOR_M**2])
    opened = replace(loop(40), covariance=along)
    assert [edge.represented_by for edge in sparsified([loop(39)], [opened], POSES, POSES, PIECES, HALF)] == [None]
    assert [edge.represented_by for edge in sparsified([opened], [loop(39)], POSES, POSES, PIECES, HALF)] == [
        loop(39).pair
    ]
