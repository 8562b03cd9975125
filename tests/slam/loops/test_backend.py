from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops.backend import LoopBackend
from app.slam.loops.types import Accept, Add, Command, LoopEdge, Origin, Reject, SetWeight, Verdict, rows
from app.slam.metrics import umeyama
from app.slam.params import Loops
from app.slam.types import F64
from tests.slam.loops.conftest import PARAMS, Walked, same
from tests.slam.loops.walks import drive, error, revisits, take


def accepted(backend: LoopBackend) -> list[LoopEdge]:
    return [edge for edge in backend.edges if edge.verdict is Verdict.ACCEPTED]


def misplaced(poses: F64, truth: F64) -> float:
    """m, root mean square after alignment."""
    T = umeyama(poses[:, :3, 3], truth[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] @ T[:3, :3].T + T[:3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


def applied(backend: LoopBackend, command: Command) -> LoopEdge:
    backend.apply(command)
    return next(edge for edge in backend.edges if edge.pair == (command.older, command.newer))


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
    assert misplaced(walked.backend.optimised(), walked.walk.truth) < 0.6 * misplaced(odometry, walked.walk.truth)


def test_the_correction_takes_odometry_to_the_map(walked: Walked) -> None:
    newest = walked.backend.T_map_odom @ walked.keyframes[-1].T_odom_imu
    np.testing.assert_allclose(newest, walked.backend.poses[-1], atol=1e-9)


def test_every_candidate_says_why(walked: Walked) -> None:
    for edge in walked.backend.edges:
        assert edge.reason
        assert edge.origin is Origin.DETECTED
        assert edge.older < edge.newer <= edge.decided_at < len(walked.backend)
        if edge.verdict is Verdict.ACCEPTED:
            assert edge.evidence.support >= PARAMS.support
            assert edge.evidence.mahalanobis <= PARAMS.max_mahalanobis
            assert f"{edge.evidence.overlap:.2f}" in edge.reason
        np.linalg.cholesky(edge.covariance)


def test_corridors_and_rooms_that_repeat_make_no_false_loop() -> None:
    walk = take("identical", 160.0)
    backend = drive(walk.drifted(0.01, 0.02), PARAMS)
    errors = np.array([error(edge, walk.truth) for edge in accepted(backend)])
    assert len(errors) > 20, "true revisits are found all the same"
    assert errors[:, 0].max() < 0.5, "the next door is 4 m away, the next corridor 6 m"
    assert errors[:, 1].max() < 2.0


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
    backend.go_to(50)
    with pytest.raises(HemislamError, match="Keyframe 51 can not follow on 50"):
        backend.add(walked.keyframes[51], PARAMS)
    assert len(backend) == 50


def with_params(**values: object) -> Loops:
    return Loops.model_validate({**PARAMS.model_dump(), **values})


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


# --- overruling ----------------------------------------------------------------------------------
def commands(backend: LoopBackend) -> st.SearchStrategy[Command]:
    pairs = st.sampled_from([edge.pair for edge in backend.edges])
    far = st.tuples(st.integers(0, 30), st.integers(60, len(backend) - 1))
    shift = st.tuples(*[st.floats(-1, 1)] * 3)
    return st.one_of(
        pairs.map(lambda pair: Accept(*pair)),
        pairs.map(lambda pair: Reject(*pair)),
        st.tuples(pairs, st.sampled_from([0.01, 0.5, 7.0])).map(lambda x: SetWeight(*x[0], x[1])),
        st.tuples(far, shift).map(lambda x: Add(*x[0], rows(lie.transform(np.eye(3), np.array(x[1]))), register=False)),
    )


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_undoing_any_overrulings_is_never_having_done_them(walked: Walked, data: st.DataObject) -> None:
    backend = walked.again()
    poses, edges = backend.poses, backend.edges
    residuals = backend.factor_residuals()
    trail = []
    given_ = data.draw(st.lists(commands(backend), min_size=1, max_size=5))
    for command in given_:
        backend.apply(command)
        trail.append(backend.poses)
    assert backend.commands == tuple(given_)
    for k in reversed(range(len(given_))):
        np.testing.assert_allclose(backend.poses, trail[k], atol=1e-9, rtol=0)
        backend.undo()
        assert (backend.commands, backend.undone[-1]) == (tuple(given_[:k]), given_[k])
    with pytest.raises(HemislamError, match="undo"):
        backend.undo()
    np.testing.assert_allclose(backend.poses, poses, atol=1e-9, rtol=0)
    assert backend.factor_residuals() == residuals
    assert same(backend.edges, edges)
    for k in range(len(given_)):
        backend.redo()
        np.testing.assert_allclose(backend.poses, trail[k], atol=1e-9, rtol=0)
    with pytest.raises(HemislamError, match="redo"):
        backend.redo()


def test_undone_in_the_middle_of_the_walk_the_rest_goes_as_without(walked: Walked, backend: LoopBackend) -> None:
    backend.go_to(walked.halfway)
    backend.apply(SetWeight(*backend.edges[-1].pair, 0.5))
    backend.undo()
    backend.forget()
    for keyframe in walked.keyframes[walked.halfway :]:
        backend.add(keyframe, PARAMS)
    backend.finish()
    assert backend.poses.tobytes() == walked.poses[-1].tobytes()


def edits(walked: Walked, backend: LoopBackend) -> list[Command]:
    """One of each kind, and one for a loop that is not there."""
    first, *_, last = (edge.pair for edge in accepted(backend))
    far = rows(lie.inverse(walked.walk.truth[3]) @ walked.walk.truth[60])
    return [
        SetWeight(*first, 2.0),
        Reject(*last),
        Add(3, 60, far, register=False),
        Add(5, 62, register=False),
        Accept(0, 1),
    ]


def test_a_session_given_again_before_the_walk_goes_as_it_went(walked: Walked, backend: LoopBackend) -> None:
    """Commands from the middle of the walk and from after its end, to the last bit."""
    reject, *rest = edits(walked, backend)
    backend.go_to(walked.halfway)
    backend.forget()
    backend.apply(reject)
    for keyframe in walked.keyframes[walked.halfway :]:
        backend.add(keyframe, PARAMS)
    backend.finish()
    for command in rest:
        backend.apply(command)
    again = LoopBackend()
    again.load(backend.commands)
    for keyframe in walked.keyframes:
        again.add(keyframe, PARAMS)
    again.finish()
    assert again.commands == backend.commands
    assert same(again.edges, backend.edges)
    assert again.poses.tobytes() == backend.poses.tobytes()
    for count in (70, walked.halfway):
        again.go_to(count)
        backend.go_to(count)
        assert again.poses.tobytes() == backend.poses.tobytes()
    again.close()


def test_a_list_written_by_hand_waits_for_its_keyframes(walked: Walked, backend: LoopBackend) -> None:
    commands = tuple(edits(walked, backend)[2:])
    early = LoopBackend()
    early.load(commands)
    for keyframe in walked.keyframes[:70]:
        early.add(keyframe, PARAMS)
    assert {edge.pair for edge in early.edges} == {(3, 60), (5, 62)}
    assert error(early.edges[0], walked.walk.truth)[0] < 1e-6
    early.finish()
    assert early.take_notices() == ("Accept 0-1 has no effect: there is no such loop; loops.csv lists all.",)
    early.close()


def test_commands_from_a_walk_with_more_keyframes_act_at_the_end(walked: Walked) -> None:
    backend = LoopBackend()
    backend.load((Add(3, 25, rows(np.eye(4)), register=False, since=141), Accept(1, 2, since=500)))
    for keyframe in walked.keyframes[:30]:
        backend.add(keyframe, PARAMS)
    assert backend.edges == ()
    backend.finish()
    assert [edge.pair for edge in backend.edges] == [(3, 25)]
    assert backend.take_notices() == ("Accept 1-2 has no effect: there is no such loop; loops.csv lists all.",)
    backend.go_to(28)
    assert [edge.pair for edge in backend.edges] == [(3, 25)], "given once, it belongs to the present"
    backend.go_to(30)
    backend.finish()
    assert backend.take_notices() == (), "it is said once"
    backend.close()


def test_a_command_of_the_present_counts_for_what_is_found_from_then_on(walked: Walked, backend: LoopBackend) -> None:
    """A false loop that was let in rules out the true ones; rejected, it stands in their way no more."""
    start = next(k for k, edges in enumerate(walked.edges) if edges) - 2
    later = [e for e in accepted(backend) if e.decided_at > start + 3]
    backend.go_to(start)
    backend.forget()
    wrong = rows(lie.transform(np.eye(3), np.array([3.0, 3.0, 0.0])))
    for index in range(4):
        backend.apply(Add(index, start - 5 + index, wrong, register=False))
    for keyframe in walked.keyframes[start : start + 12]:
        backend.add(keyframe, PARAMS)
    misled = [edge for edge in accepted(backend) if edge.origin is Origin.DETECTED]
    backend.go_to(start)
    backend.forget()
    for index in range(4):
        backend.apply(Reject(index, start - 5 + index))
    for keyframe in walked.keyframes[start:]:
        backend.add(keyframe, PARAMS)
    found = {edge.pair for edge in accepted(backend) if edge.origin is Origin.DETECTED}
    assert not misled
    assert len(found & {edge.pair for edge in later}) > 0.8 * len(later)


def test_a_loop_by_hand_waits_again_when_its_keyframe_is_forgotten(walked: Walked, backend: LoopBackend) -> None:
    backend.apply(Add(3, 100, rows(np.eye(4)), register=False))
    backend.go_to(100)
    assert (3, 100) not in {edge.pair for edge in backend.edges}, "there is no keyframe 100 yet"
    assert backend.commands == (Add(3, 100, rows(np.eye(4)), register=False),)
    backend.forget()
    for keyframe in walked.keyframes[100:110]:
        backend.add(keyframe, PARAMS)
    assert (3, 100) in {edge.pair for edge in backend.edges}


def test_with_every_loop_rejected_the_map_is_the_odometry(walked: Walked, backend: LoopBackend) -> None:
    for edge in accepted(backend):
        backend.apply(Reject(edge.older, edge.newer))
    np.testing.assert_allclose(backend.poses, [k.T_odom_imu for k in walked.keyframes], atol=1e-9)
    assert all(
        edge.overruled and "by hand" in edge.reason for edge in backend.edges if edge.pair in backend_pairs(backend)
    )


def backend_pairs(backend: LoopBackend) -> set[tuple[int, int]]:
    return {(command.older, command.newer) for command in backend.commands}


def test_a_loop_by_hand_is_registered_from_a_rough_guess(walked: Walked, backend: LoopBackend) -> None:
    truth = walked.walk.truth
    older, newer = next(edge.pair for edge in reversed(accepted(backend)))
    older += 1
    rough = lie.inverse(truth[older]) @ truth[newer] @ lie.transform(lie.exp(np.array([0.05, 0, 0])), np.full(3, 0.2))
    edge = applied(backend, Add(older, newer, rows(rough)))
    assert edge.origin is Origin.USER
    assert edge.verdict is Verdict.ACCEPTED
    assert error(edge, truth)[0] < 0.05
    as_it_is = applied(backend, Add(older, newer, rows(rough), register=False))
    np.testing.assert_allclose(as_it_is.T_older_newer, rough)
    present = applied(backend, Add(older, newer))
    assert error(present, truth)[0] < 0.05


def test_a_heavier_loop_is_met_better(backend: LoopBackend) -> None:
    def left(backend: LoopBackend) -> float:
        return next(r.translation for r in backend.factor_residuals() if r.loop and r.pair == pair)

    pair = max((r for r in backend.factor_residuals() if r.loop), key=lambda r: r.translation).pair
    before = left(backend)
    assert applied(backend, SetWeight(*pair, 100.0)).weight == 100.0
    assert left(backend) < before


def test_a_preview_shows_what_comes_and_changes_nothing(backend: LoopBackend) -> None:
    backend.go_to(60)
    poses, edges = backend.poses, backend.edges
    command = Add(2, 50, rows(lie.transform(np.eye(3), np.array([5.0, 0.0, 0.0]))), register=False)
    ghost = backend.preview(command)
    np.testing.assert_array_equal(backend.poses, poses)
    assert len(backend.edges) == len(edges)
    assert backend.commands == ()
    assert np.abs(ghost.poses - poses).max() > 0.1
    backend.apply(command)
    np.testing.assert_allclose(backend.poses[:, :3, 3], ghost.poses[:, :3, 3], atol=0.05)
    assert [r.pair for r in ghost.residuals] == [r.pair for r in backend.factor_residuals()]


def test_a_loop_that_breaks_the_solver_is_reported_and_the_run_goes_on(walked: Walked, backend: LoopBackend) -> None:
    backend.go_to(walked.halfway)
    pair = accepted(backend)[0].pair
    edge = applied(backend, SetWeight(*pair, 1e306))
    assert edge.verdict is Verdict.REJECTED
    assert "solver" in edge.reason
    (notice,) = backend.take_notices()
    assert f"{pair[0]}-{pair[1]}" in notice
    for keyframe in walked.keyframes[walked.halfway : walked.halfway + 3]:
        backend.add(keyframe, PARAMS)
    assert len(backend.poses) == walked.halfway + 3
    assert np.isfinite(backend.poses).all()
    backend.go_to(walked.halfway)
    assert backend.take_notices() == (), "it is said once"
    backend.undo()
    assert backend.poses.tobytes() == walked.poses[walked.halfway - 1].tobytes()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (Add(5, 5), "can not be tied together"),
        (Accept(7, 3), "can not be tied together"),
        (Reject(-1, 3), "can not be tied together"),
        (Add(0, 30, ((1.0,),)), "4x4"),
    ],
)
def test_a_command_that_never_makes_sense_is_refused_and_changes_nothing(
    backend: LoopBackend, command: Command, message: str
) -> None:
    with pytest.raises(HemislamError, match=message):
        backend.apply(command)
    with pytest.raises(HemislamError, match=message):
        backend.load((SetWeight(1, 2, 3.0), command))
    assert backend.commands == ()


@pytest.mark.parametrize(
    ("command", "message"), [(Accept(1, 2), "no loop candidate of keyframes 1 and 2"), (Add(0, 10_000), "of the")]
)
def test_what_is_not_there_can_not_be_tried_out(backend: LoopBackend, command: Command, message: str) -> None:
    with pytest.raises(HemislamError, match=message):
        backend.preview(command)


def test_a_weight_must_be_positive(backend: LoopBackend) -> None:
    for weight in (0.0, -1.0, float("nan")):
        with pytest.raises(HemislamError, match="greater than 0"):
            backend.apply(SetWeight(*backend.edges[0].pair, weight))


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
    assert graph.size() == len(backend) - 1 + len(accepted(backend)) == len(backend.factor_residuals())


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
    np.testing.assert_array_equal(backend.T_map_odom, np.eye(4))
    backend.go_to(0)
    assert backend.edges == backend.factor_residuals() == ()


def test_places_with_nothing_in_common_are_not_tied_by_registration(walked: Walked, backend: LoopBackend) -> None:
    far = np.eye(4)
    far[0, 3] = 200.0
    before = backend.edges
    for act in (backend.preview, backend.apply):
        with pytest.raises(HemislamError, match="nothing in common"):
            act(Add(5, 62, rows(far)))
    assert same(backend.edges, before) and not backend.commands
