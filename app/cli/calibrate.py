"""`hemislam calibrate`: mounting, clock offset and scan-line errors, from a recording alone."""

import json
from pathlib import Path
from typing import Annotated

import typer

from app.cli.options import MOST_S, ParamsFor, RecordingPath, progress_bar, with_params
from app.slam.errors import HemislamError
from app.slam.text_files import write_texts


@with_params
def calibrate(
    recording: RecordingPath,
    params_for: ParamsFor,
    write: Annotated[
        bool, typer.Option("--write", help="Save the result beside the recording, as NAME.params.yaml.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="With --write: also change a NAME.params.yaml that you wrote.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.svg", help="Draw the residuals before and after.")
    ] = None,
    duration: Annotated[
        float,
        typer.Option("--duration", min=5, max=MOST_S, metavar="SECONDS", help="Use only this much of the recording."),
    ] = 120.0,
) -> None:
    """Find the pose of the LiDAR on the IMU, the offset of their clocks and the errors of each scan line.

    The LiDAR is tracked by its scans alone, and its motion is compared with the IMU's. Walk and turn the scanner
    about all axes; values that the motion does not determine are reported as such. If a mounting is given (--preset,
    `sensor.rotation`, `sensor.translation`), the weighted mean of both is saved. An earlier calibration does not
    count as given.

    \b
    Examples:
      hemislam calibrate walk.mcap
      hemislam calibrate walk.mcap --write              `run`, `serve` and `info` then use the result
      hemislam calibrate walk.mcap --json --plot residuals.svg
    """
    from app.calibration import words
    from app.calibration.calibrate import calibrate as find
    from app.cli.run import compile_behind_bar
    from app.sensors.presets import calibrated_beside, sidecar

    if force and not write:
        raise HemislamError("--force belongs to --write; give both.")
    if write and not force:
        words.check_beside(recording)
    if plot is not None and (plot.suffix != ".svg" or plot.is_dir() or not plot.parent.is_dir()):
        raise HemislamError(f"{plot} cannot be written; choose a .svg file in a folder that exists as --plot.")
    params = params_for(recording, calibrated=False)
    if calibrated_beside(recording):
        typer.echo(
            f"The earlier calibration in {sidecar(recording)} is ignored: the recording is calibrated anew.",
            err=as_json,
        )
    compile_behind_bar()
    with progress_bar("Calibrating") as show:
        found = find(recording, params, duration, show)
    if as_json:
        typer.echo(json.dumps(words.as_json(found), indent=2))
    else:
        rows = words.table(found)
        width = max(len(name) for name, _ in rows)
        for name, value in rows:
            typer.echo(f"{name:<{width}}  {value}")
        if contradiction := found.contradiction():
            typer.echo(f"{contradiction}.")
    if plot is not None:
        from app.evaluation.plots import residual_plot

        write_texts(plot.parent, {plot.name: residual_plot(found)})
    values = found.found()
    settings = " ".join(f"--set '{name}={json.dumps(value)}'" for name, value in values.items())
    if write:
        try:
            path = words.write_beside(recording, values)
        except HemislamError as error:
            raise HemislamError(f"{error} Instead, pass {settings}" if settings else str(error)) from None
        typer.echo(f"Saved as {path}; `run`, `serve` and `info` use it. Delete it to undo this.", err=as_json)
    elif not as_json and settings:
        typer.echo(f"Add --write to save this beside the recording, or pass {settings}")
