"""Aligns a trajectory with satellite fixes: rotation, translation, the clocks' offset, and the antenna's lever arm.

The model of a fix g, in metres east, north and up, stamped s:

    g = Rz(yaw) Rxy(tilt) (p(s - offset) + R(s - offset) lever) + shift

where p, R is T_map_imu. The map's z is nearly up: it was levelled by an accelerometer, whose bias tilts it by tenths of
a degree. The map's shape does not change.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from app.georeference.drift import constants_despite_drift, drift_deviations
from app.georeference.fixes import Fixes
from app.georeference.ground import Ground
from app.georeference.path import SEARCH_S, PathOverTime, aligned_robustly
from app.georeference.reference import ELLIPSOIDAL, GeoReference
from app.slam import lie
from app.slam.arrays import F64, I64, Mask, Vector
from app.slam.errors import HemislamError
from app.slam.trajectory import Trajectory

COARSE_S = 0.2
"""Step of the first search for the clocks' offset, over `SEARCH_S` on either side."""
MOST_SIGMAS = 4.03
"""Standard deviations within which 99.9 % of sound fixes lie (a Gaussian in three directions)."""
MEDIAN_SIGMAS = 1.538
"""The same for half of them."""
LEVEL = np.radians(0.5)
"""Standard deviation of the map's tilt before any fix: that of an accelerometer biased by 0.09 m/s²."""
NEARBY_S = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6)
"""Offsets to try around the first one if the lever arm is unknown too: an antenna ahead looks like an early clock."""
WORST_YAW, WORST_OFFSET_S, WORST_LEVER_M = np.radians(10.0), 0.1, 0.1
"""Values that are less certain than this (standard deviation) are not taken from the fixes."""
NOTABLE_SCATTER = 3.0
"""The user is warned if residuals scatter by more than this many times the standard deviations that fixes report."""
FEWEST = 8
COARSE_FIXES = 200
MOST_STEPS = 50
"""Most steps of one fit. Sound fixes take up to 30; fixes that do not follow the trajectory would take hundreds."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How fixes or control points lie on a map.

    Attributes:
        reference: where the map lies. names: (n,) of the fixes.
        grid: (n, 3) easting, northing, height of the fixes, m. residuals: (n, 3) m, measured minus map.
        distances: (n,) lengths of the residuals in standard deviations. used: (n,) whether a fix counts.
        offset_s: how much later the fixes are stamped than they were measured. lever_arm: m, IMU frame.
        offset_sigma_s, yaw_sigma, lever_sigma: their standard deviations, s, rad and m; nan where a value was given.
            They count noise of the fixes and drift of the map.
        notes: for the user, in sentences.
    """

    reference: GeoReference
    names: tuple[str, ...]
    grid: F64
    residuals: F64
    distances: F64
    used: Mask
    offset_s: float = 0.0
    offset_sigma_s: float = float("nan")
    yaw_sigma: float = float("nan")
    lever_arm: Vector = (0.0, 0.0, 0.0)
    lever_sigma: float = float("nan")
    notes: tuple[str, ...] = ()

    @property
    def rms(self) -> F64:
        """(3,) m to the east, north and up, of the fixes or points that count."""
        return np.asarray(np.sqrt((self.residuals[self.used] ** 2).mean(axis=0)))


def align(
    trajectory: Trajectory,
    fixes: Fixes,
    *,
    grid: str = "",
    height: str = ELLIPSOIDAL,
    lever: Vector | None = None,
    offset_s: float | None = None,
    overridden: Mapping[str, bool] = MappingProxyType({}),
) -> Alignment:
    """Align a trajectory with fixes, which are in order of time; fixes before and after it are ignored.

    Args:
        trajectory: T_map_imu with z up. grid: a projected system; "": the UTM zone there. height: what the heights of
            the fixes are above. lever: m from the IMU to the antenna, IMU frame; None: estimated, if possible.
        offset_s: how much later the fixes are stamped than measured; None: found. overridden: whether fixes of these
            names count, whatever their residuals.

    Raises:
        HemislamError: fixes do not fit the trajectory in time or place, or leave the heading open; `lever` not finite.
    """
    if lever is not None and not np.isfinite(lever).all():
        raise HemislamError(f"The lever arm cannot be {lever}; give three numbers in metres.")
    if len(trajectory) < 4:
        raise HemislamError("The trajectory has fewer than 4 poses; that is too few to align it with fixes.")
    path = PathOverTime(trajectory)
    seconds: F64 = (fixes.stamps_ns - path.start_ns).astype(np.float64) * 1e-9
    rows = np.flatnonzero(path.within_search(seconds))
    if len(rows) < FEWEST:
        raise _too_few(path, seconds)
    fixes, seconds = Fixes(fixes.stamps_ns[rows], fixes.places[rows], fixes.sigmas[rows]), seconds[rows]
    ground = Ground.of(fixes, grid)
    notes: list[str] = []
    arm = np.array(lever or (0.0, 0.0, 0.0))
    seconds = seconds - (offset_s or 0.0)
    offset, median = _coarse(path, seconds, ground.places, arm, search=offset_s is None)
    _refuse_swapped(path, seconds, fixes, median)
    known = path.known(seconds - offset)
    names = tuple(str(number) for number in rows[known] + 1)
    problem = _Problem(
        path,
        seconds[known],
        ground.places[known],
        fixes.sigmas[known],
        overrides_of(overridden, names),
        np.r_[np.zeros(6), offset, arm],
        np.array([True] * 6 + [offset_s is None] + [lever is None] * 3),
    )
    if (blind := np.isnan(problem.sigmas.sum(axis=1))).any():
        which = "The fixes have" if blind.all() else f"{blind.sum()} of {len(blind)} fixes have"
        notes.append(f"{which} no covariance; their scatter about the map is used instead.")
        problem = replace(problem, sigmas=np.where(blind[:, None], median / MEDIAN_SIGMAS, problem.sigmas))
        scatter = float(np.median(problem.solve().distances)) / MEDIAN_SIGMAS
        problem = replace(problem, sigmas=np.where(blind[:, None], problem.sigmas * scatter, problem.sigmas))
    solved = problem.solve()
    if lever is None and not solved.deviations[LEVER].max() < WORST_LEVER_M:
        notes.append(
            "The motion does not determine the antenna's lever arm; it is taken as zero. Give it if you know it."
        )
        problem = problem.without(LEVER)
        solved = problem.solve()
    if offset_s is None and not solved.deviations[OFFSET] < WORST_OFFSET_S:
        notes.append("The motion does not determine the clock offset; it is taken as zero.")
        problem = problem.without(OFFSET)
        solved = problem.solve()
    if not (sigma := solved.deviations[YAW]) < WORST_YAW:
        raise HemislamError(
            f"The fixes determine the map's heading only to {np.degrees(sigma):.0f}°; walk farther outdoors."
        )
    _refuse_unlike(solved, problem.places)
    scatter = float(np.median(solved.distances[solved.used])) / MEDIAN_SIGMAS
    if scatter > NOTABLE_SCATTER:
        notes.append(
            f"The fixes are {scatter:,.0f} times as far from the map as they report: the map has drifted, or they are"
            " less accurate than that."
        )
    solved = problem.with_drift(solved)
    x, y, z = solved.x[LEVER].tolist()
    return Alignment(
        ground.reference(_rotation(solved.x), solved.x[SHIFT], height),
        names,
        ground.grid[known],
        solved.residuals,
        solved.distances,
        solved.used,
        offset_s=float(solved.x[OFFSET]) + (offset_s or 0.0),
        offset_sigma_s=float(solved.deviations[OFFSET]),
        yaw_sigma=float(solved.deviations[YAW]),
        lever_arm=(x, y, z),
        lever_sigma=float(solved.deviations[LEVER].max()),
        notes=tuple(notes),
    )


def overrides_of(overridden: Mapping[str, bool], names: Sequence[str]) -> F64:
    """(n,) 1 where the user counts the fix or point of this name, 0 where they leave it out, nan elsewhere."""
    return np.array([float(overridden.get(name, np.nan)) for name in names], np.float64)


YAW, SHIFT, TILT, OFFSET, LEVER = 0, slice(1, 4), slice(4, 6), 6, slice(7, 10)
"""Where the unknowns x (10,) hold yaw, rad; shift, m; tilt, rad; the clocks' offset, s; the lever arm, m."""


@dataclass(frozen=True, slots=True)
class _Solved:
    """As in `Alignment`, with the unknowns x (10,) and their standard deviations (10,), nan where a value was given."""

    x: F64
    deviations: F64
    residuals: F64
    distances: F64
    used: Mask


@dataclass(frozen=True, slots=True)
class _Problem:
    """The input of an alignment: (n,) times, (n, 3) places on the ground and their sigmas.

    Attributes:
        overrides: (n,) 1 or 0 where the user says that a fix counts or does not, nan elsewhere.
        given: (10,) offset and lever arm as given, or to start from. free: (10,) whether an unknown is estimated.
    """

    path: PathOverTime
    seconds: F64
    places: F64
    sigmas: F64
    overrides: F64
    given: F64
    free: Mask

    def solve(self) -> _Solved:
        """All unknowns at once, first robustly, then by the fixes that agree."""
        some = self._part(np.flatnonzero(self.overrides != 0))
        if (count := len(some.seconds)) < FEWEST:
            raise HemislamError(f"Only {count} fixes are left, {FEWEST} are needed; accept some of them again.")
        start = some._start(self.given[OFFSET])
        if self.free[OFFSET] and self.free[LEVER].all():
            few = some._part(_evenly(count))
            fits = [few._fit_robustly(few._start(self.given[OFFSET] + nearby)) for nearby in NEARBY_S]
            start, _ = min(fits, key=lambda fit: fit[1])
        x, used = self._robust(start)
        errors = self._errors(x)
        spread = max(1.0, float((errors[used] ** 2).sum()) / max(3 * int(used.sum()) - int(self.free.sum()), 1))
        deviations = np.full(len(x), np.nan)
        deviations[self.free] = _deviations(self._jacobian(x, used)) * spread**0.5
        return _Solved(x, deviations, errors * self.sigmas, np.linalg.norm(errors, axis=1), used)

    def _part(self, rows: I64) -> "_Problem":
        """The same with only these fixes."""
        arrays = ("seconds", "places", "sigmas", "overrides")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    def without(self, unknown: int | slice) -> "_Problem":
        """The same with an unknown that is taken as zero."""
        given, free = self.given.copy(), self.free.copy()
        given[unknown], free[unknown] = 0.0, False
        return replace(self, given=given, free=free)

    def _start(self, offset: float) -> F64:
        """The unknowns to start from with this offset; no tilt."""
        yaw, shift, _ = aligned_robustly(self.path.antenna(self.seconds - offset, self.given[LEVER]), self.places)
        return np.asarray(np.r_[yaw, shift, 0.0, 0.0, offset, self.given[LEVER]], np.float64)

    def with_drift(self, solved: _Solved) -> _Solved:
        """The same, with drift in the standard deviations and with receiver constants that drift hardly affects."""
        used, x, residuals = solved.used, solved.x, solved.residuals[solved.used]
        J = self._jacobian(x, used)
        sigmas, seconds = self.sigmas[used], self.seconds[used]
        influence = np.linalg.pinv(J).T[:-2].reshape(*residuals.shape, -1) / sigmas[..., None]
        drift, deviations = np.full(len(x), np.nan), solved.deviations.copy()
        drift[self.free] = drift_deviations(residuals, influence, seconds)
        deviations[YAW] = math.hypot(deviations[YAW], drift[YAW])
        deviations[LEVER] = math.hypot(deviations[LEVER].max(), drift[LEVER].max())
        if not self.free[OFFSET]:
            return replace(solved, deviations=deviations)
        constants = self.free.copy()  # yaw, tilt and offset, and the lever arm if it is not given
        constants[SHIFT] = False  # drift replaces it
        per_unit = J[:-2].reshape(*residuals.shape, -1)[..., constants[self.free]] * sigmas[..., None]
        expected = np.full(len(x), np.inf)
        expected[TILT] = LEVEL
        change, covariance = constants_despite_drift(
            residuals, per_unit, seconds, sigmas, x[constants], expected[constants]
        )
        given = x.copy()
        given[constants] += change
        deviations[OFFSET] = covariance[3, 3] ** 0.5
        there = replace(self, given=given, free=np.arange(len(x)) < OFFSET).solve()
        return replace(there, deviations=deviations)

    def _errors(self, x: F64) -> F64:
        """(n, 3) in standard deviations."""
        antenna = self.path.antenna(self.seconds - x[OFFSET], x[LEVER])
        return np.asarray((self.places - antenna @ _rotation(x).T - x[SHIFT]) / self.sigmas)

    def _whitened(self, x: F64, used: Mask) -> F64:
        """(3 k + 2,) errors of the k fixes that are used, and the tilt among the unknowns, in standard deviations."""
        return np.concatenate((self._errors(x)[used].ravel(), x[TILT] / LEVEL))

    def _jacobian(self, x: F64, used: Mask) -> F64:
        """(3 k + 2, unknowns that are estimated) derivatives of these errors."""
        steps = 1e-5 * np.eye(len(x))[self.free]
        columns = [self._whitened(x + step, used) - self._whitened(x - step, used) for step in steps]
        return np.stack(columns, axis=1) / 2e-5

    def _fit(self, start: F64, used: Mask, **loss: Any) -> tuple[F64, float]:
        """The unknowns with which these fixes fit best, and the cost."""
        from scipy import optimize  # every process imports this module, and few align

        def errors(free: F64) -> F64:
            x = start.copy()
            x[self.free] = free
            return self._whitened(x, used)

        least_squares: Any = optimize.least_squares  # mypy takes it for the module of that name
        fit = least_squares(errors, start[self.free], x_scale="jac", max_nfev=MOST_STEPS, **loss)
        x = start.copy()
        x[self.free] = fit.x
        return x, float(fit.cost)

    def _fit_robustly(self, start: F64) -> tuple[F64, float]:
        """As `_fit`, by all fixes except those that the user leaves out."""
        return self._fit(start, self.overrides != 0, loss="cauchy", f_scale=2.0)

    def _robust(self, start: F64) -> tuple[F64, Mask]:
        """The optimum by the fixes that agree or that the user counts, and which these are."""
        used = np.asarray(self.overrides != 0)
        x, _ = self._fit_robustly(start)
        for _ in range(10):
            distances = np.linalg.norm(self._errors(x), axis=1)
            scale = max(1.0, float(np.median(distances[used])) / MEDIAN_SIGMAS)
            agree = ((distances < MOST_SIGMAS * scale) | (self.overrides == 1)) & (self.overrides != 0)
            if agree.sum() < 3:
                break
            x, _ = self._fit(x, agree)
            if (agree == used).all():
                break
            used = agree
        return x, used


def _rotation(x: F64) -> F64:
    """(3, 3) from the map to the ground."""
    return lie.exp(np.array([0.0, 0.0, x[YAW]])) @ lie.exp(np.array([*x[TILT], 0.0]))


def _deviations(J: F64) -> F64:
    """(k,) standard deviations of the unknowns of whitened errors with this Jacobian (n, k); inf if one is open."""
    lengths = np.linalg.norm(J, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    values, vectors = np.linalg.eigh((J / lengths).T @ (J / lengths))
    values = np.where(values > 1e-12, values, 1e-300)
    return np.asarray(np.sqrt((vectors**2 / values).sum(axis=1)) / lengths)


def _coarse(path: PathOverTime, seconds: F64, places: F64, lever: F64, *, search: bool = True) -> tuple[float, float]:
    """The offset (s; 0 without a search) with which the fixes fit best, and their median distance (m)."""
    few = _evenly(len(seconds))
    best = (np.inf, 0.0, np.inf)
    offsets = np.arange(-SEARCH_S, SEARCH_S + COARSE_S / 2, COARSE_S) if search else np.zeros(1)
    for offset in offsets[np.argsort(np.abs(offsets), kind="stable")].tolist():
        t = seconds[few] - offset
        inside = path.known(t)
        if inside.sum() >= FEWEST and inside.sum() >= 0.5 * path.known(seconds[few]).sum():
            _, _, off = aligned_robustly(path.antenna(t[inside], lever), places[few][inside])
            best = min(best, (float(off.mean()), offset, float(np.median(off))))
    if not np.isfinite(best[0]):
        raise _too_few(path, seconds)
    return best[1], best[2]


def _evenly(count: int) -> I64:
    """Indices of at most `COARSE_FIXES` of `count` fixes, evenly spread."""
    return np.unique(np.linspace(0, count - 1, COARSE_FIXES).astype(np.int64))


def _too_few(path: PathOverTime, seconds: F64) -> HemislamError:
    return HemislamError(
        f"Only {path.known(seconds).sum()} fixes lie within the time of the trajectory, {FEWEST} are needed: they begin"
        f" {seconds[0]:.0f} s and end {seconds[-1]:.0f} s after its start; both must be stamped in UTC."
    )


def _refuse_unlike(solved: _Solved, places: F64) -> None:
    """Raises HemislamError if the fixes at these places (n, 3) fit the trajectory no better than a point would."""
    path = (places - solved.residuals)[solved.used]
    extent = float(np.sqrt(((path - path.mean(axis=0)) ** 2).sum(axis=1).mean()))  # no median: most may stand still
    off = float(np.sqrt((solved.residuals[solved.used] ** 2).sum(axis=1).mean()))
    if off > 0.5 * extent:
        raise HemislamError(
            f"The fixes do not follow the trajectory: at best, they are {off:.1f} m off (RMS); check that"
            " they are of this walk, in degrees, and that the receiver had reception."
        )


def _refuse_swapped(path: PathOverTime, seconds: F64, fixes: Fixes, median: float) -> None:
    """Raises HemislamError if the fixes fit far better with latitude and longitude exchanged: a mirrored path."""
    if (np.abs(fixes.places[:, 1]) > 84).any() or median < 0.5:
        return
    swapped = replace(fixes, places=fixes.places[:, [1, 0, 2]])
    _, other = _coarse(path, seconds, Ground.of(swapped).places, np.zeros(3))
    if other < 0.3 * median:
        raise HemislamError(
            f"Latitude and longitude seem to be swapped: the path fits to {other:.2f} m with them exchanged, and to"
            f" {median:.2f} m as they are; exchange the columns."
        )
