"""Which scan line a point belongs to: the rank of the line's elevation, 0 = lowest = outermost cone.

The ring comes from a field (sorted by elevation if the driver numbers the lines differently), from a point's place in
the message, or, if neither helps, from its elevation.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.sensors.cloud_types import CloudMessage, CloudType, Probe, values_at
from app.sensors.findings import Finding
from app.slam.sections import SensorParams
from app.slam.types import F32, F64, I64, U16, Scan

_ENOUGH = 50_000
"""Points that suffice to separate the lines."""
_LEAST_LINES = 4
"""Fewer lines are not scan lines: the pattern does not repeat."""
RING_DEG = 2.0
"""Width in elevation of a ring if the sensor has no scan lines."""
_COMMON_LINES = (16, 32, 40, 64, 80, 128)


@dataclass(frozen=True, slots=True)
class Rings:
    """Where the ring of a point comes from.

    Attributes:
        field: name of a field; None: from the point's place or elevation.
        place: (step, lines): point i of the message is on line (i // step) % lines.
        rank: (lines,) uint16, rank by elevation of each value of the field or place; None: the value
            already is the rank.
        bounds: (lines - 1,) rad, ascending, the elevations that separate the lines; None: from field or place.
        centre: (radial, height) m, the origin of the beams to which `bounds` refer.
        of_lines: False if the sensor has no scan lines and rings are equal steps of elevation.
    """

    field: str | None = None
    place: tuple[int, int] = (1, 1)
    rank: U16 | None = None
    bounds: F64 | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    of_lines: bool = True

    def of(self, cloud: CloudMessage, points: F32, index: npt.NDArray[np.intp]) -> U16:
        """(n,) uint16 ring of the kept points, whose places in the message are `index`."""
        if self.bounds is not None:
            return np.searchsorted(self.bounds, elevation(points, self.centre)).astype(np.uint16)
        step, lines = self.place
        raw = index // step % lines if self.field is None else values_at(cloud.column(self.field), index)
        number = raw.astype(np.uint16)
        return number if self.rank is None else self.rank.take(np.minimum(number, len(self.rank) - 1))


def elevation(points: F32, centre: tuple[float, float] = (0.0, 0.0)) -> F32:
    """(n,) float32 rad above the sensor's base plane, seen from (radial, height) m."""
    radial, height = centre
    level = np.hypot(points[:, 0], points[:, 1]) - np.float32(radial)
    angle: F32 = np.arctan2(points[:, 2] - np.float32(height), level)
    return angle


def settle_rings(probes: list[Probe], kind: CloudType, names: dict[str, str]) -> tuple[Rings, Finding]:
    """Decide where the ring comes from; `names` maps lower-case field names to the real ones."""
    field = next((names[name] for name in kind.rings if name in names), None)
    points = np.concatenate([probe.points for probe in probes])
    far = _far(points)
    if field is not None:
        raw = np.concatenate([probe.column(field) for probe in probes]).astype(np.int64)
        if raw.min() >= 0 and raw.max() < 4096 and raw.max() > raw.min():
            if _spread(raw[far], elevation(points[far])) < 1.0:
                return _settle_field(field, raw[far], elevation(points[far]), int(raw.max()) + 1)
            why = f"points of each `{field}` have all elevations"
        else:
            constant = raw.max() == raw.min()
            why = f"field `{field}` is always {raw[0]}" if constant else f"field `{field}` is not a line number"
    else:
        why = "the clouds have no ring field"
    if not kind.rings:
        return _settle_steps(points, why)
    if (by_place := _settle_place(probes, why)) is not None:
        return by_place
    bounds, centre = _settle_elevation(points)
    lines = len(bounds) + 1
    if lines >= _LEAST_LINES:
        text = f"{why}; {lines} scan lines were separated by their elevation"
        return Rings(bounds=bounds, centre=centre), Finding("ring order", "corrected", text)
    return _settle_steps(points, f"{why}, and no scan lines can be told apart")


def line_findings(scans: list[Scan], has_lines: bool, params: SensorParams) -> list[Finding]:
    """Findings about corrections whose number differs from the number of lines in a recording's first scans."""
    found, lines = [], 1 + max(int(scan.ring.max()) for scan in scans if len(scan)) if has_lines else 0
    for name in ("elevation_corrections", "range_corrections"):
        given = len(getattr(params, name).split())
        if given and not lines <= given <= _all_lines(lines):
            there = f"the LiDAR has {lines} scan lines" if has_lines else "the LiDAR has no scan lines"
            text = f"`sensor.{name}` holds {given} numbers, but {there}; use the corrections of this LiDAR, or none"
            found.append(Finding("scan lines", "needs you", text, f'--set sensor.{name}=""'))
    return found


def _all_lines(seen: int) -> int:
    """The probable number of lines of a sensor, given the number seen: some may see only sky at first."""
    return next((lines for lines in (8, *_COMMON_LINES) if lines >= seen), seen) if seen else 0


def _settle_steps(points: F32, why: str) -> tuple[Rings, Finding]:
    lowest, highest = np.percentile(elevation(points), [0.5, 99.5])
    bounds = np.arange(lowest, highest, np.radians(RING_DEG))[1:]
    text = f"{why}; M counts {len(bounds) + 1} rings of {RING_DEG:g} deg instead"
    return Rings(bounds=bounds, of_lines=False), Finding("ring order", "corrected", text)


def _far(points: F32) -> npt.NDArray[np.intp]:
    """Indices of the farther half, where the different origins of the beams hardly change the elevation."""
    distance = np.linalg.norm(points, axis=1)
    far = np.flatnonzero(distance >= np.median(distance))
    return far[:: max(1, len(far) // _ENOUGH)]


def _settle_field(field: str, raw: I64, angles: F32, lines: int) -> tuple[Rings, Finding]:
    present, medians = _line_medians(raw, angles)
    rises = np.diff(medians) > 0
    share = float(rises.mean()) if len(rises) else 1.0
    span = f"{np.degrees(medians.min()):.1f} to {np.degrees(medians.max()):.1f} deg"
    if share >= 0.9:
        return Rings(field), Finding(
            "ring order", "fine", f"`{field}` counts {lines} scan lines from the lowest elevation up ({span})"
        )
    if share <= 0.1:
        lines = _all_lines(lines)
        rank = np.arange(lines - 1, -1, -1, dtype=np.uint16)
        text = f"`{field}` counts {lines} scan lines from the highest elevation down ({span}); reversed"
        return Rings(field, rank=rank), Finding("ring order", "corrected", text)
    text = f"`{field}` numbers {lines} scan lines in no order of elevation ({span}); ranked by elevation"
    return Rings(field, rank=_ranked(present, medians, lines)), Finding("ring order", "corrected", text)


def _settle_place(probes: list[Probe], why: str) -> tuple[Rings, Finding] | None:
    """Row-major rows, or lines interleaved in firing order, if either explains the elevations."""
    first = probes[0].cloud
    layouts = [(first.width, first.height), (1, first.height)] if 4 <= first.height <= 256 else []
    layouts += [(1, lines) for lines in _COMMON_LINES if len(first) % lines == 0 and (1, lines) not in layouts]
    alike = len({(probe.cloud.height, probe.cloud.width) for probe in probes}) == 1
    far = [_far(probe.points) for probe in probes]
    index = np.concatenate([probe.index[some] for probe, some in zip(probes, far, strict=True)])
    angles = np.concatenate([elevation(probe.points[some]) for probe, some in zip(probes, far, strict=True)])
    for step, lines in layouts:
        raw = index // step % lines
        present, medians = _line_medians(raw, angles)
        if (alike or step == 1) and len(present) >= max(3, lines // 2) and _spread(raw, angles) < 0.25:
            text = f"{why}; the order of the points shows {lines} scan lines, ranked by elevation"
            rings = Rings(place=(step, lines), rank=_ranked(present, medians, lines))
            return rings, Finding("ring order", "corrected", text)
    return None


def _settle_elevation(points: F32) -> tuple[F64, tuple[float, float]]:
    """Elevations that separate the lines, seen from the centre that makes the lines sharpest."""
    edges = np.radians(np.arange(-90.0, 90.05, 0.1))
    some = points[:: max(1, len(points) // _ENOUGH)]

    def sharpness(centre: tuple[float, float]) -> float:
        counts = np.histogram(elevation(some, centre), edges)[0].astype(np.float64)
        return float(counts @ counts)

    heights = np.arange(-0.12, 0.1201, 0.01)
    # The plain origin wins unless another one is clearly sharper.
    centre = max([(0.0, 0.0)] + [(r, h) for r in (0.0, 0.015, 0.03) for h in heights], key=sharpness)
    if sharpness(centre) < 1.1 * sharpness((0.0, 0.0)):
        centre = (0.0, 0.0)
    counts = np.histogram(elevation(points, centre), edges)[0].astype(np.float64)
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], mode="same")
    floor = 0.1 * np.percentile(smooth[smooth > 0], 90) if smooth.any() else 0.0
    peaks = np.flatnonzero((smooth > floor) & (smooth >= np.roll(smooth, 1)) & (smooth > np.roll(smooth, -1)))
    # Two peaks with hardly a dip between them are one line, blurred.
    kept: list[int] = []
    for peak in peaks:
        if kept and smooth[kept[-1] : peak + 1].min() > 0.5 * min(smooth[kept[-1]], smooth[peak]):
            if smooth[peak] > smooth[kept[-1]]:
                kept[-1] = int(peak)
        else:
            kept.append(int(peak))
    centres = 0.5 * (edges[kept] + edges[np.asarray(kept, int) + 1])
    return 0.5 * (centres[1:] + centres[:-1]), centre


def _spread(raw: I64, angles: F32) -> float:
    """Spread of the points about the elevation of their line, relative to the distance between two lines."""
    present, medians = _line_medians(raw, angles)
    within = np.median(np.abs(angles - medians[np.searchsorted(present, raw).clip(max=len(present) - 1)]))
    between = np.median(np.diff(np.sort(medians))) if len(medians) > 1 else np.inf
    return float(within / between) if between > 0 else np.inf


def _line_medians(raw: I64, angles: F32) -> tuple[I64, F64]:
    """Lines with enough points, and the median elevation of each."""
    present, counts = np.unique(raw, return_counts=True)
    present = present[counts >= 5] if (counts >= 5).any() else present
    medians = np.array([np.median(angles[raw == line]) for line in present], np.float64)
    return present, medians


def _ranked(present: I64, medians: F64, lines: int) -> U16:
    """(lines,) rank of each line; a line that the probe never saw comes last, where no seeds are searched."""
    rank = np.full(lines, len(present), np.uint16)
    rank[present[np.argsort(medians)]] = np.arange(len(present), dtype=np.uint16)
    return rank
