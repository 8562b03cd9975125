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
    crs: Annotated[
        str, typer.Option("--crs", metavar="EPSG:CODE", help="A plane grid in metres; else the UTM zone of the place.")
    ] = "",
    lever_arm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--lever-arm", metavar="X Y Z", help="Metres from the IMU to the antenna, in the IMU's axes."),
    ] = None,
) -> None:
    """Find where on Earth a map lies, by satellite fixes.

    Only turns the map about the vertical and moves it: its shape stays. Finds how late the receiver's clock is by
    comparing the motion, and the lever arm if it is not given and the motion tells it. Fixes that contradict the
    others are rejected and named.

    \b
    Writes into RESULTS:
      georeference.json     coordinate system, origin and rotation of the map
      gnss_residuals.csv    every fix: place, residual, verdict
      georeference.svg      path and fixes from above, residuals

    \b
    Examples:
      hemislam georeference runs/walk-1
      hemislam georeference runs/walk-1 --gnss rover.nmea --lever-arm 0.05 -0.1 0.4
      hemislam georeference runs/walk-1 --gnss fixes.csv --crs EPSG:25832
    """
    from app.georeference import ledger
    from app.georeference.align import align
    from app.georeference.tables import read_fixes
    from app.sensors.navsat import recorded_fixes
    from app.slam.trajectory import read_tum

    trajectory = read_tum(results / "trajectory.tum")
    if gnss is not None:
        fixes, height = read_fixes(gnss, int(trajectory.stamps_ns[0]))
    else:
        fixes, height = recorded_fixes(_recording_of(results)), "ellipsoidal"
    found = align(trajectory, fixes, grid=crs, height=height, lever=lever_arm)
    lines = ledger.summary(found, "fixes")
    if not found.used.all():
        lines += ["", *ledger.table(found, only_rejected=True)]
    typer.echo("\n".join(lines))
    _write(results, found, trajectory)


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
