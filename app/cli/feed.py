"""`hemislam feed`: sends a recording as if it came from the sensors."""

import math
from typing import Annotated

import typer

from app.cli.options import Duration, ParamsFor, RecordingPath, progress_bar, with_params
from app.slam.errors import HemislamError


@with_params
def feed(
    recording: RecordingPath,
    params_for: ParamsFor,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="URL",
            help="rsbpearl://HOST:MSOP,DIFOP, airy://HOST, mid360://HOST, or foxglove://HOST:PORT to act as a server.",
        ),
    ],
    imu_to: Annotated[
        str | None,
        typer.Option(
            "--imu-to", metavar="URL", help="imu-udp://HOST:PORT, for an RS-Bpearl; default: port 6700 of its HOST."
        ),
    ] = None,
    speed: Annotated[
        float, typer.Option("--speed", metavar="X", help="Multiple of real time; 0: as fast as possible.")
    ] = 1.0,
    duration: Duration = None,
) -> None:
    """Send a recording as live data, to try `serve --live` without a sensor.

    Sends packets of an RS-Bpearl and a separate IMU, of an Airy or of a Mid-360, or acts as a Foxglove server
    like foxglove_bridge.

    \b
    Examples:
      hemislam feed walk.mcap --to rsbpearl://127.0.0.1:6699,7788 --imu-to imu-udp://127.0.0.1:6700
      hemislam feed walk.mcap --to mid360://127.0.0.1
      hemislam feed walk.mcap --to foxglove://127.0.0.1:8765 --speed 2
    """
    from app.sensors.live.feed import Pace
    from app.sensors.live.feed import feed as play
    from app.sensors.live.urls import parse_address

    if not speed >= 0:  # nan neither
        raise HemislamError(f"`--speed {speed:g}` is negative; 1 is real time, 0 as fast as possible.")
    params = params_for(recording)
    target, beside = parse_address(to), parse_address(imu_to) if imu_to else None
    if "clock" in target.options:
        raise HemislamError(f"`{to}`: the receiver chooses the clock: serve --live '…?clock=…'.")
    if target.scheme == "foxglove" and beside is not None:
        raise HemislamError("--imu-to applies to packets only; a Foxglove server sends IMU samples itself.")
    if target.scheme == "rsbpearl" and beside is None:
        beside = parse_address(f"imu-udp://{target.host}")
        typer.echo(f"IMU samples go to imu-udp://{target.host}:{beside.ports[0]}")
    if target.scheme == "foxglove":
        typer.echo(f"Waiting at {to} for a receiver; Ctrl+C ends it.")
    lost: list[str] = []
    with progress_bar("Playing", bar_format="{desc}: {n:.1f} s") as show:
        pace = Pace(speed or math.inf, progress=show, lost=lost.append)
        count = play(recording, params, target, beside, pace=pace, duration_s=duration)
    typer.echo(f"{count} {'messages' if target.scheme == 'foxglove' else 'packets'} sent.")
    if lost:
        typer.echo(f"Messages that cannot be read were not sent: at least {len(lost)}; the first: {lost[0]}.")
