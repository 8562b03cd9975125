"""What comes of a prediction and a scan. How exact it is: test_iekf, test_coast and test_engine_trouble."""

import numpy as np
import pytest

from app.slam import iekf
from app.slam.fusion import Fused, fuse
from app.slam.imu import DIM, Belief, Path
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.prediction import Prediction
from app.slam.sections import MapParams
from app.slam.types import Scan

from .scenes import furnished_room
from .updates import points_of, surveyed, truth, uncertain


@pytest.mark.parametrize("covariance", [np.zeros((DIM, DIM)), np.full((DIM, DIM), np.nan)], ids=["singular", "nan"])
def test_after_a_numerical_failure_the_prediction_stands_and_the_frame_is_lost(covariance: np.ndarray) -> None:
    points, room = points_of(furnished_room()), surveyed(furnished_room())
    scan = Scan(0, points, *(np.zeros(len(points), kind) for kind in (np.int32, np.float32, np.uint16)))
    path = Path(np.array([-0.1, 0.0]), np.tile(np.eye(4)[:3], (2, 1, 1)))

    def fused(covariance: np.ndarray, local_map: LocalMap) -> Fused:
        belief = Belief(truth(), covariance)
        prediction = Prediction(belief, belief, path, gap=False, course=None)
        return fuse(prediction, scan, points, points, np.arange(len(points)), local_map, Params())

    failed, good, first = fused(covariance, room), fused(uncertain(), room), fused(uncertain(), LocalMap(MapParams()))
    assert failed.lost and np.array_equal(failed.belief.state.T_odom_imu, truth().T_odom_imu)
    assert failed.registration.inliers == 0 and failed.registration.reason == "the update gave no finite pose"
    assert not good.lost and good.registration.inliers > iekf.MIN_INLIERS
    assert not first.lost and first.registration.reason == "the map is still empty; this scan begins it"
