"""`hemislam calibrate`: the mounting and the clocks, from a recording alone."""

import json
from pathlib import Path
from typing import Annotated

import typer

from app.cli.options import ParamsFor, RecordingPath, progress_bar, with_params
from app.slam.errors import HemislamError


@with_params
def calibrate(
    recording: RecordingPath,
    params_for: ParamsFor,
    write: Annotated[
        bool, typer.Option("--write", help="Keep what was found beside the recording, in NAME.params.yaml.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="With --write: put it into a NAME.params.yaml that you wrote, too.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print numbers for programs.")] = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.svg", help="Draw the residuals before and after.")
    ] = None,
    duration: Annotated[
        float, typer.Option("--duration", min=5, metavar="SECONDS", help="Use only so much of the recording.")
    ] = 120.0,
) -> None:
    """Find how the LiDAR sits on the IMU, and how far apart their clocks are.

    Takes nothing but the recording: `sensor.rotation` and `sensor.translation` are ignored. It follows the LiDAR by its
    scans alone and compares how it turns and moves with the IMU. Walk and turn the scanner about all axes: what the
    motion does not tell is said.

    \b
    Examples:
      hemislam calibrate walk.mcap
      hemislam calibrate walk.mcap --write              `run`, `serve` and `info` use it from then on
      hemislam calibrate walk.mcap --json --plot residuals.svg
    """
    from app.calibration import words
    from app.calibration.calibrate import calibrate as find
    from app.cli.run import compile_behind_bar

    if force and not write:
        raise HemislamError("--force belongs to --write; give both.")
    params = params_for(recording)
    compile_behind_bar()
    with progress_bar("Calibrating", total=1.0, bar_format="{desc}: {percentage:3.0f}% |{bar}| {elapsed}") as show:
        found = find(recording, params, duration, lambda step, fraction: show(fraction))
    if as_json:
        typer.echo(json.dumps(words.as_json(found), indent=2))
    else:
        rows = words.table(found)
        width = max(len(name) for name, _ in rows)
        for name, value in rows:
            typer.echo(f"{name:<{width}}  {value}")
        if contradiction := found.contradiction():
            typer.echo(f"{contradiction}; the parameters say otherwise.")
    if plot is not None:
        from app.cli.calibration_plot import residual_plot

        try:
            plot.write_text(residual_plot(found), encoding="utf-8")
        except OSError as error:
            raise HemislamError(f"{plot} cannot be written ({error.strerror}); choose another --plot.") from None
    if write:
        path = words.write_beside(found, replace=force)
        typer.echo(f"Kept in {path}; `run`, `serve` and `info` use it. Delete it to undo that.", err=as_json)
    elif not as_json and found.found():
        typer.echo("Add --write to keep this beside the recording, or give " + _settings(found.found()))


def _settings(values: dict[str, object]) -> str:
    return " ".join(f"--set '{name}={json.dumps(value)}'" for name, value in values.items())
