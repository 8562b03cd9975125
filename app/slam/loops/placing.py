"""Align a place with an older one: find all alignments that fit, and the one that odometry and structure prefer.

A registration shows that two submaps fit, but not that they fit nowhere else. In repeating corridors and rooms they
may. So registration starts from every placement that the plans allow (`plan`), within odometry's possible error.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.loops.drift import Deviation
from app.slam.loops.plan import EVERYWHERE, Window, placements
from app.slam.loops.verification import Fit, Prepared, assess, refine, register, rough, slide
from app.slam.types import F64

APART_M, APART_RAD = 0.8, float(np.radians(10.0))
"""Alignments nearer to each other than this count as the same."""
LEAST_OVERLAP, MOST_RESIDUAL, RESIDUAL_M = 0.6, 1.6, 0.002
"""Another alignment fits as well if it has at least this share of the best one's overlap, and at most this many times
its residual plus this many metres. (In a place that does not repeat, wrong alignments overlap less.)"""
HOPEFUL, SAME_ROUGHLY = 0.5 * LEAST_OVERLAP, 0.25
"""A rough alignment is refined if it has at least this share of the best one's points and is this far from others."""
ALONG = 0.9
"""Two alignments count as the same if the cosine between their difference and an open direction is at least this."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Attributes:
    fit: the best alignment. deviation: from odometry to it.
    slides: m, by which it slid along its least constrained direction. open: that direction, (3,) unit in the target's
        axes, if nothing holds it there. loose: whether the next direction slides too.
    alternative_m: m to the nearest other alignment that fits as well and that odometry allows as well; inf if none.
    """

    fit: Fit
    deviation: Deviation
    slides: float
    open: F64 | None
    loose: bool
    alternative_m: float


def place(
    target: Prepared,
    source: Prepared,
    T_guess: F64,
    window: Window,
    deviation: Callable[[F64], Deviation],
    most_sigmas: float,
    most_slide: float,
    *,
    height_known: bool = False,
) -> Placement:
    """Align a submap with another.

    If the best alignment contradicts odometry, odometry cannot rule out others either, so they are searched everywhere.

    Args:
        T_guess: (4, 4) of the level frames, by odometry; along an open direction, the result stays at this guess.
        deviation: of such a transform from odometry. most_sigmas: standard deviations up to which it is allowed.
        most_slide: m of sliding, up to which a direction counts as constrained. height_known: an alignment at another
            height is wrong; no others are searched then, since their height would follow from the same ground.
    """
    starts = [T_guess, *(placements(target, source, T_guess, window) if window.reach_m >= APART_M else ())]
    found: list[F64] = []
    for rough_T in _worthwhile([rough(target, source, start) for start in starts]):
        T = register(target, source, rough_T)
        if not any(_apart(T, other) < 1.0 for other in found):
            found.append(T)
    if len(found) > 1:
        fits = [assess(target, source, T) for T in found]
        best = max(fits, key=lambda fit: fit.overlap)
        good = [fit for fit in fits if fit is best or _as_good(fit, best)]  # without overlap it is not even itself
        allowed = [fit for fit in good if deviation(fit.T_target_source).sigmas <= most_sigmas] or good
        chosen = max(allowed, key=lambda fit: fit.overlap).T_target_source
        others = [fit.T_target_source for fit in allowed if fit.T_target_source is not chosen]
    else:
        chosen, others = found[0], []
    fit = assess(target, source, refine(target, source, chosen))
    off = deviation(fit.T_target_source)
    wrong = height_known and off.height_sigmas > most_sigmas
    if window is not EVERYWHERE and off.sigmas > most_sigmas and not wrong:
        return place(target, source, T_guess, EVERYWHERE, deviation, most_sigmas, most_slide)

    weakest, second, _ = fit.directions
    slides = slide(target, source, fit, weakest) if fit.overlap else float("inf")
    is_open = slides > most_slide
    loose = is_open and fit.overlap > 0 and slide(target, source, fit, second) > most_slide
    if is_open:
        T = fit.T_target_source.copy()
        T[:3, 3] += weakest * (weakest @ (T_guess - T)[:3, 3])
        fit = assess(target, source, T)
    ways = [other[:3, 3] - chosen[:3, 3] for other in others]
    lengths = [float(np.linalg.norm(way)) for way in ways if not (is_open and _along(way, weakest))]
    return Placement(
        fit=fit,
        deviation=deviation(fit.T_target_source),
        slides=slides,
        open=weakest if is_open else None,
        loose=loose,
        alternative_m=min(lengths, default=float("inf")),
    )


def _worthwhile(roughs: list[tuple[F64, float]]) -> list[F64]:
    """The rough alignments (4, 4) that may become the best, without duplicates. roughs: each with its share of points
    that fit."""
    most = max(share for _, share in roughs)
    out: list[F64] = []
    for T, share in roughs:
        if share >= HOPEFUL * most and not any(_apart(T, other) < SAME_ROUGHLY for other in out):
            out.append(T)
    return out


def _as_good(other: Fit, fit: Fit) -> bool:
    return (
        other.overlap >= LEAST_OVERLAP * fit.overlap
        and other.residual_rms <= MOST_RESIDUAL * fit.residual_rms + RESIDUAL_M
    )


def _apart(a: F64, b: F64) -> float:
    """Distance of two alignments (4, 4); from 1 on they count as different."""
    turned = float(np.linalg.norm(lie.log(a[:3, :3] @ b[:3, :3].T)))
    return max(float(np.linalg.norm(a[:3, 3] - b[:3, 3])) / APART_M, turned / APART_RAD)


def _along(way: F64, direction: F64) -> bool:
    return abs(float(way @ direction)) >= ALONG * float(np.linalg.norm(way))
