"""`hemislam run`: a recording from end to end, without a browser."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.options import (
    Calibrate,
    Duration,
    Force,
    ParamsFor,
    RecordingPath,
    RunFolder,
    Start,
    TruthFile,
    progress_bar,
    say_calibrated,
    with_params,
)
from app.slam.errors import HemislamError, quoted

if TYPE_CHECKING:
    from app.mapping.session import Session
    from app.slam.params import Params

UNASKED_S = 60.0
"""s: length of the part of a recording that is used for an automatic calibration."""


@with_params
def run(
    recording: RecordingPath,
    params_for: ParamsFor,
    out: RunFolder = None,
    force: Force = False,
    start: Start = 0.0,
    duration: Duration = None,
    truth: TruthFile = None,
    loops: Annotated[
        Path | None, typer.Option("--loops", metavar="FILE", help="Loop edits, as the workbench saves them.")
    ] = None,
    calibrate: Calibrate = True,
) -> None:
    """Process a recording without a browser and write the results.

    \b
    Writes into DIR:
      trajectory.tum           pose of the IMU in the map at the end of each scan: stamp x y z qx qy qz qw
      trajectory_odometry.tum  the same by odometry alone, without loops
      loops.csv                every loop candidate: verdict, measurements and reason
      graph.g2o                the pose graph of the keyframes
      timings.csv              milliseconds of each stage in each frame, except reading the recording
      map.ply                  the map: x y z intensity ground moving ring time; keyframes
      report.json              parameters, frame counts, ground share, errors against the truth

    \b
    Examples:
      hemislam run walk.mcap
      hemislam run indoor1.bag --preset h2lid --out results/indoor1
      hemislam run walk.mcap --set ground.alpha=30 --start 10 --duration 60 --truth walk.tum
      hemislam run walk.mcap --loops edits.yaml
    """
    from app.evaluation.truth import check_poses
    from app.export.exports import results_folder
    from app.mapping.opening import open_session
    from app.slam.doubts import doubts
    from app.slam.loops import edit_files
    from app.slam.trajectory import truth_beside
    from app.slam.user_text import read_text

    params = params_for(recording)
    say_calibrated(recording)
    edits = edit_files.read(read_text(loops, "save loop edits in the workbench"), str(loops)) if loops else ()
    folder = out or free_folder(recording)
    truth_path = truth or truth_beside(recording)
    if truth_path:
        check_poses(truth_path)
    with results_folder(folder, replace=force):
        params, advised = settle_mounting(recording, params) if calibrate else (params, "")
        if advised:
            typer.echo(advised)
        session = open_session(recording, params, start, duration, truth=truth_path, read_ahead=True)
        try:
            if truth:
                session.compare_with(truth)
            elif truth_path:
                typer.echo(f"Using the truth beside the recording: {truth_path}")
            for finding in session.findings:
                if finding.verdict != "fine":
                    typer.echo(f"{finding.verdict}: {finding.subject}: {finding}")
            compile_behind_bar()
            if session.loops:
                session.loops.only_results()
            if edits:
                session.edit_loops(edits)
            stop = process(session)
            if session.frame < 0:
                raise stop or HemislamError(_nothing_processed(session))
            if calibrate and not advised and doubts(session.log, session.log.stamps_ns):  # a pause is no cause
                advised = look_for_mounting(recording, params)
            session.calibration = advised
            save(session, folder, stop, replace=force)
        finally:
            session.close()


def settle_mounting(recording: Path, params: "Params") -> tuple["Params", str]:
    """The parameters, with the mounting found in the recording if none is given, and a sentence that says so."""
    from app.calibration.calibrate import is_mounting_unknown

    if not is_mounting_unknown(params):
        return params, ""
    values, why = _contradicting(recording, params, "Estimating the pose of the LiDAR on the IMU")
    if values is None:
        return params, why
    return params.with_values(values), f"{why}; `run` and `serve` use this. To save it: {_saving(recording)}"


def look_for_mounting(recording: Path, params: "Params") -> str:
    """A sentence if the recording shows another mounting than the parameters; otherwise ""."""
    values, why = _contradicting(recording, params, "Looking for the cause")
    return why if values is None else f"{why}: {_saving(recording)}"


def _contradicting(recording: Path, params: "Params", title: str) -> tuple[dict[str, Any] | None, str]:
    """Values found in the recording that contradict the parameters, and a sentence on them; else None, and why."""
    from app.calibration.calibrate import AxesError, calibrate

    with progress_bar(title) as show:
        try:
            found = calibrate(recording, params, UNASKED_S, show)
        except AxesError as error:
            return None, str(error)
        except HemislamError:  # such as too short a recording; opening it reports what is wrong with it
            return None, ""
    contradiction = found.contradiction()
    return found.found() if contradiction else None, contradiction


def _saving(recording: Path) -> str:
    return f"hemislam calibrate {quoted(recording)} --write"


@contextlib.contextmanager
def _despite_one_interrupt() -> Iterator[None]:
    def warn(*_: object) -> None:
        typer.echo("hemislam: saving the results; press Ctrl-C again to discard them.", err=True)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, warn)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@_despite_one_interrupt()
def save(session: "Session", folder: Path, stop: BaseException | None, *, replace: bool) -> None:
    """Write the results and print a summary. A first Ctrl-C does not stop this.

    Raises:
        BaseException: `stop`, what ended the run early, once the frames so far are saved.
    """
    from app.slam.report import summarise

    stopped = "" if stop is None else str(stop) or type(stop).__name__
    while session.keyframes.find_moving(last=True):
        pass  # the loop search is at the last keyframes meanwhile
    report = session.save(folder, replace=replace, stopped=stopped).result()
    typer.echo(summarise(report, folder))
    if problem := report.get("georeference", {}).get("problem"):
        typer.echo(problem)
    if session.loops:
        for notice in (*session.loops.take_notices(), *session.loops.take_alarms()):
            typer.echo(notice)
    if not report["map"]["points"] and report["map"]["keyframes"]:
        raise HemislamError(
            f"The map has no points: no return lies between sensor.min_range and sensor.max_range; run `hemislam info` "
            f"on the recording. The other results were saved in {folder}."
        )
    if isinstance(stop, HemislamError):
        raise HemislamError(f"{stop} The frames before that were processed and saved in {folder}.")
    if stop is not None:
        typer.echo(f"hemislam: stopped early; the frames so far are saved in {folder}.", err=True)
        raise stop


def free_folder(recording: Path) -> Path:
    """The first of runs/NAME-1, runs/NAME-2, ... that does not exist yet."""
    from app.slam.text_files import free_path

    return free_path(Path("runs") / recording.resolve().stem, always_numbered=True)


def compile_behind_bar() -> None:
    """Compile the kernels behind a progress bar; short once they are in the cache."""
    from app.slam.warmup import compile_kernels

    with progress_bar("Compiling, first start only") as show:
        compile_kernels(lambda name, fraction: show(fraction))


def process(session: "Session", *, until: int | None = None) -> BaseException | None:
    """Run to the end of the recording. An exception that stops it early, such as an interruption, is returned.

    Args:
        until: the last frame to process.
    """
    from tqdm import tqdm

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    frames = session.feed.info.frames if until is None else until + 1
    with tqdm(total=frames, unit=" frames", disable=None) as bar:
        try:
            while (until is None or session.frame < until) and session.advance() is not None:
                bar.update()
        except (Exception, KeyboardInterrupt) as error:  # whatever it was, the frames so far must be saved
            return error
    return None


def _nothing_processed(session: "Session") -> str:
    reasons = "; ".join(f"{count} x {reason}" for reason, count in session.log.dropped.most_common(3))
    why = f"all were dropped: {reasons}" if reasons else "there is none in the chosen part"
    return f"No scan of {session.feed.info.path} could be processed ({why}); `hemislam info` shows more."
