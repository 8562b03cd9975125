"""The back end on a walk with drifting odometry: the loops found, its history, and its results for display.

Tests app/slam/loops/files.py, app/slam/loops/search.py.
"""

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Add, Edits, Solve, rows
from app.slam.loops.factors import PositionPrior
from app.slam.loops.files import loops_csv, tied_pauses
from app.slam.loops.types import Origin, Verdict
from app.slam.metrics import umeyama
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe
from tests.slam.loops.conftest import PARAMS, Walked, accepted, same
from tests.slam.loops.walks import drive, error, revisits, take

FINER = LoopsParams(submap_keyframes=5)
"""Where places must be told apart that odometry does not."""
LAP = 80
"""Keyframes after which the walk of `walked` sees again what it saw at first."""


def misplaced(poses: F64, truth: F64) -> float:
    """m, root mean square after alignment."""
    T = umeyama(poses[:, :3, 3], truth[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] @ T[:3, :3].T + T[:3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


# --- finding -------------------------------------------------------------------------------------
def test_revisits_are_found_where_they_are_and_nothing_else_is(walked: Walked) -> None:
    loops = accepted(walked.backend)
    errors = np.array([error(edge, walked.walk.truth) for edge in loops])
    assert errors[:, 0].max() < 0.1
    assert errors[:, 1].max() < 1.0
    found = {edge.newer for edge in loops}
    assert np.mean([index in found for index in revisits(walked.walk)]) > 0.8


def test_loops_straighten_the_walk(walked: Walked) -> None:
    odometry = np.array([keyframe.T_odom_imu for keyframe in walked.keyframes])
    ends = revisits(walked.walk)[-1]
    gap = np.linalg.norm(odometry[ends, :3, 3] - walked.walk.truth[ends, :3, 3])
    assert gap > 0.3, "odometry is off by the end"
    assert misplaced(walked.backend.poses, walked.walk.truth) < 0.6 * misplaced(odometry, walked.walk.truth)
    at_once = walked.backend.preview(Solve()).poses
    assert misplaced(at_once, walked.walk.truth) < 0.6 * misplaced(odometry, walked.walk.truth)


def test_the_correction_takes_odometry_to_the_map(walked: Walked) -> None:
    newest = walked.backend.corrections[-1] @ walked.keyframes[-1].T_odom_imu
    np.testing.assert_allclose(newest, walked.backend.poses[-1], atol=1e-9)


def test_every_candidate_says_why(walked: Walked) -> None:
    for edge in walked.backend.edges:
        assert edge.reason
        assert edge.origin is Origin.DETECTED
        assert edge.older < edge.newer <= edge.decided_at < len(walked.backend)
        if edge.verdict is Verdict.ACCEPTED:
            assert edge.evidence.support >= PARAMS.support
            assert edge.evidence.mahalanobis <= PARAMS.max_mahalanobis or "outvote odometry" in edge.reason
            assert f"overlap {100 * edge.evidence.overlap:.0f} %" in edge.reason
        np.linalg.cholesky(edge.covariance)


def test_corridors_and_rooms_that_repeat_make_no_false_loop() -> None:
    walk = take("identical", 120.0)
    backend = drive(walk.drifted(0.01, 0.02), PARAMS)
    errors = np.array([error(edge, walk.truth) for edge in accepted(backend)])
    assert len(errors) > 20, "true revisits are found all the same"
    assert errors[:, 0].max() < 0.5, "the next door is 4 m away, the next corridor 6 m"
    assert errors[:, 1].max() < 2.0
    assert any("it is ambiguous" in edge.reason for edge in backend.edges), "where odometry allows both, neither counts"


def test_flats_that_look_alike_stay_beside_one_another_even_if_odometry_drifts_more_than_it_may() -> None:
    walk = take("flats", 160.0)
    backend = drive(walk.drifted(0.05, -0.1), PARAMS)
    errors = np.array([error(edge, walk.truth) for edge in accepted(backend)])
    assert len(errors) > 50, "true revisits are found all the same"
    assert errors[:, 0].max() < 1.0, "the next flat is 7 m away"
    assert any("odometry rules it out" in edge.reason and edge.evidence.overlap > 0.8 for edge in backend.edges)


def test_storeys_that_look_alike_stay_above_one_another() -> None:
    walk = take("storeys", 65.0)
    backend = drive(walk.drifted(0.01, 0.02), PARAMS)
    loops = accepted(backend)
    errors = np.array([error(edge, walk.truth) for edge in loops])
    height = walk.truth[:, 2, 3]
    assert np.ptp(height) > 3.0
    assert errors[:, 0].max() < 0.5, "the other storey is 3.3 m away"
    found = {edge.newer for edge in loops}
    assert np.mean([index in found for index in revisits(walk)]) > 0.6
    assert any("storeys of a building look alike" in edge.reason for edge in backend.edges)


def test_where_odometry_was_seen_to_break_loops_outvote_it_however_far_off_it_is(walked: Walked) -> None:
    keyframes, at = walked.walk.drifted(0.003, 0.005)[: LAP + 30], 20  # further on, it is not seen across the break
    here = lie.transform(np.eye(3), keyframes[at].T_odom_imu[:3, 3])
    leap = lie.transform(lie.exp(np.array([0.0, 0.0, np.radians(20.0)])), np.array([0.6, -0.3, 0.8]))
    broken = [
        replace(k, T_odom_imu=here @ leap @ lie.inverse(here) @ k.T_odom_imu) if k.index >= at else k for k in keyframes
    ]
    backend = drive(tuple(broken), FINER)
    across = [edge for edge in accepted(backend) if edge.older < at - FINER.submap_keyframes]
    assert any(edge.evidence.mahalanobis > 4 * FINER.max_mahalanobis for edge in across)
    assert max(error(edge, walked.walk.truth)[0] for edge in across) < 0.1


def paused(
    keyframes: tuple[Keyframe, ...], at: int, turned_deg: float, moved: tuple[float, float, float]
) -> list[Keyframe]:
    """The same walk if keyframe `at` comes after a pause: from there on odometry is off by a turn and a shift."""
    here = lie.transform(np.eye(3), keyframes[at].T_odom_imu[:3, 3])
    leap = lie.transform(lie.exp(np.array([0.0, 0.0, np.radians(turned_deg)])), np.array(moved))
    off = here @ leap @ lie.inverse(here)
    return [
        replace(k, T_odom_imu=off @ k.T_odom_imu, resumed_ns=k.stamp_ns * (k.index == at)) if k.index >= at else k
        for k in keyframes
    ]


@pytest.mark.parametrize("moved", [(0.0, 0.0, 0.0), (3.0, -1.5, 0.2)])
def test_loops_tie_the_parts_of_a_walk_that_was_paused(walked: Walked, moved: tuple[float, float, float]) -> None:
    """Whether the walker came back to where the pause began or went on meanwhile."""
    keyframes, at = walked.walk.drifted(0.003, 0.005)[: LAP + 30], 60
    backend = drive(tuple(paused(keyframes, at, 15.0, moved)), PARAMS)
    across = [edge for edge in accepted(backend) if edge.older < at <= edge.newer]
    assert len(across) > 5
    assert max(error(edge, walked.walk.truth)[0] for edge in across) < 0.3
    assert misplaced(backend.poses, walked.walk.truth[: len(keyframes)]) < 0.1
    stamps_ns = np.array([keyframe.stamp_ns for keyframe in keyframes])
    ends = np.array([stamps_ns[at], stamps_ns[-1] + 1])
    assert tied_pauses(across, stamps_ns, ends).tolist() == [stamps_ns[at]]


def test_after_a_pause_nothing_is_tied_to_a_place_that_looks_the_same() -> None:
    walk = take("identical", 55.0)
    at = 2 * len(walk.keyframes) // 3
    backend = drive(tuple(paused(walk.drifted(0.01, 0.02), at, 10.0, (1.0, 0.5, 0.0))), FINER)
    assert any(edge.older < at <= edge.newer and edge.evidence.overlap > 0.8 for edge in backend.edges)
    errors = [error(edge, walk.truth)[0] for edge in accepted(backend)]
    assert max(errors, default=0.0) < 0.5, "the next door is 4 m away, the next corridor 6 m"


# --- history -------------------------------------------------------------------------------------
def test_the_same_walk_gives_the_same_loops_and_poses_to_the_last_bit(walked: Walked) -> None:
    again = drive(walked.keyframes, PARAMS)
    assert again.poses.tobytes() == walked.poses[-1].tobytes()
    assert same(again.edges, walked.edges[-1])
    again.close()


def test_going_back_and_forth_gives_what_was_then_to_the_last_bit(walked: Walked, backend: LoopBackend) -> None:
    last = len(walked.keyframes)
    for count in (last, 90, 91, 40, 1, walked.halfway, walked.halfway + 1, last - 1, last):
        backend.go_to(count)
        assert len(backend) == count
        assert backend.poses.tobytes() == walked.poses[count - 1].tobytes()
        assert same(backend.edges, walked.edges[count - 1])
    backend.finish()
    assert backend.poses.tobytes() == walked.poses[-1].tobytes()
    assert same(backend.edges, walked.edges[-1])


def test_keyframes_that_come_again_are_known_and_going_on_from_there_is_going_on(
    walked: Walked, backend: LoopBackend
) -> None:
    backend.go_to(walked.halfway)
    for keyframe in walked.keyframes[walked.halfway :]:
        backend.add(keyframe, PARAMS)
        assert backend.known == len(walked.keyframes), "nothing was forgotten"
        assert backend.poses.tobytes() == walked.poses[len(backend) - 1].tobytes()


def test_another_way_on_is_as_if_the_first_had_never_been(walked: Walked, backend: LoopBackend) -> None:
    backend.go_to(walked.halfway)
    backend.detail(*backend.edges[-1].pair)  # looking must not change what comes
    backend.forget()
    assert backend.known == walked.halfway
    with pytest.raises(HemislamError, match="knows"):
        backend.go_to(walked.halfway + 1)
    other = replace(walked.keyframes[walked.halfway], stamp_ns=walked.keyframes[walked.halfway].stamp_ns + 1)
    backend.add(other, PARAMS)
    backend.go_to(walked.halfway)
    for keyframe in walked.keyframes[walked.halfway :]:  # the first differs from `other`, so that is forgotten
        backend.add(keyframe, PARAMS)
    backend.finish()
    assert backend.poses.tobytes() == walked.poses[-1].tobytes()
    assert same(backend.edges, walked.edges[-1])


def test_the_end_is_taken_back_when_the_walk_goes_on(walked: Walked, backend: LoopBackend) -> None:
    backend.go_to(walked.halfway)
    backend.finish()
    assert backend.finished
    assert len(backend.edges) > len(walked.edges[walked.halfway - 1])
    backend.add(walked.keyframes[walked.halfway], PARAMS)
    assert not backend.finished
    assert backend.poses.tobytes() == walked.poses[walked.halfway].tobytes()


def test_a_keyframe_out_of_turn_is_refused(walked: Walked, backend: LoopBackend) -> None:
    count = backend.known
    with pytest.raises(HemislamError, match=f"Keyframe {count + 1} cannot follow on {count}"):
        backend.add(replace(walked.keyframes[-1], index=count + 1), PARAMS)
    assert len(backend) == count


def with_params(**values: object) -> LoopsParams:
    return LoopsParams.model_validate({**PARAMS.model_dump(), **values})


def test_switched_off_it_is_the_odometry(walked: Walked) -> None:
    backend = drive(walked.keyframes[:40], with_params(enabled=False))
    assert backend.edges == ()
    np.testing.assert_allclose(backend.poses, [k.T_odom_imu for k in walked.keyframes[:40]], atol=1e-9)


def test_switched_on_late_it_finds_what_comes_then(walked: Walked) -> None:
    backend = LoopBackend()
    for keyframe in walked.keyframes:
        backend.add(keyframe, with_params(enabled=keyframe.index >= walked.halfway))
    there = [edge for edge in walked.edges[len(walked.keyframes) - 1] if edge.decided_at > walked.halfway + 2]
    found = {edge.newer for edge in accepted(backend)}
    assert found
    assert len(found & {edge.newer for edge in there}) >= 0.8 * len({edge.newer for edge in there})
    backend.close()


def test_a_window_keeps_what_is_older_than_it_in_place(walked: Walked) -> None:
    window = 30
    seen: list[F64] = []
    drive(walked.keyframes, with_params(window=window), lambda backend: seen.append(backend.poses)).close()
    assert len(seen[-1]) == len(walked.keyframes)
    for before, after in pairwise(seen):
        left = max(len(before) - window, 0)
        np.testing.assert_array_equal(after[:left], before[:left])


# --- what is shown and written -------------------------------------------------------------------
def test_the_detail_of_a_loop_shows_both_places_and_how_they_fit(backend: LoopBackend) -> None:
    edge = accepted(backend)[-1]
    detail = backend.detail(*edge.pair)
    moved = detail.newer @ detail.T_registered[:3, :3].T + detail.T_registered[:3, 3]
    from scipy.spatial import KDTree

    near = np.linalg.norm(moved, axis=1) < 6
    assert np.median(KDTree(detail.older).query(moved[near])[0]) < 0.15
    assert len(detail.residuals) > 100
    assert np.isnan(detail.older_context).any()
    assert detail.shift_distances[0] == pytest.approx(detail.shift_distances.min(), abs=0.05)
    assert np.sqrt(np.mean(detail.residuals**2)) == pytest.approx(edge.evidence.residual_rms, rel=1e-6)


def test_any_two_keyframes_can_be_looked_at_even_the_newest(backend: LoopBackend) -> None:
    backend.go_to(60)
    detail = backend.detail(2, 59)
    np.testing.assert_array_equal(detail.T_registered, detail.T_guess)
    with pytest.raises(HemislamError, match="of the 60 there are"):
        backend.detail(2, 60)


def test_the_g2o_file_holds_the_graph(backend: LoopBackend, tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text(backend.g2o())
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert values.size() == len(backend)
    loops = [edge for edge in backend.edges if edge.counts]
    assert graph.size() == len(backend) - 1 + len(loops) == len(backend.factor_residuals())


def test_the_table_of_loops_says_of_each_what_is_in_the_graph_for_it(backend: LoopBackend) -> None:
    lines = list(csv.DictReader(loops_csv(backend.edges, np.arange(len(backend))).splitlines()))
    counting = {f"{line['older']}-{line['newer']}" for line in lines if line["verdict"] == "accepted"} - {
        f"{line['older']}-{line['newer']}" for line in lines if line["represented_by"]
    }
    assert counting == {f"{edge.older}-{edge.newer}" for edge in backend.edges if edge.counts}
    assert {""} < {line["represented_by"] for line in lines} <= {*counting, ""}


def test_a_covariance_that_is_no_number_does_not_stop_the_walk(walked: Walked) -> None:
    broken = [
        replace(keyframe, covariance=np.full((6, 6), np.nan)) if keyframe.index == 5 else keyframe
        for keyframe in walked.keyframes[:12]
    ]
    backend = drive(tuple(broken), PARAMS)
    assert backend.take_notices() == ()
    np.testing.assert_allclose(backend.poses, [k.T_odom_imu for k in broken], atol=1e-9)


def test_an_empty_back_end_has_nothing_to_show(walked: Walked) -> None:
    backend = drive((), PARAMS)
    assert backend.poses.shape == (0, 4, 4)
    assert backend.corrections.shape == (0, 4, 4)
    backend.go_to(0)
    assert backend.edges == backend.factor_residuals() == ()


def test_places_with_nothing_in_common_are_not_tied_by_registration(walked: Walked, backend: LoopBackend) -> None:
    far = np.eye(4)
    far[0, 3] = 200.0
    before = backend.edges
    for act in (backend.preview, backend.apply):
        with pytest.raises(HemislamError, match="nothing in common"):
            act(Add(5, 62, rows(far)))
    assert same(backend.edges, before) and backend.edits == Edits()


def test_measured_positions_of_keyframes_pull_the_map_and_take_part_in_every_solution(walked: Walked) -> None:
    def aside(index: int) -> F64:
        return walked.keyframes[index].T_odom_imu[:3, 3] + np.array([0.0, 0.0, 2.0])

    backend = LoopBackend()
    for keyframe in walked.keyframes[:20]:
        priors = (PositionPrior(KeyframeId(0, 15), aside(15), 1e-6 * np.eye(3)),) if keyframe.index == 15 else ()
        backend.add(keyframe, PARAMS, priors)
    poses = backend.poses
    np.testing.assert_allclose(poses[15, :3, 3], aside(15), atol=0.05)
    assert backend.corrections[15, 2, 3] != 0.0
    backend.go_to(3)
    backend.go_to(20)
    assert backend.poses.tobytes() == poses.tobytes()
    np.testing.assert_allclose(backend.preview(Solve()).poses[15, :3, 3], aside(15), atol=0.05)
    backend.go_to(15)
    assert (backend.corrections == np.eye(4)).all()
    assert backend.take_notices() == ()
    backend.close()
