"""Where the device is expected at a scan's end, before the scan is compared with the map."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from app.slam import coast, imu, rest
from app.slam.coast import Course
from app.slam.imu import Belief, Path
from app.slam.sections import ImuParams
from app.slam.types import F32, ImuSamples, Scan


@dataclass(frozen=True, slots=True)
class Prediction:
    """Attributes:
    begin: the belief from which it was made. belief: the one at the scan's end.
    path: by the IMU in between; None without samples. gap: whether the samples have one.
    course: set if the scan itself has to tell how the device moved; None if the IMU tells it.
    evenly: makes the prediction to use if the scan shows that the IMU was wrong; None unless the IMU tells the course.
    """

    begin: Belief
    belief: Belief
    path: Path | None
    gap: bool
    course: Course | None
    evenly: "Callable[[], Prediction] | None" = None

    @property
    def covered(self) -> bool:
        """Whether samples cover the scan, without a gap."""
        return self.path is not None and not self.gap

    def deskew(self, scan: Scan) -> F32:
        """(n, 3) float32 m, all points in the LiDAR frame at the scan's end."""
        if self.path is not None:
            return imu.deskew(scan, self.path, self.belief.state)
        assert self.course is not None
        return coast.deskew(scan, self.belief.state, self.course)


def predict(belief: Belief, samples: ImuSamples, end_ns: int, params: ImuParams, clock_sigma: float) -> Prediction:
    """Carry a belief forward to a scan's end: by the IMU, or without samples at the present rates.

    Args:
        clock_sigma: s, how well the offset of the IMU's clock is known.
    """
    if not len(samples):
        course = Course.steady(belief.state.stamp_ns, end_ns)
        return Prediction(belief, coast.propagate(belief, end_ns, course), None, False, course)
    gap = imu.longest_gap(samples, end_ns) > params.max_gap
    predicted, path = imu.propagate(imu.before_gap(belief) if gap else belief, samples, end_ns, params, clock_sigma)
    if gap or coast.is_unsure(predicted):
        return Prediction(belief, predicted, path, gap, Course.measured(path, predicted.state))
    evenly = partial(_evenly, belief, samples, end_ns, params, clock_sigma)
    return Prediction(belief, rest.hold(predicted, samples), path, gap, None, evenly)


def _evenly(belief: Belief, samples: ImuSamples, end_ns: int, params: ImuParams, clock_sigma: float) -> Prediction:
    """As `predict`, but at the median of the samples' rates, and as if there were a gap."""
    gyro, accel = (np.tile(np.median(values, axis=0), (2, 1)) for values in (samples.gyro, samples.accel))
    steady = ImuSamples(samples.stamps_ns[[0, -1]], gyro, accel)
    predicted, path = imu.propagate(imu.before_gap(belief), steady, end_ns, params, clock_sigma)
    return Prediction(belief, predicted, path, True, Course.measured(path, predicted.state))
