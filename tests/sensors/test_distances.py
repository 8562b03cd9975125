"""Points that are too far away, or all equally far, are reported as such."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from app.calibration.excerpt import read_excerpt
from app.sensors.findings import Finding
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from tests.sensors import rig


def found(path: Path, change: Callable[[rig.Turn], np.ndarray], params: Params | None = None) -> list[Finding]:
    """What is said of the distances in a walk whose points are these instead."""
    entries = []
    for topic, log, sent in rig.walk(turns=4, columns=20):
        if topic == "/points":
            made = rig.turn((log - rig.START_NS) // rig.PERIOD_NS - 1, columns=20)
            made.points = change(made)
            sent = rig.message(made)
        entries.append((topic, log, sent))
    with open_recording(rig.write(path / "walk", entries), params or Params()) as recording:
        return [finding for finding in recording.findings if finding.subject == "distances"]


def at(made: rig.Turn, distance: float, which: np.ndarray) -> np.ndarray:
    """The points, but these at this distance."""
    lengths = np.linalg.norm(made.points, axis=1, keepdims=True)
    return np.where(which[:, None], made.points * (distance / lengths), made.points).astype(np.float32)


@pytest.mark.parametrize(("every", "share"), [(10, "10%"), (2, "50%"), (1, "100%")])
def test_missing_returns_written_as_one_distance_are_named(every: int, share: str, tmp_path: Path) -> None:
    (finding,) = found(tmp_path, lambda made: at(made, 100.0, np.arange(len(made)) // 8 % every == 0))
    assert finding.verdict == "needs you" and finding.option == "--set sensor.max_range=99"
    assert finding.text.startswith(f"{share} of the points are exactly 100 m away")


def test_missing_returns_beyond_the_maximum_range_need_nobody(tmp_path: Path) -> None:
    nearer = Params().with_values({"sensor.max_range": 99.0})
    assert found(tmp_path, lambda made: at(made, 100.0, np.arange(len(made)) % 3 == 0), nearer) == []


def test_a_level_floor_is_equally_far_on_a_line_and_is_no_missing_return(tmp_path: Path) -> None:
    assert found(tmp_path, lambda made: at(made, 20.0, made.ring == 0)) == []


def test_points_that_are_equally_far_before_the_others_are_no_missing_returns(tmp_path: Path) -> None:
    assert found(tmp_path, lambda made: at(made, 1.0, np.arange(len(made)) % 3 == 0)) == []


@pytest.mark.parametrize(("unit", "parts"), [("cm", 100), ("mm", 1000)])
def test_coordinates_that_are_not_in_metres_are_named(unit: str, parts: int, tmp_path: Path) -> None:
    (finding,) = found(tmp_path, lambda made: made.points * parts)
    assert finding.verdict == "needs you" and f"seem to be in {unit}; " in finding.text
    assert finding.text.endswith(f"divide them by {parts}")


@pytest.mark.parametrize("times", [0.2, 1.0, 10.0])
def test_metres_in_a_cabin_or_in_a_field_are_fine(times: float, tmp_path: Path) -> None:
    assert found(tmp_path, lambda made: made.points * times) == []


def test_a_recording_without_any_return_in_range_is_named_by_the_doctor_and_by_calibration(tmp_path: Path) -> None:
    (finding,) = found(tmp_path, lambda made: made.points * np.float32(0.01))
    assert finding.verdict == "needs you"
    assert "none of the" in finding.text and "0.4 to 100 m" in finding.text and "farthest 0.08" in finding.text
    with (
        open_recording(tmp_path / "walk", Params()) as recording,
        pytest.raises(HemislamError, match=r"None of the 4 scans .* has a return .* 0.4 to 100 m") as refused,
    ):
        read_excerpt(recording, Params())
    assert "hemislam info" in str(refused.value)


@pytest.mark.parametrize("spoilt", [np.inf, 5e4, np.nan, 0.0])
def test_clouds_without_a_valid_return_are_counted_and_what_can_be_wrong_is_named(
    spoilt: float, tmp_path: Path
) -> None:
    with pytest.raises(HemislamError, match="None of the 4 point clouds on /points") as refused:
        found(tmp_path, lambda made: np.full_like(made.points, spoilt))
    assert "beyond 10 km, NaN or zero" in str(refused.value) and "check the LiDAR's driver" in str(refused.value)
