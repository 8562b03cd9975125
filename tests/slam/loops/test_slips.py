"""A slip of the odometry is detected where it occurs, and no submap extends across it.

Tests app/slam/loops/slips.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.detection import Detector, Sighting
from app.slam.loops.search import Search
from app.slam.loops.slips import BREAK_M, REACH, Slip, slip
from app.slam.loops.types import Evidence, LoopEdge, Verdict
from app.slam.sections import LoopsParams
from app.slam.types import F64, Cloud, Keyframe
from tests.slam.loops.test_verification import FINS, corridor, pose, seen
from tests.slam.loops.walks import Walk, take

AT, HALF = 12, 5


@pytest.mark.parametrize(
    "moved", [pose(0.2, 0.0, 0.0, 0.0), pose(0.0, 0.2, 0.0, 0.0), pose(0.0, 0.0, 0.15, 0.0), pose(0.0, 0.0, 0.0, 1.5)]
)
def test_between_surfaces_that_hold_every_slip_shows_as_large_as_it_is(moved: F64) -> None:
    before = seen(corridor(np.random.default_rng(0), FINS), np.eye(4))
    found = slip(before, seen(corridor(np.random.default_rng(1), FINS), moved), np.eye(4))
    assert found is not None
    np.testing.assert_allclose(found.moved, np.concatenate([lie.log(moved[:3, :3]), moved[:3, 3]]), atol=0.02)
    assert not found.is_break
    assert slip(before, seen(corridor(np.random.default_rng(1), FINS), np.eye(4)), np.eye(4)) is None


def test_along_a_bare_corridor_no_slip_can_be_reported() -> None:
    before = seen(corridor(np.random.default_rng(0)), np.eye(4))
    assert slip(before, seen(corridor(np.random.default_rng(1)), pose(0.3, 0.0, 0.0, 0.0)), np.eye(4)) is None


def test_a_slip_is_a_break_only_where_both_sides_coincide() -> None:
    """Where the walk turns into another corridor, registration may slide as far, onto a few surfaces of the old one."""
    before, turned, slid = (
        seen(corridor(np.random.default_rng(0), FINS), np.eye(4)),
        pose(0, 0, 0, 20),
        pose(0, 0, 0, 70),
    )
    broken = slip(before, seen(corridor(np.random.default_rng(1), FINS), turned), np.eye(4))
    assert broken is not None and broken.is_break
    other = corridor(np.random.default_rng(1), (-4.0, -2.0, 1.0, 5.0), length=20.0) @ slid[:3, :3].T
    found = slip(before, seen(other, np.eye(4)), np.eye(4))
    assert found is not None and np.linalg.norm(found.moved[3:]) > BREAK_M and not found.is_break


@pytest.fixture(scope="module")
def straight() -> Walk:
    return take("corridor", 24.0)


def walked(keyframes: tuple[Keyframe, ...]) -> Detector:
    detector = Detector(LoopsParams(submap_keyframes=HALF))
    for keyframe in keyframes:
        detector.take(keyframe)
    return detector


def seen_from(detector: Detector, index: int) -> set[int]:
    """Keyframes from which the submap about one was seen."""
    positions = detector.poses[:, :3, 3] - detector.poses[index, :3, 3]
    eyes = np.unique(detector.submap(index).submap.eyes, axis=0)
    return {int(np.linalg.norm(positions - eye, axis=1).argmin()) for eye in eyes}


def torn(walk: Walk) -> tuple[Keyframe, ...]:
    """The same with odometry that slips on the step to keyframe AT."""
    slipped = pose(0.3, -0.3, 0.0, 2.5)
    return tuple(
        replace(k, T_odom_imu=slipped @ k.T_odom_imu if k.index >= AT else k.T_odom_imu) for k in walk.keyframes
    )


def test_a_submap_ends_where_odometry_slipped(straight: Walk) -> None:
    """Across the slip it would hold every surface twice."""
    whole, parted = walked(straight.keyframes), walked(torn(straight))
    for index in (AT - HALF, AT - 1, AT, AT + HALF - 1):
        around = set(range(index - HALF, index + HALF + 1))
        assert seen_from(whole, index) == around
        here = {k for k in around if (k < AT) == (index < AT)}
        assert seen_from(parted, index) <= here
    assert seen_from(parted, AT - HALF) >= set(range(AT - 2 * HALF, AT - REACH + 1)), "what lies before it stays whole"
    assert seen_from(parted, AT + HALF - 1) >= set(range(AT + REACH - 1, AT + 2 * HALF)), "and what lies behind it"
    whole.close(), parted.close()


def test_a_submap_does_not_depend_on_how_far_the_walk_went_on(straight: Walk) -> None:
    early, late = walked(straight.keyframes[: AT + HALF + REACH]), walked(straight.keyframes)
    ours, theirs = (detector.submap(AT).submap.points for detector in (early, late))
    assert ours.tobytes() == theirs.tobytes()
    early.close(), late.close()


def test_the_graph_may_bend_where_odometry_slipped_once_that_is_seen(straight: Walk) -> None:
    search = Search()
    for keyframe in torn(straight)[: AT + REACH]:
        search.add(keyframe, LoopsParams())

    def sigma_m(index: int) -> float:
        step = search.measured[index].odometry
        assert step is not None
        return float(np.sqrt(np.trace(step.covariance[3:, 3:])))

    assert sigma_m(AT) > 0.3 and sigma_m(AT - REACH) < 0.03
    search.go_to(AT + REACH - 1)
    assert sigma_m(AT) < 0.03, "it was not seen yet"
    search.close()


def test_an_end_before_a_break_is_seen_knows_nothing_of_it(straight: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether the walk ends there or was taken back to there."""
    told: list[tuple[int, bool]] = []

    def judged(sighting: Sighting, *_: object, broken: bool) -> LoopEdge:
        told.append((sighting.newer, broken))
        return LoopEdge(
            sighting.older, sighting.newer, sighting.newer, np.eye(4), np.eye(6), Evidence(), Verdict.REJECTED, ""
        )

    monkeypatch.setattr("app.slam.loops.search.judge", judged)
    monkeypatch.setattr(Detector, "look", lambda self, newer, *_: [Sighting(0, newer, 0.1)] if newer >= AT else [])
    monkeypatch.setattr(Detector, "slip", lambda self, index: Slip(np.full(6, 0.5), True) if index == AT else None)
    search, end = Search(), AT + REACH - 1
    for keyframe in straight.keyframes:
        search.add(keyframe, LoopsParams(submap_keyframes=2))
    assert (end, True) in told, "once it is seen it counts"
    search.go_to(end)
    told.clear()
    search.finish()
    assert told and not any(broken for _, broken in told)
    search.close()


def test_where_the_scanner_saw_nothing_for_a_while_no_slip_is_reported_and_the_search_goes_on(straight: Walk) -> None:
    search, dark = Search(), range(4, 4 + 3 * REACH)
    for keyframe in straight.keyframes:
        if keyframe.index in dark:
            seen = keyframe.cloud
            nothing = Cloud(seen.points[:0], seen.labels[:0], seen.intensity[:0], seen.ring[:0], seen.offsets_ns[:0])
            keyframe = replace(keyframe, cloud=nothing)
        search.add(keyframe, LoopsParams(submap_keyframes=2, min_time=1.0))
    search.finish()
    assert len(search) == len(straight.keyframes) > dark.stop + REACH
    assert [k for k in range(1, len(search)) if search.detector.slip(k) is not None] == []
    search.close()
