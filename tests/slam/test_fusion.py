"""The outcomes of fusing a prediction with a scan. test_iekf, test_coast and test_engine_trouble test the accuracy."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.slam import iekf
from app.slam.fusion import Fused, fuse
from app.slam.imu import DIM, Belief, Path
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.prediction import Prediction
from app.slam.sections import MapParams
from app.slam.types import Registration, Scan

from .scenes import Scene, box, furnished_room
from .updates import points_of, surveyed, truth, uncertain


def fused(belief: Belief, local_map: LocalMap, scene: Scene | None = None) -> Fused:
    points = points_of(scene or furnished_room())
    scan = Scan(0, points, *(np.zeros(len(points), kind) for kind in (np.int32, np.float32, np.uint16)))
    path = Path(np.array([-0.1, 0.0]), np.tile(np.eye(4)[:3], (2, 1, 1)))
    begin = replace(belief, state=replace(belief.state, stamp_ns=belief.state.stamp_ns - 100_000_000))
    prediction = Prediction(begin, belief, path, gap=False, course=None)
    return fuse(prediction, scan, points, points, np.arange(len(points)), local_map, Params())


def test_a_scan_that_fits_only_as_predicted_is_not_fused_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """It contradicts the IMU; with the speed open, it meets too few planes."""
    belief, room, real, done = Belief(truth(), uncertain()), surveyed(furnished_room()), iekf.update, []

    def update(prior: Belief, *rest: Any) -> tuple[Belief, Registration]:
        posterior, registration = real(prior, *rest)
        done.append(posterior)
        if len(done) == 1:
            return posterior, replace(registration, surprise=2 * iekf.SURPRISING)
        return prior, iekf.too_few(2, registration.used, 20, registration.matches)

    monkeypatch.setattr(iekf, "update", update)
    outcome = fused(belief, room)
    assert len(done) == 2 and not outcome.lost
    assert np.array_equal(outcome.belief.state.T_odom_imu, done[0].state.T_odom_imu)


def test_a_person_ahead_does_not_take_the_walk_along_a_street_once_its_walls_contradict_the_imu() -> None:
    """They contradict it by 0.05 m across. Along the street only the person shows anything, and has walked on by 4 cm
    since the map was made; the IMU knows that way to 2 mm."""
    walls = (box(-90.0, 2.0, -1.3, 90.0, 3.0, 4.0), box(-90.0, -3.0, -1.3, 90.0, -2.0, 4.0))
    then, now = (
        Scene(None, (*walls, box(x, -0.3, -1.3, x + 0.3, 0.3, 0.4)), (np.array([0.0, 0.0, 1.0]), -1.3))
        for x in (2.0, 2.04)
    )
    covariance = uncertain(rotation=0.002, position=0.01)
    covariance[3, 3] = 0.002**2
    predicted = replace(truth(), p_odom_imu=truth().p_odom_imu + np.array([0.0, 0.05, 0.0]))
    outcome = fused(Belief(predicted, covariance), surveyed(then), now)
    along, across, _ = np.abs(outcome.belief.state.p_odom_imu - truth().p_odom_imu)
    assert outcome.registration.surprise > iekf.SURPRISING
    assert across < 0.005
    assert along < 0.01


@pytest.mark.parametrize("covariance", [np.zeros((DIM, DIM)), np.full((DIM, DIM), np.nan)], ids=["singular", "nan"])
def test_after_a_numerical_failure_the_prediction_stands_and_the_frame_is_lost(covariance: np.ndarray) -> None:
    room = surveyed(furnished_room())
    failed, good = fused(Belief(truth(), covariance), room), fused(Belief(truth(), uncertain()), room)
    first = fused(Belief(truth(), uncertain()), LocalMap(MapParams()))
    assert failed.lost and np.array_equal(failed.belief.state.T_odom_imu, truth().T_odom_imu)
    assert failed.registration.inliers == 0 and failed.registration.reason == "the update gave no finite pose"
    assert not good.lost and good.registration.inliers > iekf.MIN_INLIERS
    assert not first.lost and first.registration.reason == "the map is still empty; this scan begins it"
