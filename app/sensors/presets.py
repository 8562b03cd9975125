"""Partial parameter trees for known devices, and the order in which settings override each other."""

from pathlib import Path
from typing import Any

import numpy as np

from app.sensors.livox import CUSTOM_MSGS
from app.sensors.rings import elevation
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F32

_H2LID_MOUNT = {"translation": [0.0175, 0.0276, -0.1083], "rotation": [0.0, 0.0, 0.0]}

PRESETS: dict[str, dict[str, Any]] = {
    "rslidar": {"recording": {"lidar_topic": "/rslidar_points"}},
    "h2lid": {
        "recording": {"lidar_topic": "/horizontal_laser_3d", "imu_topic": "/imu"},
        "sensor": _H2LID_MOUNT,
    },
    "h2lid-mount": {"sensor": _H2LID_MOUNT},
    "mid360": {
        "recording": {"lidar_topic": "/livox/lidar", "imu_topic": "/livox/imu"},
        "sensor": {"translation": [-0.011, -0.02329, 0.04412]},
    },
    "close": {"scan": {"voxel_size": 0.3}, "map": {"spacing": 0.15}},
}
"""One entry each. `rslidar`: the vendor's ROS driver. `h2lid`: the authors' published recordings. `h2lid-mount`: only
their pose of the LiDAR on the IMU, for recordings under other topics. `mid360`: Livox's ROS drivers, with the IMU
inside the Mid-360 at the place that its manual states. `close`: most things are at arm's length (a desk,
a cabin, a shaft)."""


def preset_for(kind: str, points: F32) -> str:
    """The preset of the sensor whose clouds are of this type and look like this one ((n, 3) m); "" if none is known."""
    angles = np.degrees(elevation(points))
    lowest, highest = np.percentile(angles, [0.5, 99.5])
    around = np.histogram(np.arctan2(points[:, 1], points[:, 0]), 12, (-np.pi, np.pi))[0]
    is_mid360 = kind in CUSTOM_MSGS and lowest > -9 and 40 < highest < 56 and np.count_nonzero(around) > 8
    return "mid360" if is_mid360 else ""


def sidecar(recording: Path) -> Path:
    """Where a recording's own parameters would be: `<stem>.params.yaml` beside it."""
    return recording.parent / f"{recording.name if recording.is_dir() else recording.stem}.params.yaml"


def resolve_params(recording: Path | None, preset: str | None, config: Path | None, assignments: list[str]) -> Params:
    """The parameters. Later ones win: defaults, preset, sidecar file, config file, assignments.

    Raises:
        HemislamError: unknown preset, unreadable file, unknown or out-of-range parameter.
    """
    params = Params()
    if preset is not None:
        if preset not in PRESETS:
            raise HemislamError(f"There is no preset `{preset}`; choose one of {', '.join(PRESETS)}.")
        params = params.merged(PRESETS[preset])
    if recording is not None and sidecar(recording).is_file():
        params = _with_file(params, sidecar(recording))
    if config is not None:
        params = _with_file(params, config)
    return params.with_assignments(assignments)


def _with_file(params: Params, path: Path) -> Params:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise HemislamError(f"There is no parameter file {path}; `hemislam params > {path.name}` writes one.") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise HemislamError(f"The parameter file {path} cannot be read ({why}); check the path.") from None
    return params.merged_yaml(text, str(path))
