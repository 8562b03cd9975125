"""Settings override each other in the documented order."""

from pathlib import Path

import numpy as np
import pytest

from app.sensors.presets import PRESETS, resolve_params
from app.sensors.robosense import AIRY, rays
from app.slam import ground
from app.slam.arrays import F32, U16
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.sections import GroundParams


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_is_a_valid_set_of_parameters(name: str) -> None:
    assert resolve_params(None, name, None, []) == Params().merged(PRESETS[name])


def test_h2lid_is_mounted_as_its_authors_say() -> None:
    params = resolve_params(None, "h2lid", None, [])
    assert params.sensor.translation == (0.0175, 0.0276, -0.1083)
    assert (params.recording.lidar_topic, params.recording.imu_topic) == ("/horizontal_laser_3d", "/imu")


def test_defaults_yield_to_preset_to_sidecar_to_config_to_assignment(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    recording.touch()
    (tmp_path / "walk.params.yaml").write_text("sensor: {translation: [1, 1, 1], min_range: 1}\nground: {alpha: 11}\n")
    config = tmp_path / "mine.yaml"
    config.write_text("sensor: {min_range: 2}\nground: {alpha: 22}\n")
    params = resolve_params(recording, "h2lid", config, ["ground.alpha=33"])
    assert params.recording.imu_topic == "/imu"  # preset
    assert params.sensor.translation == (1, 1, 1)  # sidecar over preset
    assert params.sensor.min_range == 2  # config over sidecar
    assert params.ground.alpha == 33  # assignment over config
    assert params.ground.sigma == Params().ground.sigma


def test_a_folder_recording_has_its_sidecar_beside_it(tmp_path: Path) -> None:
    (tmp_path / "walk.v2").mkdir()
    (tmp_path / "walk.v2.params.yaml").write_text("ground: {alpha: 12}")
    assert resolve_params(tmp_path / "walk.v2", None, None, []).ground.alpha == 12


@pytest.mark.parametrize(
    ("content", "said"),
    [("ground: {alfa: 3}", r"walk\.params\.yaml.*ground\.alpha"), ("ground: [", r"walk\.params\.yaml.*not valid YAML")],
)
def test_a_wrong_sidecar_is_named(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "walk.params.yaml").write_text(content)
    with pytest.raises(HemislamError, match=said):
        resolve_params(tmp_path / "walk.mcap", None, None, [])


def test_unknown_presets_and_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"no preset `h2lidd`.*h2lid"):
        resolve_params(None, "h2lidd", None, [])
    with pytest.raises(HemislamError, match=r"no parameter file .*mine\.yaml"):
        resolve_params(None, None, tmp_path / "mine.yaml", [])
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(HemislamError, match="not UTF-8"):
        resolve_params(None, None, tmp_path / "binary.yaml", [])


DOWN = np.array([-1.0, 0.0, 0.0])


def floor_seen_by_an_airy(random: np.random.Generator) -> tuple[F32, U16]:
    """Points (n, 3) m and their lines (n,)."""
    ring, azimuth = (values.ravel() for values in np.mgrid[: AIRY.channels, 0:360:2])
    written = np.radians(AIRY.elevations_deg)[ring]
    true = written + random.normal(0.0, np.radians(0.12), AIRY.channels)[ring]
    with np.errstate(divide="ignore"):
        ranges = 1.3 / (rays(true, np.radians(azimuth)) @ DOWN)
    seen = (ranges > 0.0) & (ranges < 30.0)
    ranges += random.normal(0.0, 0.01, AIRY.channels)[ring] + random.normal(0.0, 0.017, len(ranges))
    points = rays(written, np.radians(azimuth)) * ranges[:, None]
    return points[seen].astype(np.float32), ring[seen].astype(np.uint16)


def share_found(points: F32, ring: U16, params: GroundParams) -> float:
    return float(np.mean(ground.segment(points, ring, DOWN, params).labels > 0))


def test_a_quarter_of_an_airys_lines_finds_the_ground_although_each_line_is_off() -> None:
    """A level floor 1.3 m below a scanner that looks forward, with the line errors that calibrations report."""
    random = np.random.default_rng(0)
    params = resolve_params(None, "airy", None, []).ground
    scans = [floor_seen_by_an_airy(random) for _ in range(20)]
    quarter, eight = (np.median([share_found(*scan, used) for scan in scans]) for used in (params, GroundParams()))
    assert quarter > 0.97
    assert eight < 0.9
