"""Systematic errors of each scan line, from how well the points of all lines lie on common planes.

In windows of a few seconds the map is cut into cubes. In a flat cube, the points of all lines and scans must lie on one
plane. The unknowns are the corrections of the lines, a pose of each scan and a plane of each cube. Poses and planes are
eliminated, so that linear least squares for the corrections remain (as in bundle adjustment of planes, Liu & Zhang
2021, "BALM").

Errors that all lines share, or that change linearly from the lowest line to the highest, are held at zero. With every
LiDAR, beams that graze a surface measure too long distances, which looks the same as such errors: on simulated scanners
with grazing beams, these parts came out wrong by centimetres.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from app.calibration.excerpt import Excerpt
from app.calibration.odometry import Track
from app.slam import channels
from app.slam.kernels.registration import EDGE_ON
from app.slam.types import F64, I64, U16

WINDOW, CUBE, EVERY = 60, 1.0, 4
"""Number of scans of a window; edge of a cube, m; every how many points one is used."""
FEWEST, THICKEST, FLAT = 15, 0.05, 3.0
"""A plane has at least this many points, is at most this thick (m), and is wider than thick by this factor."""
OUTLIER = 3.0
"""Standard deviations from its plane beyond which a point is left out."""
WIDEST = np.radians(0.3), 0.03
"""rad, m: standard deviations of the corrections before anything is known."""
COMMON = np.radians(1e-3), 1e-4
"""rad, m: the same for the shared and the linear part, over all points."""
LOOSE = 1.0
"""rad, m: the same for the scans' poses."""
SURE, LEAST = 3.0, (np.radians(0.03), 0.003)
"""Corrections are worth applying if their RMS exceeds this many times their uncertainty, and these values (rad, m)."""
DIGITS = 3, 4
"""Decimals of a correction in deg, and in m."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Corrections of the scan lines, lowest first; empty for a LiDAR without scan lines.

    Attributes:
        elevations: (k,) rad, ranges: (k,) m, to be added. sigmas: (2, k) their standard deviations.
        before, after: (k,) m, RMS of each line's points from their planes; nan for a line without any.
    """

    elevations: F64
    ranges: F64
    sigmas: F64
    before: F64
    after: F64

    @classmethod
    def none(cls, count: int) -> "Lines":
        unknown = np.full(count, np.nan)
        sigmas = np.repeat(np.array(WIDEST)[:, None], count, axis=1)
        return cls(np.zeros(count), np.zeros(count), sigmas, unknown, unknown)

    def applied(self, excerpt: Excerpt) -> Excerpt:
        """The excerpt with its beams corrected."""
        scans = tuple(channels.bent(scan, self.elevations, self.ranges) for scan in excerpt.scans)
        return replace(excerpt, scans=scans)

    def found(self) -> dict[str, str]:
        """The parameters for corrections that are worth applying."""
        values = {}
        names, scales = ("elevation_corrections", "range_corrections"), (np.degrees(1.0), 1.0)
        for k, line in enumerate((self.elevations, self.ranges)):
            known = self.sigmas[k] < 0.5 * WIDEST[k]  # a line that saw nothing does not count
            size = float(np.sqrt(np.mean(line[known] ** 2))) if known.any() else 0.0
            if size > max(LEAST[k], SURE * float(np.median(self.sigmas[k][known])) if known.any() else 0.0):
                values[f"sensor.{names[k]}"] = channels.text(line * scales[k], DIGITS[k])
        return values


def fit_lines(excerpt: Excerpt, track: Track, so_far: Lines) -> Lines:
    """Corrections beyond those that the scans of the excerpt already have.

    Args:
        track: of this excerpt. so_far: the corrections that it already has.
    """
    count = len(so_far.elevations)
    votes, squares, hits = [], np.zeros(count), np.zeros(count)
    for begin in range(1, len(excerpt.scans) - WINDOW + 1, WINDOW):
        window = _Window.of(excerpt, track, range(begin, begin + WINDOW))
        if len(window.off) < FEWEST * WINDOW:
            continue
        votes.append(window.equations(count))
        squares += np.bincount(window.ring, window.off**2, count)
        hits += np.bincount(window.ring, minlength=count)
    if not votes:
        return so_far
    information, vector = (np.stack(parts) for parts in zip(*votes, strict=True))
    prior = np.diag(np.repeat(np.array(WIDEST) ** -2.0, count))
    share, place = hits / hits.sum(), np.linspace(-1.0, 1.0, count)
    for k, sigma in enumerate(COMMON):
        for smooth in (share, share * (place - share @ place)):
            mode = np.zeros(2 * count)
            mode[k * count : (k + 1) * count] = smooth
            prior += np.outer(mode, mode) / sigma**2
    plain = np.linalg.inv(information.sum(axis=0) + prior)
    x = plain @ vector.sum(axis=0)
    disagree = vector - information @ x  # by windows, as in `rotation.clustered`
    sandwich = plain @ (disagree.T @ disagree) @ plain
    sigmas = np.sqrt(np.maximum(np.diag(sandwich), np.diag(plain))).reshape(2, count)
    with np.errstate(invalid="ignore", divide="ignore"):
        after = np.sqrt(squares / hits)
    before = after if np.isnan(so_far.before).all() else so_far.before
    return Lines(so_far.elevations + x[:count], so_far.ranges + x[count:], sigmas, before, after)


@dataclass(frozen=True, slots=True)
class _Window:
    """Points that lie on planes.

    Attributes:
        off: (n,) m, from the plane. scan: (n,) number in the window. ring: (n,). cube: (n,) number of its plane.
        normals, arms: (n, 3) of the plane, and m from the LiDAR; world.
        basis: (n, 3) effect of the plane's offset and two tilts on the point; an orthonormal basis over each cube.
        beams, raised: (n, 3) change of the point per m of a longer beam, and m per rad of a raised beam; world.
    """

    off: F64
    scan: I64
    ring: U16
    cube: I64
    normals: F64
    arms: F64
    basis: F64
    beams: F64
    raised: F64

    @classmethod
    def of(cls, excerpt: Excerpt, track: Track, scans: range) -> "_Window":
        parts = []
        for number, k in enumerate(scans):
            points = track.points[k][k % EVERY :: EVERY].astype(np.float64)
            flat = np.maximum(np.linalg.norm(points[:, :2], axis=1, keepdims=True), 1e-6)
            beams = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
            raised = np.hstack([-points[:, :2] * points[:, 2:] / flat, flat])
            R = track.rotations[k].T
            ring = excerpt.scans[k].ring[k % EVERY :: EVERY]
            parts.append((points @ R, beams @ R, raised @ R, ring, np.full(len(points), number), track.positions[k]))
        arms, beams, raised, ring, scan = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:5])
        places = arms + np.stack([part[5] for part in parts])[scan]
        cube = np.unique(np.floor(places / CUBE).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
        used = np.ones(len(places), np.bool_)
        for _ in range(3):
            centers, axes, _, flat_cubes = _planes(places, cube, used)
            off = np.abs(np.einsum("ni,ni->n", places - centers[cube], axes[cube, :, 0]))
            used = flat_cubes[cube] & (np.abs(np.einsum("ni,ni->n", beams, axes[cube, :, 0])) > EDGE_ON)
            if used.any():
                used &= off < OUTLIER * 1.48 * np.median(off[used])
        centers, axes, spans, _ = _planes(places, cube, used)
        here = cube[used]
        along = np.einsum("ni,nij->nj", places[used] - centers[here], axes[here])
        basis = np.column_stack([np.ones(len(here)), along[:, 1:]]) / np.maximum(spans[here], 1e-6)
        return cls(
            along[:, 0], scan[used], ring[used], here, axes[here, :, 0], arms[used], basis, beams[used], raised[used]
        )

    def equations(self, lines: int) -> tuple[F64, F64]:
        """(2k, 2k) and (2k,): normal equations of the corrections, poses and planes eliminated."""
        poses = np.hstack([np.cross(self.arms, self.normals), self.normals])
        raised, longer = (np.sum(change * self.normals, axis=1, keepdims=True) for change in (self.raised, self.beams))
        ring = self.ring.astype(np.int64)
        free = 6 * WINDOW
        unknown = _columns(free + 2 * lines, (self.scan, poses), (ring + free, raised), (ring + free + lines, longer))
        of_planes = unknown.T @ _columns(3 * int(self.cube.max()) + 3, (self.cube, self.basis))
        weight = 1.0 / max(float(np.mean(self.off**2)), 1e-8)
        N = weight * (unknown.T @ unknown - of_planes @ of_planes.T).toarray()  # `off` is at right angles to the basis
        v = -weight * (unknown.T @ self.off)
        held = np.linalg.solve(N[:free, :free] + np.eye(free) / LOOSE**2, np.column_stack([N[:free, free:], v[:free]]))
        return N[free:, free:] - N[free:, :free] @ held[:, :-1], v[free:] - N[free:, :free] @ held[:, -1]


def _columns(width: int, *parts: tuple[I64, F64]) -> Any:
    """A sparse matrix (n, width): the values (n, m) of each part in the columns m * owner, m * owner + 1, ..."""
    columns = np.hstack([owner[:, None] * values.shape[1] + np.arange(values.shape[1]) for owner, values in parts])
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    entries = np.hstack([values for _, values in parts]).ravel(), (rows, columns.ravel())
    return csr_array(entries, shape=(len(columns), width))  # type: ignore[no-untyped-call]  # no types


def _planes(places: F64, cube: I64, used: npt.NDArray[np.bool_]) -> tuple[F64, F64, F64, npt.NDArray[np.bool_]]:
    """For each cube: center (c, 3) m; axes (c, 3, 3) as columns with the normal first; norms (c, 3) of a vector of ones
    over its points, and of their coordinates along the other two axes; and whether it is flat."""
    total = int(cube.max()) + 1
    there = cube[used]
    hits = np.bincount(there, minlength=total)
    share = 1.0 / np.maximum(hits, 1)
    centers = np.stack([np.bincount(there, places[used, i], total) for i in range(3)], axis=1) * share[:, None]
    away = places[used] - centers[there]
    spread = np.empty((total, 3, 3))
    for i in range(3):
        for j in range(3):
            spread[:, i, j] = np.bincount(there, away[:, i] * away[:, j], total) * share
    sizes, axes = np.linalg.eigh(spread)
    flat = (hits >= FEWEST) & (sizes[:, 0] < THICKEST**2) & (sizes[:, 1] > FLAT**2 * sizes[:, 0])
    spans = np.sqrt(np.column_stack([hits, hits[:, None] * np.maximum(sizes[:, 1:], 0.0)]))
    return centers, axes, spans, flat
