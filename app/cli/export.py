"""`hemislam export`: the map and the trajectory in formats for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import progress_bar
from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.export.box import Box
    from app.export.exports import Export
    from app.export.points import Choice
    from app.export.results import Results


def export(
    source: Annotated[
        Path, typer.Argument(metavar="RESULTS|SESSION", help="A folder of results, or a session file (.hemislam).")
    ],
    formats: Annotated[
        str, typer.Option("--format", metavar="NAME,...", help="One or more of the names below, separated by commas.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where to write; default: RESULTS/export, or runs/NAME-1."),
    ] = None,
    thin: Annotated[
        float, typer.Option("--thin", metavar="METRES", help="Only the first point in each voxel of this size.")
    ] = 0.0,
    box: Annotated[
        str | None,
        typer.Option(
            "--box",
            metavar="xmin,ymin,zmin,xmax,ymax,zmax[,TURN]",
            help="Only points inside, m; TURN rotates the box about its centre, degrees anticlockwise.",
        ),
    ] = None,
    slab: Annotated[
        float, typer.Option("--slab", metavar="METRES", help="Width of the slab along the path that a profile shows.")
    ] = 1.0,
    moving: Annotated[
        bool,
        typer.Option("--moving/--no-moving", help="With moving points, marked in las, laz, ply and pcd, or without."),
    ] = True,
) -> None:
    """Write a map in formats for other programs.

    A session is replayed first. Coordinates are those of the map. If the results contain a
    georeference.json, formats that support a coordinate system use that of the file. Moving points
    are marked in las, laz, ply and pcd; the other formats omit them.

    \b
    Formats:
      tum         trajectory.tum           poses with stamps
      g2o         graph.g2o                the pose graph of the keyframes
      ply         map.ply                  points and keyframes
      las, laz    map.las, map.laz         LAS 1.4: time, intensity, ring, ground, moving
      e57         map.e57                  one scan with its pose per keyframe
      pcd         map.pcd                  intensity ring ground moving time
      kitti       trajectory.kitti         poses as rows of 12 numbers
      csv         trajectory.csv           poses with easting, northing, height if known
      gpx         trajectory.gpx           the walk as a GPX track
      occupancy   occupancy.pgm, .yaml     occupancy grid for nav2: free, wall, unknown
      floor       floor.png, .pgw          floor plan: a slice 1 to 1.5 m above the ground
      dxf         floor.dxf                the floor plan as outlines
      terrain     terrain.tif              height of the ground as GeoTIFF
      density     density.tif              points per square metre as GeoTIFF
      section     section.png, .svg, .dxf  the --box seen from its front
      profile     profile.png, .svg, .dxf  a slab along the walked path: chainage, height
      kmz         map.kmz                  walk, picture and keyframes for Google Earth
      html        share.html               the map in one page that needs no server

    \b
    Examples:
      hemislam export runs/walk-1 --format laz,e57
      hemislam export runs/walk-1 --format pcd --thin 0.05 --out to_client
      hemislam export session.hemislam --format laz --box=-10,-10,-1,10,10,3
      hemislam export runs/walk-1 --format section --box=-10,-0.2,-2,10,0.2,3,30
    """
    from app.export.exports import of_formats
    from app.export.folder import read_results
    from app.export.points import Choice

    exports = of_formats([name.strip() for name in formats.split(",") if name.strip()])
    if not exports:
        raise HemislamError("--format names no format; give one or more of the names that --help lists.")
    choice = Choice(thin, _box(box), slab, moving)
    if source.is_dir():
        results, folder = read_results(source), out or source / "export"
        if folder.resolve() == source.resolve():
            raise HemislamError(f"{source} is the folder to export; choose another folder as --out.")
        results.choice = choice
        _save(results, folder, exports)
    else:
        _export_session(source, out, exports, choice)


def _export_session(source: Path, out: Path | None, exports: "tuple[Export, ...]", choice: "Choice") -> None:
    from app.cli.replay import repeat
    from app.cli.run import free_folder
    from app.export.exports import results_folder
    from app.georeference import reference
    from app.mapping.earth import georeference_if_possible
    from app.mapping.saving import mark
    from app.mapping.session_file import read_session

    folder = out or free_folder(source)
    with results_folder(folder, replace=True), repeat(source) as (session, stop):
        if stop is not None:
            raise stop
        results = session.results()
        mark(results, read_session(source).state)
        results = georeference_if_possible(results, session.survey, session.edits.done)
        if results.where is None:
            results.where, problem = reference.read(source.parent)
            if problem and folder.resolve() == source.parent.resolve():
                raise HemislamError(f"{problem} Choose another folder as --out, so that the file stays.")
            results.problem = results.problem or problem
        results.choice = choice
        _save(results, folder, exports)


def _save(results: "Results", folder: Path, exports: "tuple[Export, ...]") -> None:
    from app.export.exports import save_results

    with progress_bar("Exporting") as show:
        results.progress = show
        save_results(folder, results, exports, replace=True)
    if results.where is None and results.problem:
        typer.echo(f"hemislam: {results.problem}", err=True)
    for one in exports:
        if (folder / one.name).exists():
            typer.echo(f"{folder / one.name}: {(folder / one.name).stat().st_size / 1e6:.1f} MB")
        else:
            typer.echo(f"There is no {one.name}, because the loop search was off.")


def _box(text: str | None) -> "Box | None":
    from app.export.box import Box

    if text is None:
        return None
    try:
        a, b, c, d, e, f, *turn = map(float, text.split(","))
        (turned,) = turn or [0.0]
    except ValueError:
        raise HemislamError(f"--box takes six numbers xmin,ymin,zmin,xmax,ymax,zmax, or seven, not {text}.") from None
    return Box((a, b, c), (d, e, f), turned)
