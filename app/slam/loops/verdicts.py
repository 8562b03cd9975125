"""The evidence for one candidate and the verdict on it alone; `support` compares candidates."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.ambiguity import nearest_alternative
from app.slam.loops.detection import Detector, Sighting
from app.slam.loops.drift import Expectation
from app.slam.loops.types import Evidence, LoopEdge, Origin, Verdict
from app.slam.loops.verification import Fit
from app.slam.sections import LoopsParams
from app.slam.types import F64

FARTHEST_M = 10.0
"""Beyond this the submaps no longer overlap enough to fit as well."""
FLOOR_M, FLOOR_RAD = 0.04, np.radians(0.5)
"""Least standard deviations of a registration, however many points it has."""
POINT_M, INDEPENDENT = 0.1, 0.05
"""Standard deviation of a point's distance to a plane, including systematic errors, and the share of points whose
errors are independent of their neighbours'."""


def judge(sighting: Sighting, detector: Detector, expectation: Expectation, params: LoopsParams) -> LoopEdge:
    """Register a sighting and check it against the limits: a candidate if it meets all, else rejected."""
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
        return edge(_imu(detector, older, newer, guess), np.eye(6), evidence, reason)

    fit = detector.register(older, newer, guess)
    T = _imu(detector, older, newer, fit.T_target_source)
    evidence = replace(
        evidence,
        overlap=fit.overlap,
        residual_rms=fit.residual_rms,
        condition=fit.condition,
        mahalanobis=expectation.mahalanobis(older, T),
    )
    reason = _objection(evidence, fit, params)
    if not reason:
        evidence = replace(evidence, slide=detector.slide(older, newer, fit))
        reason = _objection(evidence, fit, params)
    if not reason:
        evidence = replace(
            evidence, alternative_m=_nearest_alternative(older, newer, detector, expectation, fit, params)
        )
        reason = _objection(evidence, fit, params)
    return edge(T, covariance(detector, newer, fit), evidence, reason)


def by_hand(
    older: KeyframeId, newer: KeyframeId, detector: Detector, T_older_newer: F64, *, register: bool
) -> LoopEdge:
    """A loop that the user proposes, registered from the given (4, 4) or taken as it is."""
    guess = detector.T_level_imu(older) @ T_older_newer @ lie.inverse(detector.T_level_imu(newer))
    fit = detector.register(older, newer, guess) if register else detector.assess(older, newer, guess)
    evidence = Evidence(overlap=fit.overlap, residual_rms=fit.residual_rms, condition=fit.condition)
    reason = f"added by hand: overlap {fit.overlap:.2f}, residual {fit.residual_rms * 1e3:.0f} mm"
    T = _imu(detector, older, newer, fit.T_target_source) if register else T_older_newer
    sigma = covariance(detector, newer, fit)
    return LoopEdge(older, newer, newer, T, sigma, evidence, Verdict.ACCEPTED, reason, Origin.USER, edited=True)


def covariance(detector: Detector, newer: int, fit: Fit) -> F64:
    """(6, 6) of a registration, rotation then translation, in the newer's IMU frame."""
    information = fit.information * (INDEPENDENT / POINT_M**2)
    level = np.linalg.pinv(information) + np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    R = (fit.T_target_source @ detector.T_level_imu(newer))[:3, :3]
    turn = np.kron(np.eye(2), R.T)
    out = turn @ level @ turn.T
    return np.asarray((out + out.T) / 2)


def _objection(e: Evidence, fit: Fit, p: LoopsParams) -> str:
    """The first limit that is not met, in words and numbers; "" if all are met."""
    if len(fit.residuals) < 100:
        return f"only {len(fit.residuals)} points correspond (least 100)"
    if e.overlap < p.min_overlap:
        return f"the submaps overlap by {e.overlap:.2f} (least {p.min_overlap:g})"
    if e.residual_rms > p.max_residual:
        return f"the residual is {e.residual_rms:.3f} m (most {p.max_residual:g} m)"
    if e.mahalanobis > p.max_mahalanobis:
        return (
            f"odometry rules it out: {e.mahalanobis:.1f} σ (most {p.max_mahalanobis:g} σ, one being {e.gate_m:.2f} m)"
        )
    if e.slide > p.max_slide:
        return f"it slides: pushed along its weakest direction it ends {e.slide:.2f} m off (most {p.max_slide:g} m)"
    if e.ambiguous:
        away = f"{e.alternative_m:.1f} m away"
        return f"it is ambiguous: {away} it fits as well, and odometry (σ {e.gate_m:.2f} m) allows both"
    return ""


def _nearest_alternative(
    older: int, newer: int, detector: Detector, expectation: Expectation, fit: Fit, params: LoopsParams
) -> float:
    def allowed(T_level: F64) -> bool:
        return expectation.mahalanobis(older, _imu(detector, older, newer, T_level)) <= params.max_mahalanobis

    reach = 2 * params.max_mahalanobis * float(expectation.position_sigmas()[older])
    return nearest_alternative(detector.submap(older), detector.submap(newer), fit, min(reach, FARTHEST_M), allowed)


def _imu(detector: Detector, older: int, newer: int, T_level: F64) -> F64:
    """T_older_newer of the IMU frames from that of the level frames."""
    return np.asarray(lie.inverse(detector.T_level_imu(older)) @ T_level @ detector.T_level_imu(newer))


def worth_correcting(edges: Iterable[LoopEdge], poses: F64) -> bool:
    """Whether the loops that count add information to odometry.

    If odometry agrees with all of them within half their standard deviation (2 cm and 0.25 degrees at best), following
    them would only add their noise. Edits by the user always count.

    Args:
        poses: (k, 4, 4) T_odom_imu of all keyframes.
    """
    loops = [edge for edge in edges if edge.verdict is Verdict.ACCEPTED]
    if any(edge.edited or edge.origin is Origin.USER or edge.weight != 1.0 for edge in loops):
        return True
    if not loops:
        return False
    pairs = np.array([edge.pair for edge in loops])
    measured = np.array([edge.T_older_newer for edge in loops])
    missed = lie.inverse(poses[pairs[:, 0]] @ measured) @ poses[pairs[:, 1]]
    covariances = np.array([edge.covariance for edge in loops])
    turned = _mean_square(lie.log(missed[:, :3, :3]), covariances[:, :3, :3])
    moved = _mean_square(missed[:, :3, 3], covariances[:, 3:, 3:])
    return max(moved, turned) > 0.5**2


def _mean_square(errors: F64, covariances: F64) -> float:
    """Mean over (n, 3) errors of their squared Mahalanobis length by (n, 3, 3)."""
    return float(np.mean(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)))
