"""Tests app/slam/channels.py: corrections of scan lines move points along and across their beams, and nothing else."""

import numpy as np
import pytest

from app.slam import channels
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Scan


def scan_of(points: np.ndarray, ring: np.ndarray) -> Scan:
    zero = np.zeros(len(points), np.float32)
    return Scan(0, points.astype(np.float32), zero.astype(np.int32), zero, ring.astype(np.uint16))


def test_a_beam_is_raised_and_lengthened_in_its_own_vertical_plane() -> None:
    rng = np.random.default_rng(0)
    points, ring = rng.normal(size=(500, 3)) * 10, rng.integers(0, 3, 500)
    sensor = Params().with_values(
        {"sensor.elevation_corrections": "0.5 -1", "sensor.range_corrections": "0.02 0 -0.03"}
    )
    out = channels.corrected(scan_of(points, ring), sensor.sensor).points.astype(np.float64)
    up = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (points, out)]
    assert np.allclose(np.degrees(up[1] - up[0]), np.array([0.5, -1.0, 0.0])[ring], atol=1e-4)
    longer = np.linalg.norm(out, axis=1) - np.linalg.norm(points, axis=1)
    assert np.allclose(longer, np.array([0.02, 0.0, -0.03])[ring], atol=1e-5)
    assert np.allclose(np.arctan2(out[:, 1], out[:, 0]), np.arctan2(points[:, 1], points[:, 0]), atol=1e-5)


def test_without_corrections_the_scan_is_the_same() -> None:
    scan = scan_of(np.ones((3, 3)), np.zeros(3))
    assert channels.corrected(scan, Params().sensor) is scan


def test_a_point_without_direction_stays_finite() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    out = channels.bent(scan_of(points, np.zeros(2)), np.array([0.1]), np.array([0.01])).points
    assert np.isfinite(out).all()


def test_text_and_numbers_are_each_others_reverse() -> None:
    values = np.array([0.12345, -0.0004, 0.0])
    assert channels.text(values, 3) == "0.123 0 0"
    assert np.allclose(channels.numbers(channels.text(values, 5)), values)
    assert channels.text(np.zeros(4), 3) == ""


@pytest.mark.parametrize("text", ["a", "0.1,0.2", "1e9", "nan", "1 2 -", "--1", "1-2", "1" * 400 + " 0", "100 0"])
def test_what_is_no_list_of_numbers_is_refused_by_name(text: str) -> None:
    with pytest.raises(HemislamError, match=r"sensor\.elevation_corrections.*(numbers with spaces)"):
        Params().with_values({"sensor.elevation_corrections": text})
