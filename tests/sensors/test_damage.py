"""Tests app/sensors/source.py: the advice for damaged files works as written."""

import re
import shlex
from pathlib import Path

import pytest

from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement
from tests.sensors import rig


@pytest.mark.parametrize("imu_first_s", [0.05, 3.0])
@pytest.mark.parametrize("kind", ["cut", "hole"])
def test_the_duration_that_a_damaged_file_advises_ends_before_the_damage(
    tmp_path: Path, kind: str, imu_first_s: float
) -> None:
    """--duration counts from the first scan, which may come seconds after the first IMU sample."""
    entries = rig.walk(turns=160, columns=20, imu_start_ns=-round(imu_first_s * 1e9))
    path = rig.write(tmp_path / "walk", sorted(entries, key=lambda entry: entry[1]), "small-chunks")
    content = bytearray(path.read_bytes())
    half = len(content) // 2
    path.write_bytes(content[:half] if kind == "cut" else content[:half] + bytes(2000) + content[half + 2000 :])
    with open_recording(path, Params()) as recording:
        with pytest.raises(HemislamError) as caught:
            list(recording.measurements())
        (advised,) = re.findall(r"start hemislam with --duration ([\d.]+)", str(caught.value))
        used = [entry for entry in recording.measurements(0.0, float(advised)) if isinstance(entry, Measurement)]
    assert len(used) == pytest.approx(float(advised) / (rig.PERIOD_NS / 1e9), abs=2)
    assert len(used) > 30


def test_paths_in_commands_are_written_as_a_shell_takes_them(tmp_path: Path) -> None:
    folder = tmp_path / "Halle (alt)"
    folder.mkdir()
    for name in ("my walk.mcap", "my walk.db3", "my walk.bag", "my walk.osf", "my walk.bag.active", "my walk.db3.zst"):
        path = folder / name
        magic = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
        path.write_bytes(magic.get(path.suffix, b"x") + bytes(100))
        with pytest.raises(HemislamError) as caught:
            open_recording(path, Params())
        (command,) = re.findall("`(.*)`", str(caught.value))
        assert str(path) in shlex.split(command)
