"""Calibration without being asked: where the mounting is not known, or a run is in doubt."""

from pathlib import Path

from app.calibration.calibrate import Calibration, Progress, calibrate
from app.slam.errors import HemislamError
from app.slam.params import Params

USED_S = 60.0


def is_mounting_unknown(params: Params) -> bool:
    return not any(params.sensor.translation + params.sensor.rotation)


def contradicted(path: Path, params: Params, progress: Progress = lambda step, fraction: None) -> Calibration | None:
    """What the recording tells, if its mounting or clock differs from the parameters; None if not, or if it cannot be
    told."""
    try:
        found = calibrate(path, params, USED_S, progress)
    except HemislamError:  # such as too short a recording; opening it reports what is wrong with it
        return None
    return found if found.contradiction() else None


def advice(found: Calibration, *, used: bool) -> str:
    """What was found and what to do, in a sentence."""
    command = f"hemislam calibrate {found.recording} --write"
    if used:
        return f"{found.contradiction()}; this was found from the recording and is used. To keep it: {command}"
    return f"{found.contradiction()}: {command}"
