"""`hemislam run`: a recording from end to end, without a browser."""

import contextlib
import itertools
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import (
    Assignments,
    Config,
    Duration,
    ImuTopic,
    LidarTopic,
    Preset,
    RecordingPath,
    Start,
    Truth,
    resolve,
)
from app.slam.errors import HemislamError

if TYPE_CHECKING:
    from app.server.run import Run
    from app.slam.loops.types import LoopEdit
    from app.slam.results import RunInfo


def run(
    recording: RecordingPath,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where to write; else runs/NAME-1, -2, ...")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace results that DIR already holds.")] = False,
    preset: Preset = None,
    config: Config = None,
    assignments: Assignments = None,
    lidar_topic: LidarTopic = None,
    imu_topic: ImuTopic = None,
    start: Start = 0.0,
    duration: Duration = None,
    truth: Truth = None,
    loops: Annotated[
        Path | None, typer.Option("--loops", metavar="FILE", help="EditList of loops, as the workbench saves them.")
    ] = None,
) -> None:
    """Process a recording without a browser and write the results.

    \b
    Writes into DIR:
      trajectory.tum           pose of the IMU in the map at each scan's end: stamp x y z qx qy qz qw
      trajectory_odometry.tum  the same by odometry alone, without loops
      loops.csv                every loop candidate: verdict, measurements and reason
      graph.g2o                the pose graph of the keyframes
      timings.csv              milliseconds of each stage in each frame, without reading the file
      map.ply                  the map: x y z intensity ground
      report.json              parameters, counts of frames, ground share, errors against truth

    \b
    Examples:
      hemislam run walk.mcap
      hemislam run indoor1.bag --preset h2lid --out results/indoor1
      hemislam run walk.mcap --set ground.alpha=30 --start 10 --duration 60 --truth walk.tum
      hemislam run walk.mcap --loops edits.yaml
    """
    from app.evaluation.truth_sources import read_poses
    from app.server.run import open_run
    from app.slam.results import RunInfo, prepare_folder
    from app.slam.trajectory import time_apart, truth_beside

    params = resolve(recording, preset, config, assignments, lidar_topic, imu_topic)
    edits = _read_edits(loops) if loops else ()
    folder = out or free_folder(recording)
    truth_path = truth or truth_beside(recording)
    work = open_run(recording, truth_path, params, start, duration)
    try:
        true_poses = read_poses(truth_path) if truth_path else None
        opened = work.opened
        if truth and true_poses:
            if apart := time_apart(truth, true_poses.stamps_ns, opened.start_ns, opened.duration_s):
                raise HemislamError(apart)
        elif truth_path:
            typer.echo(f"Using the truth that lies beside the recording: {truth_path}")
        prepare_folder(folder, replace=force)
        for finding in work.opened.findings:
            if finding.verdict != "fine":
                typer.echo(f"{finding.verdict}: {finding.subject}: {finding.text} {finding.option}".rstrip())
        compile_behind_bar()
        if work.engine.loops:
            work.engine.loops.wait_ready()
        if edits:
            work.edit_loops(edits)
        stop = process(work)
        if not len(work.log):
            with contextlib.suppress(OSError):
                folder.rmdir()  # only if it is empty
            raise stop or HemislamError(_nothing_processed(work))
        info = RunInfo(
            recording=recording,
            params=params,
            start_s=start,
            duration_s=duration,
            truth=true_poses,
            truth_path=truth_path,
            stopped="" if stop is None else str(stop) or type(stop).__name__,
        )
        save(work, folder, info, stop, replace=force)
    finally:
        work.close()


def save(work: "Run", folder: Path, info: "RunInfo", stop: BaseException | None, *, replace: bool) -> None:
    """Write the results and sum them up.

    Raises:
        BaseException: `stop`, what ended the run early, once the frames so far are saved.
    """
    from app.slam.report import summarise
    from app.slam.results import save_results

    found = work.engine.loops.results() if work.engine.loops else None
    report = save_results(folder, work.log, work.engine.keyframes, info, found, replace=replace)
    typer.echo(summarise(report, folder))
    if work.engine.loops:
        for notice in (*work.engine.loops.take_notices(), *work.engine.loops.take_alarms()):
            typer.echo(notice)
    if isinstance(stop, HemislamError):
        raise HemislamError(f"{stop} The frames before that were processed and saved in {folder}.")
    if stop is not None:
        typer.echo(f"hemislam: stopped early; the frames so far are saved in {folder}.", err=True)
        raise stop


def _read_edits(path: Path) -> "tuple[LoopEdit, ...]":
    from app.slam.loops import edit_files

    try:
        return edit_files.read(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError:
        raise HemislamError(f"{path} is not a text file; save edits of loops in the workbench.") from None
    except OSError as error:
        raise HemislamError(f"{path} can not be read: {error.strerror}.") from None


def free_folder(recording: Path) -> Path:
    """The first of runs/NAME-1, runs/NAME-2, ... that does not exist yet."""
    name = recording.resolve().stem
    return next(folder for n in itertools.count(1) if not (folder := Path("runs") / f"{name}-{n}").exists())


def compile_behind_bar() -> None:
    """Compile the kernels behind a progress bar; a moment only, once they are in the cache."""
    from tqdm import tqdm

    from app.slam.warmup import compile_kernels

    bar_format = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}"
    with tqdm(total=1.0, desc="Compiling, first start only", leave=False, disable=None, bar_format=bar_format) as bar:

        def show(name: str, fraction: float) -> None:
            bar.n = fraction
            bar.set_postfix_str(name)

        compile_kernels(show)


def process(work: "Run", *, until: int | None = None) -> BaseException | None:
    """Run to the end of the recording. What stopped it before, an interruption say, is returned, not raised.

    Args:
        until: the last frame to process.
    """
    from tqdm import tqdm

    from app.slam.types import Measurement

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    frames = work.opened.frames if until is None else until + 1
    with tqdm(total=frames, unit=" frames", disable=None) as bar:
        try:
            while (until is None or work.frame < until) and (entry := work.peek()) is not None:
                if isinstance(entry, Measurement):
                    work.step(sought=True)
                bar.update()
        except (Exception, KeyboardInterrupt) as error:  # whatever it was, the frames so far must be saved
            return error
    return None


def _nothing_processed(work: "Run") -> str:
    reasons = "; ".join(f"{count} x {reason}" for reason, count in work.log.dropped.most_common(3))
    why = f"all were dropped: {reasons}" if reasons else "there is none in the part asked for"
    return f"No scan of {work.opened.path} could be processed ({why}); `hemislam info` tells more."
