"""How the filter starts: from a rest if there is one, otherwise in motion with a wide covariance."""

from dataclasses import dataclass

import numpy as np

from app.slam import lie, rest
from app.slam.imu import (
    BA,
    BG,
    DIM,
    EXT_POS,
    EXT_ROT,
    GRAV,
    KNOWN,
    POS,
    ROT,
    VEL,
    WALKING,
    Belief,
    at_origin,
    seen_from_the_lidar,
)
from app.slam.params import Params
from app.slam.types import ImuSamples, Scan

LEAST_STILL = 0.3
"""s; a shorter rest does not determine the gyroscope's bias."""
BEFORE_NS = 100_000_000
"""Samples earlier than this before the first scan are ignored: the device may have been elsewhere."""
DRAWN = 0.007, 0.005
"""rad, m: standard deviations about and along each axis of a mounting from a drawing: 0.7 deg and 9 mm in total."""

RIDDEN = 0.2, 0.05
"""m, rad: if scans show that the device moved this far, it is not at rest. For a device at rest among people and with
imperfect sensors, they usually show less than 0.1 and 0.03."""
SURE = 5.0
"""The motion must also exceed this many standard deviations, since scans may leave a direction open, as along a
corridor; and this many times the points' RMS distance from the map, since a few scans of a sparse scanner hardly make
surfaces. In two of 42 rests with such a scanner they showed 0.25 m: three times that distance."""
GUESSED = (
    "The first scans do not show the speed in every direction. If the map is off near its beginning, begin at rest or "
    "some seconds earlier or later."
)
RIDING = "The device was moving evenly at the start: biases and gravity begin as rough guesses."


@dataclass(frozen=True, slots=True)
class Ride:
    """How the device moves if it rides evenly while its IMU suggests a rest.

    Attributes:
        belief: at the last scan's end. residual: m, RMS distance of that scan's points from the map, 0 if unknown.
    """

    belief: Belief
    residual: float


@dataclass(frozen=True, slots=True)
class Started:
    """Outcome of one scan before the filter runs.

    Attributes:
        belief: where to propagate from; while waiting, the belief at the scan's end.
        still: samples of the rest so far. waiting: whether a longer rest is awaited.
        notice: a message for the user; "" while waiting and after a full rest.
    """

    belief: Belief
    still: ImuSamples
    waiting: bool
    notice: str


def proceed(still: ImuSamples | None, scan: Scan, samples: ImuSamples, params: Params) -> Started:
    """Process one scan of the start: wait for a longer rest, or start from the samples so far.

    Args:
        still: `Started.still` of the last call; None at the first scan.
        samples: IMU samples up to this scan's end.
    """
    recent = samples.part(samples.stamps_ns >= scan.stamp_ns - BEFORE_NS)
    together = recent if still is None else _joined(still, samples)
    if not rest.is_moving(together):
        lasted_s = (together.stamps_ns[-1] - together.stamps_ns[0]) * 1e-9
        waiting = bool(lasted_s < params.imu.start_duration)
        belief = standing(together, scan.end_ns, params)
        return Started(belief, together, waiting, "")
    if still is not None and (still.stamps_ns[-1] - still.stamps_ns[0]) * 1e-9 >= LEAST_STILL:
        lasted_s = (still.stamps_ns[-1] - still.stamps_ns[0]) * 1e-9
        belief = standing(still, int(still.stamps_ns[-1]), params)
        return Started(belief, still, False, f"Started after only {lasted_s:.1f} s at rest.")
    notice = "The device was moving at the start: biases and gravity begin as rough guesses."
    begin_ns = max(scan.stamp_ns, int(together.stamps_ns[0]))
    return Started(moving(together, begin_ns, params), together, False, notice)


def standing(imu: ImuSamples, stamp_ns: int, params: Params) -> Belief:
    """Belief at rest: the mean of the gyroscope is its bias, the mean specific force is gravity plus bias."""
    sigma = _sigma()
    sigma[VEL] = rest.TREMOR
    sigma[BG] = 3.0 * np.maximum(imu.gyro.std(axis=0) / np.sqrt(len(imu)), 1e-5)
    sigma[GRAV] = 0.15  # `rest.level` then narrows it together with the accelerometer's bias
    belief = _belief(imu, stamp_ns, imu.gyro.mean(axis=0), sigma, params)
    spread = np.maximum(imu.accel.std(axis=0), 1e-3)
    return rest.level(belief, imu.accel.mean(axis=0), 3.0 * spread / np.sqrt(len(imu)))


def moving(imu: ImuSamples, stamp_ns: int, params: Params) -> Belief:
    """Belief in motion: only the direction of gravity is known, roughly."""
    sigma = _sigma()
    sigma[VEL] = WALKING
    sigma[BG] = 0.02
    sigma[GRAV] = 0.15
    return _belief(imu, stamp_ns, np.zeros(3), sigma, params)


def has_ridden(ride: Ride, rest: Belief) -> bool:
    """Whether scans show that a device moved although its IMU felt a rest: on a trolley, in a lift, on an escalator.

    Args:
        ride, rest: by the scans and by the IMU alone, at the end of the supposed rest.
    """
    turned = lie.log(rest.state.R_odom_imu.T @ ride.belief.state.R_odom_imu)
    shown = max(RIDDEN[0], SURE * ride.residual), RIDDEN[1]
    for moved, part, least in zip((ride.belief.state.p_odom_imu, turned), (POS, ROT), shown, strict=True):
        if moved @ moved > least**2 and moved @ np.linalg.solve(ride.belief.covariance[part, part], moved) > SURE**2:
            return True
    return False


def _sigma() -> np.ndarray:
    sigma = np.zeros(DIM)
    sigma[ROT] = sigma[POS] = KNOWN
    sigma[BA] = 0.05  # turn-on bias of a MEMS accelerometer; at rest it looks like gravity
    sigma[EXT_ROT], sigma[EXT_POS] = DRAWN
    return sigma


def _belief(imu: ImuSamples, stamp_ns: int, b_gyro: np.ndarray, sigma: np.ndarray, params: Params) -> Belief:
    R_odom_imu = lie.between(imu.accel.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    belief = at_origin(stamp_ns, R_odom_imu, b_gyro, sigma, params)
    return seen_from_the_lidar(belief) if params.filter.estimate_extrinsics else belief


def _joined(a: ImuSamples, b: ImuSamples) -> ImuSamples:
    later = b.stamps_ns > a.stamps_ns[-1]
    return ImuSamples(
        np.concatenate([a.stamps_ns, b.stamps_ns[later]]),
        np.concatenate([a.gyro, b.gyro[later]]),
        np.concatenate([a.accel, b.accel[later]]),
    )
