"""The command line: the only place that wires the packages together. It imports each when it is needed."""

import contextlib
import gc
import io
import sys
from pathlib import Path
from typing import Annotated, Any

try:
    import typer
    from typer.core import TyperGroup

    from app import TEMPORARY_KERNEL_CACHE, __version__
    from app.cli import options
    from app.cli.calibrate import calibrate
    from app.cli.compare import compare
    from app.cli.evaluate import evaluate
    from app.cli.export import export
    from app.cli.feed import feed
    from app.cli.georeference import georeference
    from app.cli.replay import replay
    from app.cli.run import run
    from app.cli.serve import serve
    from app.cli.tune import tune
    from app.slam.errors import HemislamError, refusal
except KeyboardInterrupt:  # loading these takes most of the time until `_Commands` handles Ctrl-C
    sys.exit(130)

LEAST_MEMORY = 900 << 20
"""Bytes of addresses that numba, its threads and a walk take."""
GARBAGE = 20_000, 2, 2
"""When Python looks for garbage, as `gc.set_threshold`: not amid a start, which makes 100,000 objects that stay."""


class _Commands(TyperGroup):
    """Ends a command with one sentence on stderr instead of a traceback when the user can correct the cause."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except HemislamError as error:
            typer.echo(f"hemislam: {error}", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("\nhemislam: interrupted.", err=True)
            raise typer.Exit(130) from None
        except (OSError, MemoryError, RuntimeError) as error:
            if (sentence := _of_the_machine(error)) is None:
                raise
            typer.echo(f"hemislam: {sentence}", err=True)
            raise typer.Exit(2) from None


def _of_the_machine(error: Exception) -> str | None:
    """A sentence about a limit of the machine or the account, or a link; None if the error is none of these."""
    if isinstance(error, BrokenPipeError):
        return None
    if isinstance(error, MemoryError) or "can't start new thread" in str(error):
        return "There is not enough memory; close other programs, or raise the limit (ulimit -v)."
    if str(error).startswith("Symlink loop"):  # as pathlib says it
        return f"{error}: a link that leads to itself is no file and no folder; choose another path."
    if isinstance(error, OSError):
        return refusal(error)
    return None


cli = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"hemislam {__version__}")
        raise typer.Exit


@cli.callback()
def hemislam(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Map with a handheld hemispherical LiDAR and an IMU, in the browser or from the command line.

    \b
    Try:
      hemislam serve sample_data/cloister.mcap      watch the map grow in the browser
      hemislam info walk.bag                      what is in a recording, and what is wrong with it
      hemislam run walk.bag --preset h2lid        trajectory, map and report, without a browser

    Every command explains itself: hemislam run --help
    """


for command in (serve, run, replay, export, compare, calibrate, evaluate, georeference, tune, feed):
    cli.command()(command)


@cli.command()
@options.with_params
def info(
    recording: options.RecordingPath,
    params_for: options.ParamsFor,
    calibrate: options.Calibrate = True,
) -> None:
    """Examine a recording and report what is wrong.

    Checks topics, rates, time fields, units, gaps, clocks and gravity, and says what hemislam does about each.

    \b
    Each finding has a verdict:
      fine        nothing to do
      corrected   hemislam corrects it and says how
      needs you   only you can decide; the option to use is printed below the finding

    \b
    Examples:
      hemislam info walk.mcap
      hemislam info indoor1.bag --preset h2lid
    """
    from app.cli.run import settle_mounting
    from app.sensors.doctor import DAMAGE, examine
    from app.sensors.findings import Finding, FindingVerdict

    params = params_for(recording)
    options.say_calibrated(recording)
    with options.progress_bar("Reading") as show:
        findings = examine(recording, params, progress=show)
    settled, advised = settle_mounting(recording, params) if calibrate else (params, "")
    if advised:
        verdict: FindingVerdict = "needs you" if settled == params else "corrected"
        told = Finding("mount", verdict, advised)
        findings = tuple(told if finding.subject == told.subject else finding for finding in findings)
    width = max((len(finding.subject) for finding in findings), default=0)
    for finding in findings:
        typer.echo(f"{finding.verdict:<9}  {finding.subject:<{width}}  {finding.text}")
        if finding.option:
            use = "->" if finding.verdict == "needs you" else "if that is wrong:"
            typer.echo(f"{'':<9}  {'':<{width}}  {use} {finding.option}")
    waiting = sum(finding.verdict == "needs you" for finding in findings)
    typer.echo(
        f"{waiting} of {len(findings)} findings need your attention." if waiting else "Nothing needs your attention."
    )
    if broken := next((f for f in findings if f.subject == DAMAGE and f.verdict == "needs you"), None):
        raise HemislamError(broken.text)


@cli.command()
def simulate(
    ctx: typer.Context,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE.mcap", help="The recording to write; with --suite a folder.")
    ],
    scene: Annotated[str | None, typer.Argument(metavar="SCENE", help="corridor, outdoor, cloister, ...")] = None,
    suite: options.Suite = None,
    short: options.Short = False,
    duration: Annotated[float, typer.Option("--duration", metavar="SECONDS", help="Length of the recording.")] = 60.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed gives another trajectory.")] = 0,
    rate: Annotated[int, typer.Option("--rate", metavar="HZ", help="Revolutions per second, 10 or 20.")] = 10,
    every_block: Annotated[
        int | None,
        typer.Option("--every-block", min=1, metavar="K", help="Fire only at every K-th azimuth, for a small file."),
    ] = None,
    coordinate_step: Annotated[
        float, typer.Option("--coordinate-step", metavar="METRES", help="Round x, y, z for a smaller file; 0: do not.")
    ] = 0.0,
    range_step: Annotated[
        float,
        typer.Option("--range-step", metavar="METRES", help="Resolution of ranges; 0.0025 for a newer unit, 0: exact."),
    ] = 0.005,
    scanner: Annotated[
        str, typer.Option("--scanner", metavar="NAME", help="bpearl, airy, jt128 or mid360.")
    ] = "bpearl",
    tables: Annotated[
        Path | None,
        typer.Option("--tables", metavar="FOLDER", help="Folder with the manufacturer's tables of a jt128 or mid360."),
    ] = None,
    upright: Annotated[
        bool | None,
        typer.Option(
            "--upright/--forward", help="The scanner's z axis points up or forward; default: as usual for this scanner."
        ),
    ] = None,
    imperfect: options.Imperfect = False,
    errors: Annotated[
        list[str] | None,
        typer.Option("--error", metavar="NAME=VALUE", help="Size of one imperfection; 0: none. Repeatable."),
    ] = None,
    gnss: Annotated[
        list[str] | None,
        typer.Option("--gnss", metavar="NAME=VALUE", help="Add a satellite receiver, e.g. noise=0.02. Repeatable."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace FILE if it exists.")] = False,
) -> None:
    """Simulate a recording in a modelled scene.

    A person carries an RS-Bpearl (or another scanner) and an IMU through the scene and stands still for the first
    seconds. Beside FILE.mcap, FILE_truth.tum contains the true poses and FILE.params.yaml the pose of the LiDAR on
    the IMU. Each point has its true label in the field `ground`, if the driver's layout has fields.

    \b
    Examples:
      hemislam simulate corridor --out corridor.mcap
      hemislam simulate outdoor --out outdoor.mcap --duration 120 --seed 7
      hemislam simulate room --out small.mcap --duration 20 --every-block 6
      hemislam simulate outdoor --out real.mcap --imperfect --error companions=0
      hemislam simulate outdoor --out gnss.mcap --gnss noise=0.02 --gnss offset=0.08 --gnss z=0.5
      hemislam simulate corridor --out livox.mcap --scanner mid360 --tables tables/
      hemislam simulate --suite paper --out suite/
    """
    from app.sensors.simulator import SCENES, simulate
    from app.sensors.simulator.gnss import Gnss
    from app.sensors.simulator.imperfections import IMPERFECT, NONE

    imperfections = (IMPERFECT if imperfect else NONE).with_sizes(errors or [])
    if (suite is None and short) or (suite is not None and scene is not None):
        raise HemislamError("SCENE takes --duration, --suite takes --short; give either SCENE or --suite.")
    if suite is not None:
        only = ("duration", "rate", "coordinate_step", "range_step", "scanner", "tables", "upright", "gnss", "force")
        sources = {name: ctx.get_parameter_source(name) for name in only}
        if given := [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]:
            names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise HemislamError(f"--suite does not take {names}; leave them out, or name a SCENE.")
        options.make_suite(suite, out, [seed], short=short, every_block=every_block, imperfections=imperfections)
        return
    if scene is None:
        raise HemislamError(f"Name a SCENE, one of {', '.join(SCENES)}, or use --suite paper.")
    if out.exists() and not force:
        raise HemislamError(f"{out} already exists; choose another --out, or add --force to replace it.")
    with options.progress_bar("Simulating", unit=" scans") as show:
        made = simulate(
            scene,
            out,
            duration_s=duration,
            seed=seed,
            rate_hz=rate,
            every_block=every_block or 1,
            range_step=range_step,
            coordinate_step=coordinate_step,
            imperfections=imperfections,
            scanner=scanner,
            tables=tables,
            upright=upright,
            gnss=Gnss().with_sizes(gnss) if gnss else None,
            progress=show,
        )
    typer.echo(
        f"{made.recording}: {made.scans} scans, {made.points:,} points, {made.duration_s:g} s,"
        f" {made.distance_m:.1f} m walked, {made.bytes / 1e6:.1f} MB"
    )


@cli.command()
def params(
    preset: options.Preset = None,
    config: options.Config = None,
    assignments: options.Assignments = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the reference of all parameters instead.")
    ] = False,
) -> None:
    """Print all parameters as YAML, with meaning, unit and range.

    --config reads it back.

    \b
    Examples:
      hemislam params > mine.yaml                 edit it, then: hemislam run walk.mcap --config mine.yaml
      hemislam params --preset h2lid              what a preset sets
      hemislam params --set ground.alpha=30       check a value
    """
    if markdown:
        from app.slam.params import params_markdown

        typer.echo(params_markdown(), nl=False)
        return
    typer.echo(options.resolve(None, preset, config, assignments).to_yaml(), nl=False)


def _require_memory() -> None:
    """Libraries end the process without a word where the account's limit of memory is too small for their threads."""
    with contextlib.suppress(ImportError):  # Windows has no such limits
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY and limit < LEAST_MEMORY:
            typer.echo(
                f"hemislam: This account may use {limit >> 20} MB of memory, and {LEAST_MEMORY >> 20} MB are needed at "
                "least; raise the limit (ulimit -v).",
                err=True,
            )
            sys.exit(2)


def main() -> None:
    """The console script."""
    gc.set_threshold(*GARBAGE)
    _require_memory()
    if TEMPORARY_KERNEL_CACHE:
        typer.echo(
            f"hemislam: Compiled kernels are kept in {TEMPORARY_KERNEL_CACHE}, since neither the program's folder nor a"
            " cache in your home folder can be written to; set NUMBA_CACHE_DIR to choose another place.",
            err=True,
        )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file name may be no UTF-8
    try:
        cli(prog_name="hemislam")
    except KeyboardInterrupt:  # before `_Commands` handles it
        sys.exit(130)


if __name__ == "__main__":
    main()
