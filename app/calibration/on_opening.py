"""Calibration without being asked: of a recording without a mounting when it is opened, and after a doubtful run."""

from pathlib import Path

from app.calibration.calibrate import Calibration, Report, calibrate
from app.slam.errors import HemislamError
from app.slam.params import Params

USED_S = 60.0


def contradicted(path: Path, params: Params, progress: Report = lambda fraction: None) -> Calibration | None:
    """The calibration, if mounting or clock differ from the parameters; None if they do not, or if that is unknown."""
    try:
        found = calibrate(path, params, USED_S, progress)
    except HemislamError:  # such as too short a recording; opening it reports what is wrong with it
        return None
    return found if found.contradiction() else None


def advice(found: Calibration, *, used: bool) -> str:
    """What was found and what to do, in a sentence."""
    command = f"hemislam calibrate {found.recording} --write"
    if used:
        return f"{found.contradiction()}; this was found in the recording and is used. To save it: {command}"
    return f"{found.contradiction()}: {command}"
