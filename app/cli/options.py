"""Shared by several commands: options and their evaluation, a progress bar, and suites of simulated recordings."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from inspect import Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from app.slam.text_files import make_folder

if TYPE_CHECKING:
    from app.sensors.simulator.imperfections import Imperfections
    from app.slam.params import Params

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A .mcap, .db3, .bag or .pcap file, or a ROS 2 folder.")
]
Preset = Annotated[
    str | None, typer.Option("--preset", metavar="NAME", help="Settings of a known device, e.g. h2lid or rslidar.")
]
Config = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Parameters as YAML; `hemislam params` prints them all.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="One parameter, e.g. ground.alpha=30. Repeatable."),
]
LidarTopic = Annotated[
    str | None,
    typer.Option("--lidar-topic", metavar="TOPIC", help="Point clouds; default: the topic with times and rings."),
]
ImuTopic = Annotated[
    str | None,
    typer.Option("--imu-topic", metavar="TOPIC", help="IMU; default: the topic with accelerations and rates."),
]
MOST_S = 1e9
"""Limit of a start or a duration, s; far more nanoseconds do not fit into 64 bits."""
Start = Annotated[
    float, typer.Option("--start", min=0, max=MOST_S, metavar="SECONDS", help="Begin this long after the first scan.")
]
Duration = Annotated[
    float | None,
    typer.Option("--duration", min=0, max=MOST_S, metavar="SECONDS", help="Process only this much of the recording."),
]
RunFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Where to write; default: runs/NAME-1, -2, ...")
]
Force = Annotated[bool, typer.Option("--force", help="Replace results that DIR already holds.")]
Imperfect = Annotated[
    bool, typer.Option("--imperfect", help="Simulate the errors of a real scanner, lively motion, and people nearby.")
]
Suite = Annotated[
    str | None,
    typer.Option(
        "--suite",
        metavar="NAME",
        help="`paper`: twins of the paper's six sequences; `revisits`: six walks that return to places.",
    ),
]
Short = Annotated[bool, typer.Option("--short", help="Only the first 60 s of each sequence of the suite.")]
Calibrate = Annotated[
    bool,
    typer.Option(
        "--calibrate/--no-calibrate",
        help="If no mounting is given, or the run is doubtful, estimate the pose of the LiDAR on the IMU.",
    ),
]
TruthFile = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE.tum",
        help="True poses of the IMU, `stamp x y z qx qy qz qw`, to measure the error against;"
        " default: RECORDING_truth.tum beside the recording, if it exists.",
    ),
]


def resolve(
    recording: Path | None,
    preset: str | None,
    config: Path | None,
    assignments: list[str] | None,
    lidar_topic: str | None = None,
    imu_topic: str | None = None,
    *,
    calibrated: bool = True,
) -> "Params":
    """Parameters from all options together; the options for topics override `--set`.

    Args:
        calibrated: whether a calibration beside the recording counts.

    Raises:
        HemislamError: as `app.sensors.presets.resolve_params`.
    """
    from app.sensors.presets import resolve_params

    topics = {"recording.lidar_topic": lidar_topic, "recording.imu_topic": imu_topic}
    flags = [f"{name}={json.dumps(topic)}" for name, topic in topics.items() if topic is not None]
    return resolve_params(recording, preset, config, [*(assignments or []), *flags], calibrated=calibrated)


def say_calibrated(recording: Path) -> None:
    """Say that a calibration beside the recording is used, if there is one."""
    from app.sensors.presets import calibrated_beside

    if sentence := calibrated_beside(recording):
        typer.echo(sentence)


class ParamsFor(Protocol):
    """Gives the parameters of a recording. Raises HemislamError as `resolve`.

    Attributes:
        keywords: the values of the options, by name; None or empty without the option.
    """

    keywords: dict[str, Any]

    def __call__(self, recording: Path | None, *, calibrated: bool = True) -> "Params": ...


def with_params(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options that choose parameters. It gets them as one function, `params_for: ParamsFor`."""

    def with_options(
        preset: Preset = None,
        config: Config = None,
        assignments: Assignments = None,
        lidar_topic: LidarTopic = None,
        imu_topic: ImuTopic = None,
        **own: Any,
    ) -> None:
        resolve_for = partial(resolve, preset=preset, config=config, assignments=assignments)
        command(params_for=partial(resolve_for, lidar_topic=lidar_topic, imu_topic=imu_topic), **own)

    both = [*signature(command).parameters.values(), *signature(with_options).parameters.values()]
    seen = [one for one in both if one.name not in ("params_for", "own")]
    vars(with_options)["__signature__"] = Signature(seen)
    with_options.__annotations__ = {one.name: one.annotation for one in seen}
    with_options.__name__, with_options.__doc__ = command.__name__, command.__doc__
    return with_options


@contextmanager
def progress_bar(description: str, **options: Any) -> Iterator[Callable[..., None]]:
    """A bar on stderr that disappears at the end, as a function of what is done and, once known, of how much there is.

    options: of tqdm; none: what is done is a share, 0-1.
    """
    from tqdm import tqdm

    share = {"total": 1.0, "bar_format": "{desc}: {percentage:3.0f}% |{bar}| {elapsed}"}
    with tqdm(desc=description, leave=False, disable=None, **(options or share)) as bar:

        def show(done: float, total: float | None = None) -> None:
            bar.total = bar.total if total is None else total
            bar.update(done - bar.n)

        yield show


def make_suite(
    name: str,
    folder: Path,
    seeds: list[int],
    *,
    short: bool,
    imperfections: "Imperfections",
    every_block: int | None = None,
) -> list[Path]:
    """Make the recordings of a suite that do not exist yet, and return all of them.

    Raises:
        HemislamError: there is no such suite, or the recordings cannot be written.
    """
    from app.sensors.simulator.suite import find_suite, make_twin

    twins = find_suite(name)
    make_folder(folder)
    recordings = []
    for seed in seeds:
        for twin in twins:
            with progress_bar(f"{twin.name}, seed {seed}", unit=" scans") as show:
                made = make_twin(
                    twin,
                    folder,
                    seed=seed,
                    short=short,
                    every_block=every_block,
                    imperfections=imperfections,
                    progress=show,
                )
            state = "made" if made.new else "exists already"
            typer.echo(f"{made.recording}: {made.distance_m:.1f} m walked, {state}")
            recordings.append(made.recording)
    return recordings
