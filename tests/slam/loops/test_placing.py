"""Places are registered without a good guess, and places that fit in two ways are detected.

Tests app/slam/loops/plan.py.
"""

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.detection import FAR_M, Detector
from app.slam.loops.drift import Deviation
from app.slam.loops.placing import Placement, place
from app.slam.loops.plan import EVERYWHERE, Window, placements
from app.slam.loops.verification import Prepared
from app.slam.sections import LoopsParams
from app.slam.types import F64, Cloud, Keyframe
from tests.slam.loops.test_verification import FINS, corridor, pose, seen, wall

EVEN = tuple(np.repeat(np.arange(-14.0, 14.0, 4.0), 2))


def square(rng: np.random.Generator) -> F64:
    """A place under the open sky: sloping ground, two houses, a fence and eight trunks, none like another."""
    ground = np.column_stack([rng.uniform(-18, 18, (14_000, 2)), np.zeros(14_000)])
    parts = [ground, wall((-9.0, 12.0), (3.0, 13.0), rng, 5.0), wall((3.0, 13.0), (4.0, 17.0), rng, 5.0)]
    parts += [wall((10.0, -16.0), (13.0, -4.0), rng, 4.0), wall((-15.0, -8.0), (-12.0, 1.0), rng, 1.9)]
    for x, y in ((-6, -5), (2, -9), (7, 3), (-3, 6), (-8, -12), (14, 8), (5, -3), (-11, 7)):
        turn, height = rng.uniform(0, 2 * np.pi, 200), rng.uniform(-1.2, 2.5, 200)
        parts.append(np.column_stack([x + 0.25 * np.cos(turn), y + 0.25 * np.sin(turn), height]))
    points = np.vstack(parts)
    points[:, 2] += 0.06 * points[:, 0] - 1.2 * (np.arange(len(points)) < len(ground))
    return np.asarray(points + rng.normal(scale=0.01, size=points.shape))


def laid(target: Prepared, source: Prepared, guess: F64, window: Window, allowed_m: float = 100.0) -> Placement:
    """Odometry allows all that is within `allowed_m` of its guess along x."""
    return place(
        target,
        source,
        guess,
        window,
        lambda T: Deviation(abs(float(T[0, 3] - guess[0, 3])), 0.0, 0.0),
        most_sigmas=allowed_m,
        most_slide=0.05,
    )


@pytest.mark.parametrize("heading", [0.0, 75.0, 140.0, -160.0, -60.0])
@pytest.mark.parametrize("way", [0.4, 2.5, 4.6])
def test_a_place_is_found_from_ten_metres_off_whatever_the_heading(heading: float, way: float) -> None:
    truth = pose(1.5, -1.0, 0.1, 20.0)
    target = seen(square(np.random.default_rng(0)), np.eye(4))
    source = seen(square(np.random.default_rng(1)), truth)
    guess = pose(1.5 + 10 * np.cos(way), -1.0 + 10 * np.sin(way), 0.8, 20.0 + heading)
    found = laid(target, source, guess, EVERYWHERE)
    missed = lie.inverse(truth) @ found.fit.T_target_source
    assert np.linalg.norm(missed[:3, 3]) < 0.03
    assert np.degrees(np.linalg.norm(lie.log(missed[:3, :3]))) < 0.2
    assert found.open is None and found.alternative_m == np.inf


def test_the_search_gives_the_same_to_the_last_bit() -> None:
    target = seen(square(np.random.default_rng(0)), np.eye(4))
    source = seen(square(np.random.default_rng(1)), pose(1.5, -1.0, 0.1, 20.0))
    one, two = (placements(target, source, pose(6.0, 3.0, 0.0, 80.0), EVERYWHERE) for _ in range(2))
    assert np.array(one).tobytes() == np.array(two).tobytes()


def test_heights_follow_from_the_ground() -> None:
    target = seen(square(np.random.default_rng(0)), np.eye(4))
    source = seen(square(np.random.default_rng(1)), pose(0.0, 0.0, 0.7, 0.0))
    likeliest = placements(target, source, pose(0.0, 0.0, -2.0, 0.0), Window(2.0, 0.2))[0]
    assert likeliest[2, 3] == pytest.approx(0.7, abs=0.05)


def test_a_bare_corridor_holds_across_and_leaves_the_way_along_it_to_odometry() -> None:
    target = seen(corridor(np.random.default_rng(0)), np.eye(4))
    source = seen(corridor(np.random.default_rng(1)), np.eye(4))
    found = laid(target, source, pose(0.7, 0.3, 0.1, 3.0), Window(3.0, 0.3))
    assert found.open is not None and abs(found.open[0]) > 0.99
    assert not found.loose
    x, y, z = found.fit.T_target_source[:3, 3]
    assert x == pytest.approx(0.7, abs=0.02)
    assert max(abs(y), abs(z)) < 0.03
    assert found.alternative_m == np.inf, "other places along it are the same one"


def test_where_fins_repeat_another_place_one_period_away_fits_unless_odometry_rules_it_out() -> None:
    target = seen(corridor(np.random.default_rng(0), EVEN), np.eye(4))
    source = seen(corridor(np.random.default_rng(1), EVEN), np.eye(4))
    window = Window(6.0, 0.2)
    assert laid(target, source, np.eye(4), window).alternative_m == pytest.approx(4.0, abs=0.1)
    assert laid(target, source, np.eye(4), window, allowed_m=3.0).alternative_m == np.inf
    assert laid(target, source, np.eye(4), Window(0.0, 0.2)).alternative_m == np.inf


def test_of_two_places_that_fit_odometry_has_the_choice() -> None:
    target = seen(corridor(np.random.default_rng(0), EVEN), np.eye(4))
    source = seen(corridor(np.random.default_rng(1), EVEN), np.eye(4))
    found = laid(target, source, pose(3.1, 0.0, 0.0, 0.0), Window(6.0, 0.2), allowed_m=2.0)
    assert found.fit.T_target_source[0, 3] == pytest.approx(4.0, abs=0.05)
    assert found.deviation.sigmas < 1.0


def test_what_is_against_odometry_is_looked_for_beyond_what_odometry_allows() -> None:
    """Odometry slipped by 4.6 m between two places that look the same, and the search near it meets only one."""
    once = square(np.random.default_rng(0))
    target = seen(np.vstack([once, once + np.array([6.0, 0.0, 0.36])]), np.eye(4))
    source = seen(square(np.random.default_rng(1)), np.eye(4))
    found = laid(target, source, pose(4.6, 0.0, 0.3, 0.0), Window(2.0, 0.2), allowed_m=1.0)
    assert found.deviation.sigmas > 1.0
    assert found.alternative_m == pytest.approx(6.0, abs=0.1)


def test_where_nothing_repeats_no_other_place_fits() -> None:
    target = seen(corridor(np.random.default_rng(0), FINS), np.eye(4))
    source = seen(corridor(np.random.default_rng(1), FINS), np.eye(4))
    assert laid(target, source, np.eye(4), Window(6.0, 0.2)).alternative_m == np.inf


def test_places_that_share_nothing_do_not_fit_rather_than_fail() -> None:
    """Where no point has a partner there is no residual, and so nothing to compare alignments by."""
    target = seen(square(np.random.default_rng(0)), np.eye(4))
    source = seen(square(np.random.default_rng(1)), np.eye(4))
    found = laid(target, source, pose(500.0, 0.0, 0.0, 0.0), Window(0.0, 0.0))
    assert found.fit.overlap == 0.0 and np.isnan(found.fit.residual_rms)
    assert found.alternative_m == np.inf


def plaza(rng: np.random.Generator, houses: list[tuple[tuple[float, float], tuple[float, float]]]) -> F64:
    """A level floor, and far from its middle the walls of houses."""
    floor = np.column_stack([rng.uniform(-16, 16, (9_000, 2)), np.full(9_000, -1.2)])
    points = np.vstack([floor, *(wall(*house, rng, 6.0) for house in houses)])
    return np.asarray(points + rng.normal(scale=0.01, size=points.shape))


def both(there: F64, here: F64, T_there_here: F64) -> tuple[Prepared, Prepared]:
    """The submaps of two keyframes that saw these points, given where the first one was."""
    detector = Detector(LoopsParams(submap_keyframes=0))
    for index, points in enumerate((there, lie.moved(lie.inverse(T_there_here), here))):
        n = len(points)
        cloud = Cloud(points.astype(np.float32), np.zeros(n, np.uint8), np.zeros(n, np.float32), np.zeros(n, np.uint16),
            np.zeros(n, np.int32))  # fmt: skip
        detector.take(Keyframe(index, index, index, np.eye(4), np.eye(4), np.eye(6), cloud))
    return detector.both(0, 1)


def test_a_bare_plaza_is_held_by_the_houses_around_it() -> None:
    houses = [((-20.0, 27.0), (5.0, 29.0)), ((7.0, 26.0), (22.0, 25.0)), ((26.0, -18.0), (28.0, 9.0)),
        ((-27.0, -9.0), (-26.0, 16.0)), ((-14.0, -26.0), (12.0, -28.0)), ((-27.0, -9.0), (-31.0, -9.5))]  # fmt: skip
    truth = pose(1.5, -1.0, 0.0, 25.0)
    there, here = (plaza(np.random.default_rng(seed), houses) for seed in range(2))
    target, source = both(there, here, truth)
    found = laid(target, source, pose(3.5, -2.5, 0.3, 20.0), Window(4.0, 0.2))
    assert np.linalg.norm(found.fit.T_target_source[:3, 3] - truth[:3, 3]) < 0.05
    assert found.open is None
    assert source.submap.reach == FAR_M


def test_equal_houses_along_a_wide_avenue_leave_the_way_along_it_open_or_ambiguous() -> None:
    """They are 6 m wide; a bay of 1 m lies between any two. The end of the avenue is out of sight."""
    fronts = [((x, side * 27.0), (x + 5.0, side * 27.0)) for x in np.arange(-45.0, 45.0, 6.0) for side in (-1, 1)]
    bays = [((x, side * 27.0), (x, side * 29.0)) for x in np.arange(-45.0, 45.0, 6.0) for side in (-1, 1)]
    there, here = (plaza(np.random.default_rng(seed), fronts + bays) for seed in range(2))
    target, source = both(there, here, pose(0.5, 0.0, 0.0, 0.0))
    found = laid(target, source, pose(3.2, 0.0, 0.0, 0.0), Window(7.0, 0.1))
    assert target.submap.reach == FAR_M
    assert found.open is not None or found.alternative_m < 7.0
