"""`hemislam georeference`: where on Earth a map lies."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.georeference.align import Alignment
    from app.slam.trajectory import Trajectory

RESIDUALS, PLOT = "gnss_residuals.csv", "georeference.svg"


def georeference(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="A folder that `run` or the workbench wrote.")],
    gnss: Annotated[
        Path | None,
        typer.Option("--gnss", metavar="FILE", help="NMEA log or CSV of fixes; else those in the recording."),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option("--control", metavar="FILE", help="CSV of control points: name,E,N,H or name,lat,lon,height."),
    ] = None,
    picks: Annotated[
        Path | None, typer.Option("--picks", metavar="FILE", help="CSV of where they are in the map: name,x,y,z.")
    ] = None,
    crs: Annotated[
        str, typer.Option("--crs", metavar="EPSG:CODE", help="A plane grid in metres; else the UTM zone of the place.")
    ] = "",
    lever_arm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--lever-arm", metavar="X Y Z", help="Metres from the IMU to the antenna, in the IMU's axes."),
    ] = None,
    height: Annotated[
        str,
        typer.Option("--height", metavar="TEXT", help="What the file's heights are above, to be written beside them."),
    ] = "",
) -> None:
    """Find where on Earth a map lies, by satellite fixes or control points.

    The map's shape stays. By fixes, it is only turned about the vertical and moved. That finds how late the receiver's
    clock is by comparing the motion, and the lever arm if it is not given and the motion tells it. Fixes that
    contradict the others are rejected and named.

    \b
    Writes into RESULTS:
      georeference.json     coordinate system, origin and rotation of the map
      gnss_residuals.csv    every fix or control point: place, residual, verdict
      georeference.svg      path and fixes from above, residuals

    \b
    Examples:
      hemislam georeference runs/walk-1
      hemislam georeference runs/walk-1 --gnss rover.nmea --lever-arm 0.05 -0.1 0.4
      hemislam georeference runs/walk-1 --gnss fixes.csv --crs EPSG:25832
      hemislam georeference runs/walk-1 --control points.csv --picks picked.csv --crs EPSG:25832
    """
    from app.georeference import ledger
    from app.georeference.control import lay_on_control
    from app.slam.trajectory import read_tum

    if (control is None) != (picks is None) or (control is not None and (gnss is not None or lever_arm is not None)):
        raise HemislamError("--control and --picks go together, without --gnss and --lever-arm.")
    trajectory = read_tum(results / "trajectory.tum")
    if control is not None and picks is not None:
        found = lay_on_control(control, picks, grid=crs, height=height or "ellipsoidal")
        lines = [*ledger.summary(found, "control points"), "", *ledger.table(found)]
    else:
        found = _by_fixes(results, trajectory, gnss, crs, lever_arm, height)
        lines = ledger.summary(found, "fixes")
        if not found.used.all():
            lines += ["", *ledger.table(found, only_rejected=True)]
    typer.echo("\n".join(lines))
    _write(results, found, trajectory)


def _by_fixes(
    results: Path,
    trajectory: "Trajectory",
    gnss: Path | None,
    crs: str,
    lever_arm: tuple[float, float, float] | None,
    height: str,
) -> "Alignment":
    from app.georeference.align import align
    from app.georeference.tables import read_fixes
    from app.sensors.navsat import recorded_fixes

    if gnss is not None:
        fixes, told = read_fixes(gnss, int(trajectory.stamps_ns[0]))
    else:
        fixes, told = recorded_fixes(_recording_of(results)), "ellipsoidal"
    return align(trajectory, fixes, grid=crs, height=height or told, lever=lever_arm)


def _recording_of(results: Path) -> Path:
    """That the results were made of."""
    try:
        return Path(json.loads((results / "report.json").read_text(encoding="utf-8"))["recording"]["path"])
    except (OSError, ValueError, KeyError, TypeError):
        raise HemislamError(
            f"{results} has no report.json that names its recording; give the fixes with --gnss FILE."
        ) from None


def _write(results: Path, found: "Alignment", trajectory: "Trajectory") -> None:
    from app.cli.georeference_plot import georeference_plot
    from app.georeference import ledger, reference

    texts = {
        reference.FILE: found.reference.to_json(),
        RESIDUALS: ledger.residuals_csv(found),
        PLOT: georeference_plot(found, trajectory.positions),
    }
    try:
        for name, text in texts.items():
            (results / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise HemislamError(f"{results} cannot be written to: {error.strerror}.") from None
    typer.echo(f"Written to {results}: {', '.join(texts)}")
