"""The residual of each fix or control point, and whether it counts: as a table, as CSV, and in sentences."""

from typing import TYPE_CHECKING, Any

import numpy as np

from app.georeference import crs, reference
from app.slam.text_files import csv_text

if TYPE_CHECKING:  # every run imports this module, and few need the solver
    from app.georeference.align import Alignment

SURE_OFFSET_S = 1e-3
"""If the offset is less certain than this, the user is told how to determine it better. On foot, 1 ms is about 1 mm."""
COLUMNS = (
    "name", "east_m", "north_m", "height_m", "d_east_m", "d_north_m", "d_height_m", "sigmas", "verdict",
)  # fmt: skip


def residuals_csv(alignment: "Alignment") -> str:
    """One line per fix: its place in the grid, measured minus map, and whether it counts."""
    rows = []
    for name, place, off, sigmas, used in _rows(alignment):
        cells = [f"{value:.4f}" for value in (*place, *off)] + [f"{sigmas:.2f}" if np.isfinite(sigmas) else ""]
        rows.append([name, *cells, "accepted" if used else "rejected"])
    return csv_text(COLUMNS, *rows)


def files(alignment: "Alignment") -> dict[str, str]:
    """The files beside the results: texts by file name."""
    return {reference.FILE: alignment.reference.to_json(), reference.RESIDUALS: residuals_csv(alignment)}


def report(alignment: "Alignment") -> dict[str, Any]:
    """The alignment's part of report.json."""
    rms = dict(zip(("east_m", "north_m", "height_m"), alignment.rms.tolist(), strict=True))
    counts = {"used": int(alignment.used.sum()), "of": len(alignment.used)}
    return {"crs": alignment.reference.crs, "height": alignment.reference.height, "rms": rms, **counts}


def summary(alignment: "Alignment", what: str) -> list[str]:
    """The result in lines; `what` was measured: "fixes" or "control points"."""
    return [f"{name:<19}{text}" if name else text for name, text in in_rows(alignment, what)]


def in_rows(alignment: "Alignment", what: str) -> list[tuple[str, str]]:
    """As `summary`, with names and texts separate."""
    where, used = alignment.reference, int(alignment.used.sum())
    east, north, height = where.origin
    bearing = float(np.degrees(np.arctan2(where.rotation[0][0], where.rotation[1][0])) % 360.0)
    turned = _plus(np.degrees(alignment.yaw_sigma), "°", 3)
    rows = [
        ("Coordinate system", f"{where.crs} ({crs.projected(where.crs).name}), heights {_above(where)}"),
        ("Map origin", f"E {east:.3f} m, N {north:.3f} m, H {height:.3f} m"),
        ("Map x axis", f"{bearing:.3f}° from grid north{turned}"),
        ("Tilt taken out", f"{np.degrees(np.arccos(min(where.rotation[2][2], 1.0))):.3f}°"),
        ("Grid scale", f"{where.scale:.7f}"),
    ]
    if np.isfinite(alignment.offset_sigma_s):
        side = "late" if alignment.offset_s >= 0 else "early"
        plus = _plus(alignment.offset_sigma_s * 1e3, " ms", 1)
        rows.append(("Clock offset", f"{alignment.offset_s * 1e3:.1f} ms{plus} (the fixes are stamped {side})"))
    if any(alignment.lever_arm):
        x, y, z = alignment.lever_arm
        rows.append(("Lever arm", f"{x:.3f} {y:.3f} {z:.3f} m{_plus(alignment.lever_sigma, ' m', 3)}"))
    rms = " ".join(f"{axis} {value:.4f} m" for axis, value in zip("ENH", alignment.rms, strict=True))
    rows.append(("Residuals (RMS)", f"{rms}, of {used} of {len(alignment.used)} {what}"))
    notes = [*alignment.notes, *filter(None, [crs.distortion(where.crs, east, north)])]
    if (sigma_s := alignment.offset_sigma_s) > SURE_OFFSET_S:
        notes.append(
            f"The clock offset is uncertain by {sigma_s * 1e3:.1f} ms; to determine it better, walk longer and change"
            " direction and speed often."
        )
    return [*rows, *(("", note) for note in notes)]


def table(alignment: "Alignment", *, only_rejected: bool = False) -> list[str]:
    """The residuals in lines, m."""
    lines = ["name          dE       dN       dH"]
    for name, _, off, sigmas, used in _rows(alignment):
        if used and only_rejected:
            continue
        far = f"  {sigmas:.0f} σ" if np.isfinite(sigmas) else ""
        lines.append(f"{name:<8}" + "".join(f"{value:9.3f}" for value in off) + ("" if used else f"  rejected{far}"))
    return lines


def _rows(alignment: "Alignment") -> list[tuple[str, list[float], list[float], float, bool]]:
    columns = (alignment.grid, alignment.residuals, alignment.distances, alignment.used)
    return list(zip(alignment.names, *(column.tolist() for column in columns), strict=True))


def _above(where: reference.GeoReference) -> str:
    system = crs.vertical(where.height)
    return where.height if system is None else f"{where.height} ({system.name})"


def _plus(sigma: float, unit: str, digits: int) -> str:
    return f" ± {sigma:.{digits}f}{unit}" if np.isfinite(sigma) else ""
