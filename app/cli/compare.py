"""`hemislam compare`: how far one map lies from another."""

from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import progress_bar
from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.evaluation.cloud_distance import Comparison
    from app.slam.types import F64


def compare(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="A folder of results, or a .ply, .las or .laz.")],
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="The other map, in the same frame.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.ply", help="Write the points of MAP with their distances.")
    ] = None,
    fit: Annotated[
        bool, typer.Option("--fit", help="Move OTHER onto MAP first; they must lie within 2 m and a few degrees.")
    ] = False,
    reach: Annotated[
        float, typer.Option("--reach", metavar="METRES", min=0.01, max=10.0, help="Farther surfaces do not correspond.")
    ] = 0.5,
) -> None:
    """Measure how far one map lies from another.

    Distances are along the surface normal, positive where MAP lies in front
    of OTHER: towards the sensor for results, upwards for other files. For each
    point, the smallest significant distance (level of detection) is given too.

    \b
    Examples:
      hemislam compare runs/walk-1 runs/walk-2
      hemislam compare runs/walk-1 survey.laz --fit --out changes.ply
    """
    from app.evaluation import cloud_distance
    from app.evaluation.map_comparison import in_frame_of, read_map, sentences
    from app.georeference.reference import read

    if out is not None:
        _check(out, map_, other)
    (points, sensors), (others, _) = read_map(map_), read_map(other)
    others = in_frame_of(points, read(map_)[0], others, read(other)[0])
    with progress_bar("Comparing") as show:
        found = cloud_distance.compare(points, sensors, others, reach=reach, fit=fit, progress=show)
    typer.echo(f"median       {100 * found.median:+7.1f} cm")
    typer.echo(f"half within  {100 * found.typical:7.1f} cm")
    typer.echo(f"95 % within  {100 * found.p95:7.1f} cm")
    typer.echo(" ".join(sentences(found, str(other))))
    if out is not None:
        _write(out, points, found)
        typer.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


def _check(out: Path, *maps: Path) -> None:
    """Refuse early an output that cannot be written or would replace one of the maps."""
    if out.suffix.lower() != ".ply" or out.is_dir() or not out.parent.is_dir():
        raise HemislamError(f"{out} cannot be written; choose a .ply file in a folder that exists as --out.")
    try:
        with NamedTemporaryFile(dir=out.parent):
            pass
    except OSError as error:
        raise HemislamError(f"{out} cannot be written ({error.strerror}); choose another file as --out.") from None
    if out.resolve() in {(path / "map.ply" if path.is_dir() else path).resolve() for path in maps}:
        raise HemislamError(f"{out} is a map to compare; choose another file as --out.")


def _write(path: Path, points: "F64", found: "Comparison") -> None:
    import numpy as np

    from app.slam.ply import header

    names = ("x", "y", "z", "distance", "detectable")
    vertices = np.empty(len(points), [(name, "<f8" if name in "xyz" else "<f4") for name in names])
    for name, column in zip(names, (*points.T, found.distance, found.detectable), strict=True):
        vertices[name] = column
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(header(vertices.dtype, len(vertices), "metres") + vertices.tobytes())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
