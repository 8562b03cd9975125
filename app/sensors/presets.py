"""Partial parameter trees for known devices, and the order in which settings override each other."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from app.sensors.cloud_types import POINT_CLOUD_2, Probe
from app.sensors.livox import CUSTOM_MSGS
from app.sensors.rings import elevation
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.text_files import beside, is_file

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
    "airy": {
        "recording": {"lidar_topic": "/rslidar_points", "imu_topic": "/rslidar_imu_data"},
        "sensor": {"translation": [0.0, 0.0, 0.0], "rotation": [180.0, 0.0, -90.0]},
        "ground": {"scan_lines": 24},
    },
    "jt128": {
        "recording": {"lidar_topic": "/lidar_points", "imu_topic": "/lidar_imu"},
        "ground": {"scan_lines": 32},
    },
    "ouster": {
        "recording": {"lidar_topic": "/ouster/points", "imu_topic": "/ouster/imu"},
        "sensor": {"translation": [-0.006253, 0.011775, 0.028535], "rotation": [0.0, 0.0, 180.0]},
    },
    "hesai-xt": {"recording": {"lidar_topic": "/lidar_points"}},
    "velodyne": {"recording": {"lidar_topic": "/velodyne_points"}},
    "close": {"scan": {"voxel_size": 0.3}, "map": {"spacing": 0.15}},
}
"""One entry each. `rslidar`: the vendor's ROS driver. `h2lid`: the authors' published recordings. `h2lid-mount`: only
their pose of the LiDAR on the IMU, for recordings under other topics. `mid360`: Livox's ROS drivers, with the IMU
inside the Mid-360 at the place that its manual states. `airy`: RoboSense's ROS driver and the IMU inside, whose axes
are those of the vendor's examples; each unit states its own pose in DIFOP packets. `jt128`: Hesai's ROS driver; the
axes agree. `ouster`: Ouster's ROS driver with clouds in `os_lidar`, the IMU's place from one unit's metadata; the
doctor shows that of a capture's unit. `hesai-xt`, `velodyne`: their ROS drivers; the IMU is your own. `close`: most
things are at arm's length (a desk, a cabin, a shaft).

`airy` and `jt128` search a quarter of all lines for ground seeds, as the defaults do for the 32 lines of an RS-Bpearl.
Fewer of such dense lines lie so close together that the lines' own errors tilt the plane."""


class _Appearance(NamedTuple):
    """What the clouds of a scanner with a built-in IMU look like; all of these scanners see all around.

    Attributes:
        preset: of the scanner. kinds: message types. fields: that the clouds must have, among others.
        lines: possible numbers of scan lines; (): any. lowest, highest: deg, bounds of the lowest and of the highest
            elevation.
    """

    preset: str
    kinds: tuple[str, ...]
    fields: set[str]
    lines: tuple[int, ...]
    lowest: tuple[int, int]
    highest: tuple[int, int]


_POINTS = (POINT_CLOUD_2.name,)
_APPEARANCES = (
    _Appearance("mid360", CUSTOM_MSGS, set(), (), (-9, 90), (40, 56)),
    _Appearance("mid360", _POINTS, {"tag", "line"}, (), (-9, 90), (40, 56)),
    _Appearance("airy", _POINTS, {"ring", "timestamp"}, (96,), (-3, 20), (60, 91)),
    _Appearance("jt128", _POINTS, {"ring", "timestamp"}, (128,), (-8, 20), (60, 91)),
    _Appearance("ouster", _POINTS, {"ring", "t", "reflectivity"}, (32, 64, 128), (-90, 0), (0, 91)),
)


def preset_for(kind: str, probe: Probe) -> str:
    """The preset of the scanner whose clouds are of this type and look like this one; "" if none is known."""
    points = probe.points
    lowest, highest = np.percentile(np.degrees(elevation(points)), [0.5, 99.5])
    around = np.histogram(np.arctan2(points[:, 1], points[:, 0]), 12, (-np.pi, np.pi))[0]
    for one in _APPEARANCES:
        if (
            kind in one.kinds
            and one.fields <= probe.cloud.fields.keys()
            and (not one.lines or int(probe.column("ring").max()) + 1 in one.lines)
            and one.lowest[0] < lowest < one.lowest[1]
            and one.highest[0] < highest < one.highest[1]
            and np.count_nonzero(around) > 8
        ):
            return one.preset
    return ""


def built_in_mounting(preset: str, imu_topic: str) -> dict[str, Any]:
    """The preset's `sensor` section, if the IMU is the one inside the scanner, by its topic; else {}."""
    values = PRESETS.get(preset, {})
    return values.get("sensor", {}) if values.get("recording", {}).get("imu_topic") == imu_topic else {}


CALIBRATED = "# Written by `hemislam calibrate`"
"""First line of a parameter file that hemislam wrote."""
MERGED = f"{CALIBRATED} into the one kept as .old."
"""First line of a parameter file that a user wrote and hemislam changed."""


def sidecar(recording: Path) -> Path:
    """The path of a recording's own parameters: `<stem>.params.yaml` beside it."""
    return beside(recording, ".params.yaml")


def kept_sidecar(recording: Path) -> Path:
    """Where a user's own file of these is kept while a calibration is merged into a copy."""
    return beside(recording, ".params.yaml.old")


def uncalibrated(recording: Path) -> Path | None:
    """The parameter file beside a recording as its user wrote it, without a calibration; None if there is none."""
    path = sidecar(recording)
    old, first = kept_sidecar(recording), _first_line(path)
    if first.startswith(MERGED):
        return old if is_file(old) else path
    return path if is_file(path) and not first.startswith(CALIBRATED) else None


def calibrated_beside(recording: Path) -> str:
    """A sentence that names the calibration in use beside a recording; "" if there is none."""
    path, first = sidecar(recording), _first_line(sidecar(recording))
    if not first.startswith(CALIBRATED):
        return ""
    undo = f"rename {kept_sidecar(recording).name} to {path.name}" if first.startswith(MERGED) else "delete it"
    return f"Using the calibration beside the recording: {path}; {undo} to undo this."


def _first_line(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            return file.readline()
    except (OSError, UnicodeDecodeError):
        return ""


def resolve_params(
    recording: Path | None,
    preset: str | None,
    config: Path | None,
    assignments: list[str],
    *,
    calibrated: bool = True,
) -> Params:
    """The parameters. Later ones win: defaults, preset, sidecar file, config file, assignments.

    Args:
        calibrated: whether a calibration in the sidecar file counts.

    Raises:
        HemislamError: unknown preset, unreadable file, unknown or out-of-range parameter.
    """
    params = Params()
    if preset is not None:
        if preset not in PRESETS:
            raise HemislamError(f"There is no preset `{preset}`; choose one of {', '.join(PRESETS)}.")
        params = params.merged(PRESETS[preset])
    if recording is not None:
        beside = sidecar(recording) if calibrated else uncalibrated(recording)
        if beside is not None and is_file(beside):
            params = _with_file(params, beside)
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
