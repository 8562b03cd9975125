"""Compares a scan with the map and corrects what was predicted (paper 2.3, eq. 5-7).

Where the IMU tells how the device moved during the scan, the filter estimates the pose at its end (`iekf`). Otherwise
the scan determines its own motion too (`coast`).

If the speed is unknown when a map begins, the first scan in it is bent. The next scan is bent alike and fits the first
as a rigid body. If this fit determines the speed in all directions, the second scan is straightened and begins the map
anew.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from app.slam import coast, iekf, imu
from app.slam.coast import Course
from app.slam.imu import VEL, Belief
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.prediction import Prediction
from app.slam.types import F32, I32, Registration, Scan
from app.slam.voxel import spread

NOT_REGISTERED = Registration(
    False, 0, 0, 0, float("nan"), np.full(6, np.nan), False, "the map is still empty; this scan begins it"
)

BETTER, SAME_PART = 0.5, 0.9
"""If a scan contradicts the IMU and is fused again without it, the map may fit better: with at most this share of the
residuals and at least this share of the points. Then the IMU was wrong about the whole scan: it was knocked, or froze.
"""

TOLD = 0.5
"""m/s: if the speed is known better than this, scans have determined it. A start in motion assumes three times this."""


@dataclass(frozen=True, slots=True)
class Fused:
    """Attributes:
    belief: at the scan's end. registration: how it went.
    points: (n, 3) m, the scan, deskewed. sampled: (m, 3) m, those that enter the map; both in the LiDAR frame.
    lost: whether the pose is a guess: the scan met too few planes, or nothing measures the speed any more.
    imu_wrong: whether the scan shows that the IMU was wrong about how the device moved during it.
    bent: whether the points were deskewed at an unknown speed and begin the map.
    anew: whether the map held such points and is to begin anew with these.
    """

    belief: Belief
    registration: Registration
    points: F32
    sampled: F32
    lost: bool = False
    imu_wrong: bool = False
    bent: bool = False
    anew: bool = False

    @property
    def residual(self) -> float:
        """m, RMS distance of the points from the map; 0 if they met too few planes."""
        return float(np.nan_to_num(self.registration.residual_rms))


def fuse(
    prediction: Prediction,
    scan: Scan,
    points: F32,
    sampled: F32,
    source: I32,
    local_map: LocalMap,
    params: Params,
    alike: Prediction | None = None,
) -> Fused:
    """The prediction, corrected by a scan; unchanged if the map is empty or the scan matches too little of it.

    Args:
        scan: as measured. points: (n, 3) m, deskewed by the prediction.
        sampled: (m, 3) m, the same, thinned. source: (m,) which points of the scan these are nearest to.
        alike: if the map holds one bent scan, the same prediction, but with the pose where that scan ended as known.
    """
    if not local_map.voxels:
        unknown = prediction.covered and coast.is_unsure(prediction.belief)
        fused = Fused(prediction.belief, NOT_REGISTERED, points, sampled, bent=unknown)
    elif straight := _straight(alike, scan, sampled, source, local_map, params):
        fused = straight
    elif prediction.course is None:
        fused = Fused(*_with_imu(prediction, sampled, local_map, params), points, sampled)
        if fused.registration.surprise > iekf.SURPRISING and prediction.evenly is not None:
            fused = _better(fused, prediction.evenly(), scan, source, local_map, params)
    else:
        fused = _by_scan(prediction, prediction.course, scan, source, local_map, params)
    belief = imu.after_gap(fused.belief, prediction.begin) if prediction.gap else fused.belief
    if iekf.is_imu_to_blame(fused.registration):
        belief = imu.with_open_biases(belief)
    too_few = local_map.voxels > 0 and fused.registration.inliers < iekf.MIN_INLIERS
    return replace(fused, belief=belief, lost=fused.lost or too_few)


def _with_imu(prediction: Prediction, sampled: F32, local_map: LocalMap, params: Params) -> tuple[Belief, Registration]:
    begin, predicted = prediction.begin.state, prediction.belief
    chosen = spread(sampled, params.filter.max_points, params.scan.voxel_size)
    posterior, registration = _attempted(predicted, partial(iekf.update, predicted, chosen, local_map, params.filter))
    change = float(np.linalg.norm(predicted.state.v_odom_imu - begin.v_odom_imu))
    correction = float(np.linalg.norm(posterior.state.v_odom_imu - predicted.state.v_odom_imu))
    registration = replace(registration, predicted_change=change, correction=correction)
    if registration.surprise > iekf.SURPRISING:  # once more, from a prediction that is less sure
        opened = imu.with_open_motion(predicted, registration.surprise)
        again, of_it = _attempted(predicted, partial(iekf.update, opened, chosen, local_map, params.filter))
        posterior = again if of_it.inliers >= iekf.MIN_INLIERS else posterior
    return posterior, registration


def _by_scan(
    prediction: Prediction, course: Course, scan: Scan, source: I32, local_map: LocalMap, params: Params
) -> Fused:
    """The scan fused by `coast`. It takes the measured points, since centroids have no time."""
    refines = params.filter.estimate_extrinsics and not prediction.gap
    update = partial(coast.update, prediction.belief, scan.part(source), course, local_map, params.filter, refines)
    posterior, registration = _attempted(prediction.belief, update)
    points = coast.deskew(scan, posterior.state, course)
    adrift = not prediction.covered and registration.degenerate and coast.is_adrift(posterior)
    if adrift:
        why = "there is no IMU" if prediction.path is None else "the IMU is silent"
        registration = replace(registration, reason=f"{registration.reason}, and {why}")
    return Fused(posterior, registration, points, points[source], lost=adrift)


def _straight(
    alike: Prediction | None, scan: Scan, sampled: F32, source: I32, local_map: LocalMap, params: Params
) -> Fused | None:
    """The scan, straightened by the speed that follows from matching it to a map that is bent alike.

    None if the map is not bent, or if some direction of the speed stays a guess.
    """
    if alike is None or alike.path is None or alike.gap:
        return None
    chosen = spread(sampled, params.filter.max_points, params.scan.voxel_size)
    update = partial(iekf.update, alike.belief, chosen, local_map, params.filter)
    posterior, registration = _attempted(alike.belief, update)
    if np.linalg.eigvalsh(posterior.covariance[VEL, VEL])[-1] > TOLD**2:
        return None
    points = coast.deskew(scan, posterior.state, Course.measured(alike.path, alike.belief.state))
    at_begin = imu.at_map_begin(posterior, params.filter.estimate_extrinsics)
    return Fused(at_begin, registration, points, points[source], anew=True)


def _better(fused: Fused, even: Prediction, scan: Scan, source: I32, local_map: LocalMap, params: Params) -> Fused:
    """The scan fused without the motion that the IMU measured during it, if it then fits the map much better."""
    assert even.course is not None
    again = _by_scan(even, even.course, scan, source, local_map, params)
    first, second = fused.registration, again.registration
    worse = second.inliers * first.used < SAME_PART * first.inliers * second.used
    if again.lost or worse or not second.residual_rms < BETTER * first.residual_rms:
        return fused
    told = {name: getattr(first, name) for name in ("predicted_change", "correction", "surprise")}
    belief = imu.after_gap(again.belief, even.begin)
    return replace(again, belief=belief, registration=replace(second, **told), imu_wrong=True)


def _attempted(predicted: Belief, update: Callable[[], tuple[Belief, Registration]]) -> tuple[Belief, Registration]:
    """The result of the update; after a numerical failure, the prediction stands and the frame is lost."""
    with contextlib.suppress(np.linalg.LinAlgError):
        posterior, registration = update()
        if np.isfinite(posterior.covariance).all() and np.isfinite(posterior.state.T_odom_imu).all():
            return posterior, registration
    return predicted, replace(NOT_REGISTERED, reason="the update gave no finite pose")
