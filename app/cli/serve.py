"""`hemislam serve`: the workbench in the browser."""

from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from app.cli.options import Calibrate, Duration, ParamsFor, Start, TruthFile, say_calibrated, with_params
from app.slam.errors import HemislamError


@with_params
def serve(
    params_for: ParamsFor,
    recording: Annotated[
        Path | None,
        typer.Argument(
            metavar="RECORDING", help="A recording or a session file to open first. The page can open others."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option("--host", metavar="ADDRESS", help="0.0.0.0 admits other computers, by a link with a token.")
    ] = ("127.0.0.1"),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, metavar="PORT", help="0 picks a free one.")] = 8080,
    folder: Annotated[
        list[Path] | None,
        typer.Option(
            "--folder",
            metavar="DIR",
            help="The page may open recordings below DIR. Repeatable. Default: RECORDING's folder, or the current one.",
        ),
    ] = None,
    point_budget: Annotated[
        int,
        typer.Option(
            "--point-budget",
            min=10_000,
            metavar="N",
            help="Most map points that the page draws; in a larger map, more of those near the camera.",
        ),
    ] = 3_000_000,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address only.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for Play instead of starting at once.")] = False,
    checkpoint_memory: Annotated[
        int,
        typer.Option(
            "--checkpoint-memory",
            min=16,
            metavar="MB",
            help="Memory for going back to any frame. Up to four times as much goes to temporary files.",
        ),
    ] = 1024,
    live: Annotated[
        str | None,
        typer.Option(
            "--live",
            metavar="URL",
            help="Map live from a sensor: rsbpearl://0.0.0.0:6699,7788, airy://, mid360:// or foxglove://HOST:8765.",
        ),
    ] = None,
    imu: Annotated[
        str | None,
        typer.Option("--imu", metavar="URL", help="Where IMU samples come from: imu-udp://:6700 or foxglove://..."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="FILE", help="Record the live data into this .mcap.")
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", metavar="PEM", help="Serve https with this certificate.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option("--key", metavar="PEM", help="The certificate's key, if it is in a separate file.")
    ] = None,
    log_json: Annotated[bool, typer.Option("--log-json", help="Log to stderr, one JSON object per line.")] = False,
    start: Start = 0.0,
    duration: Duration = None,
    truth: TruthFile = None,
    calibrate: Calibrate = True,
) -> None:
    """Open the workbench in the browser.

    Replays a recording and shows the map as it grows. Every parameter can be changed while it runs.
    In the page, space plays and pauses, and the arrow keys step one frame. Ctrl-C ends hemislam.

    \b
    Examples:
      hemislam serve walk.mcap
      hemislam serve indoor1.bag --preset h2lid --paused
      hemislam serve runs/sessions/walk-20261121-101500.hemislam     continues that session
      hemislam serve --folder ~/recordings --port 8081
      hemislam serve --live rsbpearl://0.0.0.0:6699,7788 --imu imu-udp://:6700 --record walk.mcap
      hemislam serve --live foxglove://robot:8765 --preset rslidar
      hemislam serve walk.mcap --host 0.0.0.0            open to other computers, by the printed link
    """
    from app.child import fork_context
    from app.logs import start_logging

    start_logging(json_lines=log_json)
    fork_context("app.server.engine_process")  # the fork server imports it while this process imports the rest
    from app.evaluation.truth import check_poses
    from app.mapping.session_file import SUFFIX, read_session
    from app.sensors.live.process import LiveProcess
    from app.sensors.recording import open_recording
    from app.server.folders import Folders
    from app.server.protocol import LIVE
    from app.server.setup import Setup
    from app.server.web import ServedPage, Tls, run_server
    from app.slam.trajectory import truth_beside

    if key is not None and certificate is None:
        raise HemislamError("--key needs --certificate; give both.")
    tls = Tls(certificate, key) if certificate else None
    if tls is not None:
        tls.check()
    if live is not None and recording is not None:
        raise HemislamError("Give a recording or --live, not both.")
    if live is None and (imu or record):
        raise HemislamError("--imu and --record need --live, which names the source of the scans.")
    if live is not None and (paused or start or duration is not None or truth is not None):
        raise HemislamError(
            "--paused, --start, --duration and --truth belong to a recording; leave them out with --live."
        )
    session = read_session(recording) if recording is not None and recording.suffix == SUFFIX else None
    if session is not None and (start or duration is not None or truth is not None):
        raise HemislamError("--start, --duration and --truth belong to a recording; a session file has its own.")
    params = session.state.params if session else params_for(recording)
    if session is not None and any(params_for.keywords.values()):
        params_for(None)  # raises for a misspelt one
        typer.echo("The session keeps its own parameters; those given here hold for recordings that are opened later.")
    if recording is not None:
        opened = session.opened.recording if session else recording
        say_calibrated(opened)
    if truth is not None:
        check_poses(truth)
    elif recording is not None:
        truth = truth_beside(recording)

    def build_page(viser: Any, forks: Any, folders: Folders) -> ServedPage:
        """Runs while the engine opens the recording. A fault of the recording is reported here, not in the page."""
        if recording is not None:
            open_recording(opened, session.first_params if session else params).close()
        from app.ui.workbench import Workbench

        return Workbench(
            viser,
            forks,
            folders,
            point_budget=point_budget,
            results=Path("runs"),
            calibrate=calibrate,
            resolve=params_for,
        )

    with (
        TemporaryDirectory(prefix="hemislam-") as folder_live,
        LiveProcess(live, params, imu, record) if live else nullcontext() as source,
    ):
        run_server(
            Setup(
                recording=recording or (LIVE if live else None),
                truth=truth,
                params=params,
                start_s=start,
                duration_s=duration,
                resolve=params_for,
                play=not paused or live is not None,
                point_budget=point_budget,
                checkpoint_bytes=checkpoint_memory << 20,
                session_folder=Path("runs") / "sessions",
                live=source.address if source else None,
                live_folder=Path(folder_live),
            ),
            folders=Folders(folder or [recording.resolve().parent if recording else Path.cwd()]),
            build_page=build_page,
            host=host,
            port=port,
            open_browser=not no_browser,
            tls=tls,
        )
