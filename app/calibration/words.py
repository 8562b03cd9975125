"""A calibration in words, as a table, as JSON and in the parameter file beside its recording."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from app.calibration.calibrate import Calibration
from app.calibration.inertial import Noise
from app.calibration.lines import Lines
from app.sensors.presets import CALIBRATED, MERGED, kept_sidecar, sidecar, uncalibrated
from app.slam.errors import HemislamError
from app.slam.params import nested
from app.slam.report import finite
from app.slam.text_files import write_texts
from app.slam.user_text import read_text, read_yaml

WALK = "not observable: walk a figure of eight, tilting the scanner"


def table(calibration: Calibration) -> list[tuple[str, str]]:
    """The results, each with its unit and standard deviation."""
    c, sigmas, observed = calibration, calibration.sigmas, calibration.observed
    roll, pitch, yaw = c.rotation
    x, y, z = c.moved.p_imu_lidar
    sx, sy, sz = sigmas["translation"]
    rotation, offset = np.degrees(sigmas["rotation"].max()), float(sigmas["offset"][0]) * 1e3
    turning = np.degrees([_rms(c.turned.before), _rms(c.turned.after)])
    motion = _rms(c.moved.before) * 1e3, _rms(c.moved.after) * 1e3
    return [
        ("rotation of the LiDAR on the IMU", _if(
            observed["rotation"], f"roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} ± {rotation:.2f} deg"
        )),
        ("position of the LiDAR on the IMU", _if(
            observed["translation"], f"{x:.3f} ± {sx:.3f}, {y:.3f} ± {sy:.3f}, {z:.3f} ± {sz:.3f} m"
        )),
        ("added to the IMU's clock", _if(observed["offset"], f"{c.turned.late * 1e3:+.1f} ± {offset:.1f} ms")),
        ("bias of the gyroscope", _vector(np.degrees(c.turned.bias), np.degrees(sigmas["gyro_bias"]), "deg/s")),
        ("bias of the accelerometer", _vector(c.moved.bias, sigmas["accel_bias"], "m/s²")),
        *_of_lines(c.lines),
        ("noise of the gyroscope", _noise(c.gyro_noise, "mrad/s/√Hz")),
        ("noise of the accelerometer", _noise(c.accel_noise, "mm/s²/√Hz")),
        ("down at the start, LiDAR frame", ", ".join(f"{value:+.3f}" for value in c.down)),
        ("turning by scans against IMU", f"{turning[0]:.3f} deg before, {turning[1]:.3f} after"),
        ("motion by scans against IMU", f"{motion[0]:.1f} mm before, {motion[1]:.1f} after"),
        ("scans to the map", f"{c.residuals[0] * 1e3:.1f} mm without the IMU, {c.residuals[1] * 1e3:.1f} with the IMU"),
    ]  # fmt: skip


def as_json(calibration: Calibration) -> dict[str, Any]:
    """The same as numbers. Units as in the parameters; standard deviations in rad, s, m, rad/s and m/s². The noise has
    its density and the standard deviation of that."""
    c = calibration
    numbers: dict[str, Any] = {
        "recording": str(c.recording),
        "used_s": c.lasted_s,
        "rotation_deg": list(c.rotation),
        "translation_m": c.moved.p_imu_lidar.tolist(),
        "imu_time_offset_s": c.params.recording.imu_time_offset + c.turned.late,
        "gyro_bias": c.turned.bias.tolist(),
        "accel_bias": c.moved.bias.tolist(),
        "gyro_noise": [c.gyro_noise.density, c.gyro_noise.sigma],
        "accel_noise": [c.accel_noise.density, c.accel_noise.sigma],
        "down_lidar": c.down.tolist(),
        "lines": {
            "elevations_rad": c.lines.elevations.tolist(),
            "ranges_m": c.lines.ranges.tolist(),
            "sigmas": c.lines.sigmas.tolist(),
            "residuals_m": [c.lines.before.tolist(), c.lines.after.tolist()],
        },
        "sigmas": {name: values.tolist() for name, values in c.sigmas.items()},
        "observed": c.observed,
        "residuals": {
            "turning_rad": [_rms(c.turned.before), _rms(c.turned.after)],
            "motion_m": [_rms(c.moved.before), _rms(c.moved.after)],
            "scans_m": list(c.residuals),
        },
        "parameters": c.found(),
        "contradiction": c.contradiction(),
    }
    return {name: finite(value) for name, value in numbers.items()}


def check_beside(recording: Path) -> None:
    """Raises HemislamError if a person wrote the parameter file beside the recording."""
    if uncalibrated(recording) == (path := sidecar(recording)):
        raise HemislamError(f"You wrote {path} yourself; add --force to change values in it (it is kept as .old).")


def write_beside(recording: Path, found: Mapping[str, Any]) -> Path:
    """Store the found parameters, by dotted name, beside the recording, where `run`, `serve` and `info` read them.

    A file that a person wrote is kept as `.old`, and its other parameters stay.

    Raises:
        HemislamError: nothing was found; or the file cannot be written, and then the older one stays.
    """
    if not found:
        raise HemislamError(f"Nothing found in {recording} can be kept: {WALK}.")
    path = sidecar(recording)
    texts = {path.name: f"{CALIBRATED}; delete this file to undo it.\n{_yaml(nested(found))}"}
    if (mine := uncalibrated(recording)) is not None:
        before = read_text(mine, "write it again")
        tree = read_yaml(before, str(mine), "write it again") or {}
        for section, values in nested(found).items():
            tree[section] = (tree.get(section) or {}) | values
        texts = {kept_sidecar(recording).name: before, path.name: f"{MERGED}\n{_yaml(tree)}"}
    write_texts(path.parent, texts)
    return path


def _yaml(tree: Mapping[str, Any]) -> str:
    return str(yaml.safe_dump(tree, default_flow_style=None))


def _if(observed: bool, text: str) -> str:
    return text if observed else WALK


def _of_lines(lines: Lines) -> list[tuple[str, str]]:
    if not len(lines.ranges):
        return [("scan lines", "this LiDAR has none to calibrate")]
    if np.isnan(lines.before).all():
        return [("scan lines", WALK)]
    rows = []
    for k, (name, values, scale, unit) in enumerate(
        [("elevations", lines.elevations, np.degrees(1.0), "deg"), ("distances", lines.ranges, 1e3, "mm")]
    ):
        off, sigma = values * scale, float(np.median(lines.sigmas[k])) * scale
        usual, most = _rms(off), float(np.abs(off).max())
        worth = "" if f"sensor.{('elevation', 'range')[k]}_corrections" in lines.found() else ": too little to correct"
        rows.append(
            (f"{name} of the scan lines", f"off by {usual:.2g} (RMS), {most:.2g} at most, ± {sigma:.1g} {unit}{worth}")
        )
    before, after = (float(np.sqrt(np.nanmean(values**2))) * 1e3 for values in (lines.before, lines.after))
    return [
        *rows,
        ("distance offset of all lines", "not observable: grazing beams show the same"),
        ("scan lines on planes", f"{before:.1f} mm before, {after:.1f} after"),
    ]


def _vector(values: np.ndarray, sigmas: np.ndarray, unit: str) -> str:
    return ", ".join(f"{v:.3f} ± {s:.3f}" for v, s in zip(values, sigmas, strict=True)) + f" {unit}"


def _noise(noise: Noise, unit: str) -> str:
    if not np.isfinite(noise.density):
        return "not known: it takes four seconds of evenly spaced samples"
    return f"{noise.density * 1e3:.2f} ± {noise.sigma * 1e3:.2f} {unit}"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
