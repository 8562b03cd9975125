"""Options that several commands share, and what becomes of them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
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
    str | None, typer.Option("--lidar-topic", metavar="TOPIC", help="Point clouds; else the first of type PointCloud2.")
]
ImuTopic = Annotated[str | None, typer.Option("--imu-topic", metavar="TOPIC", help="IMU; else the first of type Imu.")]
Start = Annotated[float, typer.Option("--start", min=0, metavar="SECONDS", help="Begin so long after the first scan.")]
Duration = Annotated[
    float | None, typer.Option("--duration", min=0, metavar="SECONDS", help="Process only so much of the recording.")
]
Truth = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE.tum",
        help="True poses of the IMU, `stamp x y z qx qy qz qw`, to measure the error against;"
        " else RECORDING_truth.tum beside the recording, if there.",
    ),
]


def resolve(
    recording: Path | None,
    preset: str | None,
    config: Path | None,
    assignments: list[str] | None,
    lidar_topic: str | None = None,
    imu_topic: str | None = None,
) -> "Params":
    """Parameters from all options together; the topics' own options win over `--set`.

    Raises:
        HemislamError: as `app.sensors.presets.resolve_params`.
    """
    from app.sensors.presets import resolve_params

    topics = {"recording.lidar_topic": lidar_topic, "recording.imu_topic": imu_topic}
    flags = [f"{name}={json.dumps(topic)}" for name, topic in topics.items() if topic is not None]
    return resolve_params(recording, preset, config, [*(assignments or []), *flags])
