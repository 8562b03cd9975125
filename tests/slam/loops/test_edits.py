"""The user's edits of the found loops: applied, undone, waiting, replayed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops.backend import LoopBackend
from app.slam.loops.edits import Accept, Add, Edits, LoopEdit, Reject, SetWeight, Solve, rows
from app.slam.loops.factors import residuals
from app.slam.loops.types import FactorResidual, Origin, Verdict
from app.slam.types import F64
from tests.slam.loops.conftest import PARAMS, Walked, accepted, applied, same
from tests.slam.loops.walks import drive, error


def commands(backend: LoopBackend) -> st.SearchStrategy[LoopEdit]:
    pairs = st.sampled_from([edge.pair for edge in backend.edges])
    far = st.tuples(st.integers(0, 30), st.integers(60, len(backend) - 1))
    shift = st.tuples(*[st.floats(-1, 1)] * 3)
    return st.one_of(
        pairs.map(lambda pair: Accept(*pair)),
        pairs.map(lambda pair: Reject(*pair)),
        st.just(Solve()),
        st.tuples(pairs, st.sampled_from([0.01, 0.5, 7.0])).map(lambda x: SetWeight(*x[0], x[1])),
        st.tuples(far, shift).map(lambda x: Add(*x[0], rows(lie.transform(np.eye(3), np.array(x[1]))), register=False)),
    )


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_undoing_any_edits_is_never_having_done_them(walked: Walked, data: st.DataObject) -> None:
    backend = walked.again()
    poses, edges = backend.poses, backend.edges
    residuals = backend.factor_residuals()
    trail = []
    given_ = data.draw(st.lists(commands(backend), min_size=1, max_size=5))
    for command in given_:
        backend.apply(command)
        trail.append(backend.poses)
    assert backend.edits.done == tuple(given_)
    for k in reversed(range(len(given_))):
        np.testing.assert_allclose(backend.poses, trail[k], atol=1e-9, rtol=0)
        backend.load(backend.edits.undo())
        assert (backend.edits.done, backend.edits.undone[-1]) == (tuple(given_[:k]), given_[k])
    with pytest.raises(HemislamError, match="undo"):
        backend.edits.undo()
    np.testing.assert_allclose(backend.poses, poses, atol=1e-9, rtol=0)
    assert backend.factor_residuals() == residuals
    assert same(backend.edges, edges)
    for k in range(len(given_)):
        backend.load(backend.edits.redo())
        np.testing.assert_allclose(backend.poses, trail[k], atol=1e-9, rtol=0)
    with pytest.raises(HemislamError, match="redo"):
        backend.edits.redo()


def test_undone_in_the_middle_of_the_walk_the_rest_goes_as_without(walked: Walked, backend: LoopBackend) -> None:
    backend.go_to(walked.halfway)
    backend.apply(SetWeight(*backend.edges[-1].pair, 0.5))
    backend.load(backend.edits.undo())
    backend.forget()
    for keyframe in walked.keyframes[walked.halfway :]:
        backend.add(keyframe, PARAMS)
    backend.finish()
    assert backend.poses.tobytes() == walked.poses[-1].tobytes()


def edits(walked: Walked, backend: LoopBackend) -> list[LoopEdit]:
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
    again.load(backend.edits)
    for keyframe in walked.keyframes:
        again.add(keyframe, PARAMS)
    again.finish()
    assert again.edits == backend.edits
    assert same(again.edges, backend.edges)
    assert again.poses.tobytes() == backend.poses.tobytes()
    for count in (70, walked.halfway):
        again.go_to(count)
        backend.go_to(count)
        assert again.poses.tobytes() == backend.poses.tobytes()
    again.close()


@pytest.mark.parametrize("kind", [Reject, Add])
def test_an_edit_that_acted_while_loops_were_found_can_be_undone_and_redone(
    walked: Walked, backend: LoopBackend, kind: type[Reject | Add]
) -> None:
    """Undone it was never made, and redone it always was, to the last bit."""
    without = backend.edges, backend.poses.tobytes(), backend.g2o()
    pair = accepted(backend)[0].pair if kind is Reject else (5, 62)
    other = LoopBackend()
    other.load(Edits((kind(*pair),)))
    for keyframe in walked.keyframes:
        other.add(keyframe, PARAMS)
    other.finish()
    edited = other.edges, other.poses.tobytes(), other.g2o()
    assert edited[1:] != without[1:]
    other.load(other.edits.undo())
    assert same(other.edges, without[0]) and (other.poses.tobytes(), other.g2o()) == without[1:]
    other.load(other.edits.redo())
    assert same(other.edges, edited[0]) and (other.poses.tobytes(), other.g2o()) == edited[1:]
    other.close()


def test_a_list_written_by_hand_waits_for_its_keyframes(walked: Walked, backend: LoopBackend) -> None:
    commands = tuple(edits(walked, backend)[2:])
    early = LoopBackend()
    early.load(Edits(commands))
    for keyframe in walked.keyframes[:70]:
        early.add(keyframe, PARAMS)
    assert {edge.pair for edge in early.edges} == {(3, 60), (5, 62)}
    assert error(early.edges[0], walked.walk.truth)[0] < 1e-6
    early.finish()
    assert early.take_notices() == ("Accept 0-1 has no effect: there is no such loop; loops.csv lists all.",)
    early.close()


def test_an_edit_of_what_is_not_there_is_said_once_at_the_end(walked: Walked) -> None:
    backend = LoopBackend()
    backend.load(Edits((Add(3, 25, rows(np.eye(4)), register=False), Accept(1, 2))))
    for keyframe in walked.keyframes[:30]:
        backend.add(keyframe, PARAMS)
    backend.finish()
    assert [edge.pair for edge in backend.edges] == [(3, 25)]
    assert backend.take_notices() == ("Accept 1-2 has no effect: there is no such loop; loops.csv lists all.",)
    backend.go_to(28)
    assert [edge.pair for edge in backend.edges] == [(3, 25)], "given once, it belongs to the present"
    backend.go_to(30)
    backend.finish()
    assert backend.take_notices() == (), "it is said once"
    backend.close()


def test_what_is_found_does_not_depend_on_edits_nor_on_when_they_were_made(
    walked: Walked, backend: LoopBackend
) -> None:
    """Not even false loops by hand, which bend the map, keep the search from the true ones."""
    wrong = rows(lie.transform(np.eye(3), np.array([3.0, 3.0, 0.0])))
    lies = [Add(index, walked.halfway - 6 + index, wrong, register=False) for index in range(4)]
    other, last = LoopBackend(), len(walked.keyframes)
    for keyframe in walked.keyframes:
        if keyframe.index == walked.halfway:
            for edit in lies:
                other.apply(edit)
        other.add(keyframe, PARAMS)
    other.finish()
    assert np.abs(other.poses - backend.poses).max() > 0.1
    mine = {edit.pair for edit in lies}
    found = {edge.pair: edge.verdict for edge in other.edges if edge.pair not in mine}
    assert found == {edge.pair: edge.verdict for edge in backend.edges if edge.pair not in mine}
    for edit in lies:
        backend.apply(edit)
    for count in (last, last - 3, walked.halfway + 3, last):
        for one in (backend, other):
            one.go_to(count)
        assert same(backend.edges, other.edges)
        assert backend.poses.tobytes() == other.poses.tobytes()
    other.close()


def test_a_loop_by_hand_waits_again_when_its_keyframe_is_forgotten(walked: Walked, backend: LoopBackend) -> None:
    backend.apply(Add(3, 100, rows(np.eye(4)), register=False))
    backend.go_to(100)
    assert (3, 100) not in {edge.pair for edge in backend.edges}, "there is no keyframe 100 yet"
    assert backend.edits.done == (Add(3, 100, rows(np.eye(4)), register=False),)
    backend.forget()
    for keyframe in walked.keyframes[100:110]:
        backend.add(keyframe, PARAMS)
    assert (3, 100) in {edge.pair for edge in backend.edges}


def test_a_loop_by_hand_is_measured_again_where_the_walk_goes_on_differently(walked: Walked) -> None:
    begin, one_way = walked.keyframes[:8], walked.keyframes[8:16]
    aside = lie.transform(np.eye(3), np.array([0.0, 0.2, 0.1]))
    another = tuple(replace(keyframe, T_odom_imu=keyframe.T_odom_imu @ aside) for keyframe in one_way)
    edits = Edits((Add(0, 5, rows(np.eye(4)), register=False),))
    backends = [drive(begin + way, PARAMS) for way in (one_way, another)]
    for backend in backends:
        backend.load(edits)
    there, fresh = ({edge.pair: edge for edge in backend.edges}[0, 5].evidence for backend in backends)
    assert there != fresh
    backends[0].go_to(8)
    for keyframe in another:
        backends[0].add(keyframe, PARAMS)
    backends[0].finish()
    assert {edge.pair: edge for edge in backends[0].edges}[0, 5].evidence == fresh


def test_with_every_loop_rejected_the_map_is_the_odometry(walked: Walked, backend: LoopBackend) -> None:
    for edge in accepted(backend):
        backend.apply(Reject(edge.older, edge.newer))
    np.testing.assert_allclose(backend.poses, [k.T_odom_imu for k in walked.keyframes], atol=1e-9)
    assert all(
        edge.edited and "manually" in edge.reason for edge in backend.edges if edge.pair in backend_pairs(backend)
    )


def backend_pairs(backend: LoopBackend) -> set[tuple[int, int]]:
    return {(command.older, command.newer) for command in backend.edits.done}


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


# --- all at once ---------------------------------------------------------------------------------
def cost(residuals: tuple[FactorResidual, ...]) -> float:
    return sum(factor.cost for factor in residuals)


def test_solved_at_once_a_graph_of_which_a_window_is_kept_comes_to_the_optimum_too(walked: Walked) -> None:
    backend = drive(walked.keyframes, PARAMS.model_copy(update={"window": 20}))
    before, left = backend.poses, backend.factor_residuals()
    tried = backend.preview(Solve())
    assert backend.poses.tobytes() == before.tobytes()
    assert cost(tried.residuals) < 0.5 * cost(left)
    backend.apply(Solve())
    assert backend.poses.tobytes() == tried.poses.tobytes()
    np.testing.assert_allclose(backend.corrections @ odometry(walked), backend.poses, atol=1e-9)
    factors, best = backend._factors(backend.by_pair), cost(backend.factor_residuals())
    rng = np.random.default_rng(1)
    for size in (1e-3, 1e-4):
        for _ in range(20):
            aside = lie.exp_se3(rng.normal(0, size, (len(before), 6)))
            aside[0] = np.eye(4)
            assert cost(residuals(factors, backend.poses @ aside)) > best
    backend.load(backend.edits.undo())
    assert backend.poses.tobytes() == before.tobytes()
    backend.close()


def odometry(walked: Walked) -> F64:
    return np.array([keyframe.T_odom_imu for keyframe in walked.keyframes])


def test_a_graph_that_can_not_be_solved_at_once_stays_as_it_is_and_that_is_said_once(
    backend: LoopBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ArithmeticError("Indeterminant linear system")

    monkeypatch.setattr("app.slam.loops.pose_graph.optimise", fail)
    before = backend.poses
    backend.apply(Solve())
    assert backend.poses.tobytes() == backend.poses.tobytes() == before.tobytes()
    (notice,) = backend.take_notices()
    assert "Indeterminant" in notice


# --- one loop ------------------------------------------------------------------------------------
def test_a_heavier_loop_is_met_better(backend: LoopBackend) -> None:
    def left(backend: LoopBackend) -> float:
        return next(r.translation for r in backend.factor_residuals() if r.loop and r.pair == pair)

    held = {edge.pair for edge in accepted(backend) if not edge.open}
    pair = max((r for r in backend.factor_residuals() if r.pair in held), key=lambda r: r.translation).pair
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
    assert backend.edits == Edits()
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
    backend.load(backend.edits.undo())
    assert backend.poses.tobytes() == walked.poses[walked.halfway - 1].tobytes()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (Add(5, 5), "cannot be tied together"),
        (Accept(7, 3), "cannot be tied together"),
        (Reject(-1, 3), "cannot be tied together"),
        (Add(0, 30, ((1.0,),)), "4x4"),
        (Add(0, 30, rows(np.diag([1.0, 1.0, -1.0, 1.0]))), "rigid"),  # a mirror
        (Add(0, 30, rows(np.diag([1.1, 1.1, 1.1, 1.0]))), "rigid"),
        (Add(0, 30, rows(np.eye(4) + np.eye(4)[[3, 0, 1, 2]])), "rigid"),
    ],
)
def test_a_command_that_never_makes_sense_is_refused_and_changes_nothing(
    backend: LoopBackend, command: LoopEdit, message: str
) -> None:
    with pytest.raises(HemislamError, match=message):
        backend.apply(command)
    with pytest.raises(HemislamError, match=message):
        backend.load(Edits((SetWeight(1, 2, 3.0), command)))
    assert backend.edits == Edits()


@pytest.mark.parametrize(
    ("command", "message"), [(Accept(1, 2), "no loop candidate of keyframes 1 and 2"), (Add(0, 10_000), "of the")]
)
def test_what_is_not_there_can_not_be_tried_out(backend: LoopBackend, command: LoopEdit, message: str) -> None:
    with pytest.raises(HemislamError, match=message):
        backend.preview(command)


def test_a_weight_must_be_positive(backend: LoopBackend) -> None:
    for weight in (0.0, -1.0, float("nan")):
        with pytest.raises(HemislamError, match="greater than 0"):
            backend.apply(SetWeight(*backend.edges[0].pair, weight))


def test_loops_next_to_one_another_are_one_factor_and_rejecting_it_hands_over_to_the_others(
    walked: Walked, backend: LoopBackend
) -> None:
    loops = accepted(backend)
    counting = {edge.pair for edge in loops if edge.counts}
    assert len(counting) < len(loops) / 2
    for edge in loops:
        near = {  # one that leaves a direction open does not stand for one that does not
            pair
            for pair in counting - {edge.pair}
            if edge.open == backend.by_pair[pair].open
            and max(abs(pair[0] - edge.older), abs(pair[1] - edge.newer)) <= PARAMS.submap_keyframes // 2
        }
        assert edge.counts or edge.represented_by in counting
        assert not (edge.counts and near), "two factors that share most of their points"
    first = next(edge.represented_by for edge in loops if edge.represented_by)
    behind = {edge.pair for edge in loops if edge.represented_by == first}
    backend.apply(Reject(*first))
    assert {edge.pair for edge in accepted(backend) if edge.counts} == counting - {first} | behind
    backend.apply(SetWeight(*max(behind), 2.0))
    backend.load(backend.edits.undo())
    backend.load(backend.edits.undo())
    assert same(backend.edges, walked.edges[-1])
    word = max(edge.pair for edge in loops if not edge.counts)
    assert applied(backend, SetWeight(*word, 2.0)).counts, "what the user has a word on is a factor"
