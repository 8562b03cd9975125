"""The evidence for one candidate and the verdict on it alone; `support` compares candidates."""

from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.detection import WIDER, Detector, Sighting
from app.slam.loops.drift import Deviation, Drift, Expectation, expect
from app.slam.loops.edits import Add
from app.slam.loops.placing import Placement, place
from app.slam.loops.plan import Window
from app.slam.loops.types import Evidence, LoopEdge, Origin, Verdict
from app.slam.loops.verification import Fit, assess, refine, register, rough
from app.slam.sections import LoopsParams
from app.slam.types import F64

SURE_M = 0.1
"""If odometry's position is more certain than this (standard deviation), no places beside its guess are searched."""
LOOSE_M = 10.0
"""Standard deviation of a registration along an unconstrained direction."""
FLOOR_M, FLOOR_YAW, FLOOR_TILT = 0.04, np.radians(0.5), np.radians(1.5)
"""Least standard deviations of a registration, however many points it has. A mounting error tilts clouds differently at
different headings, so odometry, which observes gravity, is better in roll and pitch."""
NEAR_M, FAR_M = 5.0, 10.0
"""m: places farther apart are not tied: an error of 1 degree in the mounting moves one by 0.1 m as seen from the other.
Across a pause of the recording, such a tie is better than none, so the second limit applies."""
POINT_M, INDEPENDENT = 0.1, 0.05
"""Standard deviation of a point's distance to a plane, including systematic errors, and the share of points whose
errors are independent of their neighbours'."""


def judge(
    sighting: Sighting, detector: Detector, expectation: Expectation, params: LoopsParams, *, broken: bool
) -> LoopEdge:
    """Register a sighting and check it against the limits: a candidate if it meets all, else rejected.

    Args:
        broken: whether odometry broke between the two; only then may loops outvote it, however far off it is.
    """
    older, newer = sighting.older, sighting.newer
    guess = detector.guess(older, newer, expectation.poses)
    sigma = float(expectation.position_sigmas()[older])
    evidence = Evidence(sighting.distance, gate_m=sigma)
    now = len(detector) - 1

    def edge(T_older_newer: F64, covariance: F64, evidence: Evidence, reason: str) -> LoopEdge:
        verdict = Verdict.REJECTED if reason else Verdict.CANDIDATE
        return LoopEdge(older, newer, now, T_older_newer, covariance, evidence, verdict, reason)

    if sighting.distance > params.context_distance:
        reason = (
            f"the places look different: context distance {sighting.distance:.2f} (most {params.context_distance:g})"
        )
        return edge(detector.from_level(older, newer, guess), np.eye(6), evidence, reason)

    found = _place(older, newer, detector, expectation, params, height_known=not broken)
    fit = found.fit
    evidence = replace(
        evidence,
        overlap=fit.overlap,
        residual_rms=fit.residual_rms,
        condition=fit.condition,
        slide=found.slides,
        alternative_m=found.alternative_m,
        mahalanobis=found.deviation.sigmas,
    )
    T = detector.from_level(older, newer, fit.T_target_source)
    paused = detector.pauses_before[older] < detector.pauses_before[newer]
    reason = _objection(found, evidence, params, FAR_M if paused else NEAR_M) or (
        "" if broken else _far_off(found.deviation, evidence, params)
    )
    along = uncertainty_along(found, guess, expectation.covariance(older)[3:, 3:])
    return edge(T, covariance(detector, newer, fit, *along), evidence, reason)


def _place(
    older: KeyframeId,
    newer: KeyframeId,
    detector: Detector,
    expectation: Expectation,
    params: LoopsParams,
    *,
    height_known: bool = False,
) -> Placement:
    """The alignment of the newer place with the older one, searched as far as odometry may be off."""

    def deviation(T_level: F64) -> Deviation:
        return expectation.deviation(older, detector.from_level(older, newer, T_level))

    sigma = float(expectation.position_sigmas()[older])
    reach = WIDER * params.max_mahalanobis
    window = Window(reach * sigma if sigma > SURE_M else 0.0, reach * np.sqrt(expectation.covariance(older)[2, 2]))
    guess = detector.guess(older, newer, expectation.poses)
    limits = params.max_mahalanobis, params.max_slide
    return place(*detector.both(older, newer), guess, window, deviation, *limits, height_known=height_known)


def by_hand(edit: Add, detector: Detector, params: LoopsParams) -> LoopEdge:
    """A loop that the user proposes, registered from its guess, or else from where odometry and structure put it."""
    older, newer = edit.older, edit.newer
    poses = detector.poses
    T_older_newer = np.array(edit.guess) if edit.guess else lie.inverse(poses[older]) @ poses[newer]
    both = detector.both(older, newer)
    guess = detector.level(older, newer, T_older_newer)
    if not edit.register:
        fit = assess(*both, guess)
    elif edit.guess:
        fit = assess(*both, refine(*both, register(*both, rough(*both, guess)[0])))
    else:
        expectation = expect(newer, poses, (), Drift.of(params), detector.resumed, detector.astray)
        fit = _place(older, newer, detector, expectation, params).fit
    evidence = Evidence(overlap=fit.overlap, residual_rms=fit.residual_rms, condition=fit.condition)
    reason = f"added manually: overlap {100 * fit.overlap:.0f} %, residual {fit.residual_rms * 1e3:.0f} mm"
    T = detector.from_level(older, newer, fit.T_target_source) if edit.register else T_older_newer
    sigma = covariance(detector, newer, fit)
    return LoopEdge(older, newer, newer, T, sigma, evidence, Verdict.ACCEPTED, reason, Origin.USER, edited=True)


def covariance(detector: Detector, newer: int, fit: Fit, along: F64 | None = None, sigma_m: float = 0.0) -> F64:
    """(6, 6) of a registration, rotation then translation, in the newer's IMU frame.

    Args:
        along: (3,) unit, axes of the older's level frame. sigma_m: standard deviation in this direction beyond what
            the points tell.
    """
    level = _by_points(fit)
    if along is not None:
        level[3:, 3:] += sigma_m**2 * np.outer(along, along)
    R = (fit.T_target_source @ detector.T_level_imu(newer))[:3, :3]
    turn = np.kron(np.eye(2), R.T)
    out = turn @ level @ turn.T
    return np.asarray((out + out.T) / 2)


def uncertainty_along(place: Placement, T_guess: F64, odometry: F64) -> tuple[F64, float]:
    """A direction (3,), and the standard deviation, m, to add along it to what a registration's points tell.

    It is the open direction or, without one, the least constrained direction. If odometry, of covariance (3, 3) in the
    level frame, is more certain along it than the registration, the registration may be wrong, as between rows of
    parked cars. Then it counts for less the more it contradicts odometry.
    """
    if place.open is not None:
        return place.open, LOOSE_M
    weakest = place.fit.directions[0]
    if weakest @ odometry @ weakest >= weakest @ _by_points(place.fit)[3:, 3:] @ weakest:
        return weakest, 0.0
    return weakest, abs(float(weakest @ (place.fit.T_target_source - T_guess)[:3, 3]))


def _by_points(fit: Fit) -> F64:
    """(6, 6) covariance of a registration in the older's level frame, from its points alone."""
    information = fit.information * (INDEPENDENT / POINT_M**2)
    floor = np.diag([FLOOR_TILT**2] * 2 + [FLOOR_YAW**2] + [FLOOR_M**2] * 3)
    return np.asarray(np.linalg.pinv(information) + floor)


def _objection(place: Placement, e: Evidence, p: LoopsParams, near_m: float) -> str:
    """The first limit that is not met, in words and numbers; "" if all are met."""
    fit = place.fit
    if len(fit.residuals) < 100:
        return f"only {len(fit.residuals)} points correspond (least 100)"
    apart = float(np.linalg.norm(fit.T_target_source[:3, 3]))
    if apart > near_m:
        return f"the places are {apart:.1f} m apart (most {near_m:g} m)"
    if place.open is not None and apart > NEAR_M:
        return f"it slides, and the places are {apart:.1f} m apart (most {NEAR_M:g} m)"
    if e.overlap < p.min_overlap:
        return f"the submaps overlap by {100 * e.overlap:.0f} % (least {100 * p.min_overlap:.0f} %)"
    if e.residual_rms > p.max_residual:
        return f"the residual is {1000 * e.residual_rms:.0f} mm (most {1000 * p.max_residual:.0f} mm)"
    if place.loose:
        most = f"most {1000 * p.max_slide:.0f} mm"
        return f"it slides in all directions: pushed, it ends {1000 * e.slide:.0f} mm off ({most})"
    if e.ambiguous:
        away = f"{e.alternative_m:.1f} m away"
        return f"it is ambiguous: {away} it fits as well, and odometry (σ {e.gate_m:.2f} m) allows both"
    if place.open is not None and e.mahalanobis > p.max_mahalanobis:
        return f"it slides, and {e.against_odometry(p.max_mahalanobis)}"
    return ""


def _far_off(deviation: Deviation, e: Evidence, p: LoopsParams) -> str:
    """Why unbroken odometry rules a loop out, however many other loops agree with it; "" if it does not."""
    if deviation.height_sigmas > p.max_mahalanobis:
        away = f"{abs(deviation.height):.1f} m {'above' if deviation.height > 0 else 'below'}"
        off = f"{deviation.height_sigmas:.1f} σ, most {p.max_mahalanobis:g} σ"
        return f"it lies {away} where odometry expects it ({off}), and storeys of a building look alike"
    if e.mahalanobis > WIDER * p.max_mahalanobis:
        return e.against_odometry(WIDER * p.max_mahalanobis)
    return ""
