"""What comes of a prediction and a scan. How exact it is: test_iekf, test_coast and test_engine_trouble."""

import numpy as np
import pytest

from app.slam import iekf
from app.slam.fusion import fuse
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

    def fused(covariance: np.ndarray, local_map: LocalMap) -> tuple[Belief, str, int]:
        belief = Belief(truth(), covariance)
        motion = Prediction(belief, belief, path, gap=False, course=None)
        found = fuse(motion, scan, points, points, np.arange(len(points)), local_map, Params())
        return found.belief, found.registration.reason, found.registration.inliers

    belief, reason, inliers = fused(covariance, room)
    assert np.array_equal(belief.state.T_odom_imu, truth().T_odom_imu) and inliers == 0
    assert reason == "the update gave no finite pose"
    assert fused(uncertain(), room)[2] > iekf.MIN_INLIERS
    assert fused(uncertain(), LocalMap(MapParams()))[1] == "the map is still empty; this scan begins it"
