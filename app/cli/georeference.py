"""`hemislam georeference`: where on Earth a map lies."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.georeference.align import Alignment
    from app.georeference.fixes import Fixes
    from app.slam.trajectory import Trajectory


def georeference(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="A folder that `run` or the workbench wrote.")],
    gnss: Annotated[
        Path | None,
        typer.Option(
            "--gnss",
            metavar="FILE",
            help="NMEA log or CSV of fixes, or a recording that holds them; default: that of RESULTS.",
        ),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option("--control", metavar="FILE", help="CSV of control points: name,E,N,H or name,lat,lon,height."),
    ] = None,
    picks: Annotated[
        Path | None, typer.Option("--picks", metavar="FILE", help="CSV of their positions in the map: name,x,y,z.")
    ] = None,
    crs: Annotated[
        str,
        typer.Option("--crs", metavar="EPSG:CODE", help="A plane grid in metres; default: the local UTM zone."),
    ] = "",
    lever_arm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--lever-arm", metavar="X Y Z", help="Metres from the IMU to the antenna, in the IMU's axes."),
    ] = None,
    factors: Annotated[
        bool, typer.Option("--factors", help="Let the fixes bend the map; write the bent map to --out.")
    ] = False,
    accept: Annotated[
        list[int] | None, typer.Option("--accept", metavar="FIX", help="Keep this fix. Repeatable.")
    ] = None,
    reject: Annotated[
        list[int] | None, typer.Option("--reject", metavar="FIX", help="Reject this fix. Repeatable.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for the bent map, with --factors.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace results that --out already holds.")] = False,
    height: Annotated[
        str,
        typer.Option(
            "--height",
            metavar="TEXT",
            help="Reference of the heights in the file: `ellipsoidal`, EPSG:CODE of a height system, or other"
            " words; written into the results.",
        ),
    ] = "",
) -> None:
    """Georeference a map with satellite fixes or control points.

    Fixes rotate and shift the map and correct its tilt; with --factors they also bend it. The offset of the
    receiver's clock is estimated by comparing the motion. So is the lever arm, if it is not given and the motion
    determines it. Fixes that contradict the others are rejected and listed.

    \b
    Writes into RESULTS, or with --factors into --out, beside the bent trajectory.tum and map.ply:
      georeference.json     coordinate system, origin and rotation of the map
      gnss_residuals.csv    every fix or control point: place, residual, verdict
      georeference.svg      path and fixes from above, residuals

    \b
    Examples:
      hemislam georeference runs/walk-1
      hemislam georeference runs/walk-1 --gnss rover.nmea --lever-arm 0.05 -0.1 0.4
      hemislam georeference runs/walk-1 --gnss fixes.csv --crs EPSG:25832
      hemislam georeference runs/walk-1 --factors --out runs/walk-1-bent
      hemislam georeference runs/walk-1 --control points.csv --picks picked.csv --crs EPSG:25832
    """
    from app.georeference import ledger
    from app.georeference.align import align
    from app.georeference.control import CONTROL, PICKS, align_with_points, read_picks
    from app.georeference.tables import read_table
    from app.slam.trajectory import read_tum

    if (control is None) != (picks is None) or (control is not None and (gnss is not None or lever_arm is not None)):
        raise HemislamError("--control and --picks go together, without --gnss and --lever-arm.")
    if factors != (out is not None) or (factors and control is not None):
        raise HemislamError("--factors and --out go together, for fixes.")
    if out is not None and out.resolve() == results.resolve():
        raise HemislamError("The bent map would replace the original; give --out another folder.")
    if both := set(accept or []) & set(reject or []):
        raise HemislamError(f"--accept and --reject both name fix {min(both)}; leave one of them out.")
    if (accept or reject) and control is not None:
        raise HemislamError("--accept and --reject are for fixes.")
    trajectory = read_tum(results / "trajectory.tum")
    if control is not None and picks is not None:
        picked = read_picks(read_table(picks, *PICKS))
        found = align_with_points(read_table(control, *CONTROL), picked, grid=crs, height=height or "ellipsoidal")
        lines = [*ledger.summary(found, "control points"), "", *ledger.table(found)]
    else:
        fixes, heights = _fixes(results, gnss, int(trajectory.stamps_ns[0]))
        overridden = {str(fix): fix in (accept or []) for fix in (*(accept or []), *(reject or []))}
        found = align(trajectory, fixes, grid=crs, height=height or heights, lever=lever_arm, overridden=overridden)
        if unknown := sorted(set(overridden) - set(found.names)):
            raise HemislamError(
                f"There is no fix {unknown[0]} within the time of the trajectory; gnss_residuals.csv lists all."
            )
        if out is not None:
            found, trajectory = _bent(results, out, fixes, found, overridden, replace=force)
            results = out
        lines = ledger.summary(found, "fixes")
        if not found.used.all():
            lines += ["", *ledger.table(found, only_rejected=True)]
    typer.echo("\n".join(lines))
    _write(results, found, trajectory)


def _fixes(results: Path, gnss: Path | None, near_ns: int) -> "tuple[Fixes, str]":
    """Fixes and reference of their heights: of a file, of a recording, or of the recording of the results."""
    from app.export.folder import recording_of
    from app.mapping.earth import fixes_of
    from app.sensors.source import SUFFIXES

    if gnss is not None and not (gnss.is_dir() or gnss.suffix.lower() in SUFFIXES):
        return fixes_of(gnss, gnss, near_ns)
    recording = gnss or recording_of(results)
    if recording is None:
        raise HemislamError(f"{results} has no report.json that names its recording; give the fixes with --gnss FILE.")
    if not recording.exists():
        raise HemislamError(f"There is no recording {recording}; give its path now, or the fixes, with --gnss FILE.")
    return fixes_of(recording, None, near_ns)


def _bent(
    results: Path, out: Path, fixes: "Fixes", found: "Alignment", overridden: dict[str, bool], *, replace: bool
) -> "tuple[Alignment, Trajectory]":
    """Write trajectory and map, bent by the fixes, to `out`, and remove the files of an earlier run there."""
    from app.export.exports import BY_RUN, save_results
    from app.export.folder import read_results
    from app.mapping.earth import bent

    after = bent(read_results(results), fixes, found, overridden)
    assert after.found is not None
    files = [one for one in BY_RUN if one.name in ("trajectory.tum", "map.ply")]
    save_results(out, after, files, replace=replace)
    for other in set(BY_RUN) - set(files):
        (out / other.name).unlink(missing_ok=True)
    return after.found, after.trajectory


def _write(results: Path, found: "Alignment", trajectory: "Trajectory") -> None:
    from app.evaluation.plots import georeference_plot
    from app.georeference import ledger, reference
    from app.slam.text_files import write_texts

    texts = ledger.files(found) | {reference.PLOT: georeference_plot(found, trajectory.positions)}
    write_texts(results, texts)
    typer.echo(f"Written to {results}: {', '.join(texts)}")
