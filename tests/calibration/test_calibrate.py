"""Tests app/calibration/excerpt.py, app/calibration/odometry.py, app/calibration/calibrate.py,
app/calibration/words.py, app/cli/calibrate.py and app/evaluation/plots.py: the pose of the LiDAR on the IMU,
from a recording alone."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from app.__main__ import cli
from app.calibration.calibrate import AxesError, calibrate, calibrate_excerpt
from app.calibration.excerpt import Excerpt, read_excerpt
from app.calibration.inertial import Noise
from app.calibration.lines import Lines
from app.calibration.odometry import track
from app.calibration.words import WALK, as_json, check_beside, table, write_beside
from app.cli.run import look_for_mounting, settle_mounting
from app.evaluation.plots import residual_plot
from app.sensors.presets import built_in_mounting, calibrated_beside, resolve_params, sidecar
from app.sensors.recording import open_recording
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.trajectory import read_tum
from tests.calibration.rehearsal import MID360, TURN, known
from tests.cli.conftest import write_walk
from tests.sensors import rig


@pytest.fixture(scope="module")
def excerpt(shared_data: Path) -> Excerpt:
    params = Params()
    with open_recording(shared_data / "hall_mid360.mcap", params) as recording:
        return read_excerpt(recording, params)


def test_a_lidar_turned_on_its_imu_and_a_late_clock_are_found_from_the_recording_alone(excerpt: Excerpt) -> None:
    scans = tuple(replace(s, points=np.ascontiguousarray(s.points @ TURN.astype(np.float32))) for s in excerpt.scans)
    imu = replace(excerpt.imu, stamps_ns=excerpt.imu.stamps_ns - 30_000_000)
    found = calibrate_excerpt(Path("walk.mcap"), Params(), Excerpt(scans, imu))
    assert np.degrees(Rotation.from_matrix(TURN.T @ found.turned.R_imu_lidar).magnitude()) < 0.3
    assert abs(found.turned.late - 0.030) < 1e-3
    off = np.abs(found.moved.p_imu_lidar - MID360)
    assert (off < np.maximum(0.03, 3 * found.sigmas["translation"])).all()
    assert found.observed["rotation"] and found.observed["offset"]
    named = lie.from_rpy_degrees(tuple(found.found()["sensor.rotation"]))
    assert np.allclose(named, found.turned.R_imu_lidar, atol=1e-4)
    assert "rotated by 70°, -50°, 104°" in found.contradiction()
    assert "clock seems to be 30 ms early" in found.contradiction()


def test_a_scanner_with_an_imu_inside_is_recognised_and_its_mounting_taken(shared_data: Path) -> None:
    found = calibrate(shared_data / "hall_mid360.mcap", Params())
    assert np.allclose(found.found()["sensor.translation"], MID360, atol=0.01)
    assert found.contradiction() == "The clouds and the IMU are those of preset mid360, which has the mounting"


def test_a_mounting_of_a_preset_counts_for_the_imu_inside_only(tmp_path: Path) -> None:
    assert np.allclose(built_in_mounting("mid360", "/livox/imu")["translation"], MID360)
    assert built_in_mounting("mid360", "/imu") == built_in_mounting("velodyne", "/imu") == {}
    turned = known(tmp_path / "walk.mcap", preset="mid360")  # the scans contradict the preset
    assert turned.contradiction().startswith("The LiDAR seems to be rotated by 70°, -50°, 104°")


def test_a_place_alone_is_said_to_be_the_lidars(tmp_path: Path) -> None:
    found = known(tmp_path / "walk.mcap")
    given = {"sensor.rotation": found.rotation, "sensor.translation": (0.0, 0.0, 0.5)}
    found = replace(found, params=found.params.with_values(given))
    assert found.contradiction().startswith("The LiDAR seems to be at -0.01, -0.02, 0.04 m on the IMU")


def test_a_mirrored_gyroscope_is_named_instead_of_a_mounting(excerpt: Excerpt) -> None:
    imu = replace(excerpt.imu, gyro=excerpt.imu.gyro * [1.0, -1.0, 1.0])
    with pytest.raises(AxesError, match=r"in a mirror: .*gyroscope_axes to -xyz, x-yz or xy-z"):
        calibrate_excerpt(Path("walk.mcap"), Params(), Excerpt(excerpt.scans, imu))


def test_an_accelerometer_of_the_opposite_sign_is_named(excerpt: Excerpt) -> None:
    imu = replace(excerpt.imu, accel=-excerpt.imu.accel)
    set_so = Params().with_values({"recording.accelerometer_axes": "-yxz"})
    with pytest.raises(AxesError, match=r"the opposite of how the LiDAR moves: .*accelerometer_axes to y-x-z"):
        calibrate_excerpt(Path("walk.mcap"), set_so, Excerpt(excerpt.scans, imu))


def test_info_and_run_tell_of_a_mirrored_gyroscope(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(*_: object) -> None:
        raise AxesError("It is mirrored.")

    monkeypatch.setattr("app.calibration.calibrate.calibrate", found)
    assert look_for_mounting(Path("walk.mcap"), Params()) == "It is mirrored."
    assert settle_mounting(Path("walk.mcap"), Params()) == (Params(), "It is mirrored.")


def test_reading_skips_the_rest_at_the_start(excerpt: Excerpt, shared_data: Path) -> None:
    """It stands still for three seconds, and a second of that is enough."""
    with open_recording(shared_data / "hall_mid360.mcap", Params()) as recording:
        assert 1.5 < (excerpt.scans[0].end_ns - recording.start_ns) * 1e-9 < 3.0
    assert all(a.end_ns < b.end_ns for a, b in zip(excerpt.scans, excerpt.scans[1:], strict=False))


def test_the_scans_alone_give_the_turns_of_the_first_steps_outdoors(shared_data: Path) -> None:
    """A map seen from one place is full of poor planes along the scan lines, which would hold the LiDAR there."""
    path = shared_data / "outdoor_bpearl.mcap"
    with open_recording(path, Params()) as recording:
        walk = read_excerpt(recording, Params(), 9.0)
    way, truth = track(walk), read_tum(path.with_name("outdoor_bpearl_truth.tum"))
    turned = Rotation.from_quat(truth.quaternions[np.searchsorted(truth.stamps_ns, walk.ends_ns - 1_000_000)])
    off = (turned[0].inv() * turned).inv() * Rotation.from_matrix(way.rotations)
    assert np.degrees(off.magnitude().max()) < 1.0


def test_what_was_found_is_kept_beside_the_recording_and_undone_by_deleting_it(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    path = write_beside(recording, known(recording).found())
    params = resolve_params(recording, "mid360", None, [])
    assert np.allclose(params.sensor.rotation, [70.0, -50.0, 104.0], atol=1e-2)
    assert params.recording.imu_time_offset == pytest.approx(0.02)
    assert f"{path}; delete it to undo" in calibrated_beside(recording)
    write_beside(recording, known(recording).found())  # its own file may be replaced
    path.unlink()
    assert calibrated_beside(recording) == ""
    assert resolve_params(recording, None, None, []) == Params()


def test_a_file_that_a_person_wrote_is_never_overwritten_unasked(tmp_path: Path) -> None:
    recording = tmp_path / "walk.mcap"
    mine = "# mine\nsensor:\n  max_range: 40\nfilter:\n  max_points: 700\n"
    sidecar(recording).write_text(mine)
    with pytest.raises(HemislamError, match="yourself; add --force"):
        check_beside(recording)
    assert sidecar(recording).read_text() == mine
    assert calibrated_beside(recording) == ""
    write_beside(recording, known(recording).found())
    params = resolve_params(recording, None, None, [])
    assert (params.sensor.max_range, params.filter.max_points) == (40, 700)
    assert params.sensor.translation[0] == pytest.approx(-0.011)
    assert (tmp_path / "walk.params.yaml.old").read_text() == mine
    assert "; rename walk.params.yaml.old to walk.params.yaml to undo" in calibrated_beside(recording)
    other = known(recording)
    again = replace(other, moved=replace(other.moved, p_imu_lidar=MID360 + 0.02))
    write_beside(recording, again.found())  # unasked
    params = resolve_params(recording, None, None, [])
    assert (params.sensor.max_range, params.filter.max_points) == (40, 700)
    assert params.sensor.translation[0] == pytest.approx(0.009)
    assert (tmp_path / "walk.params.yaml.old").read_text() == mine
    assert "; rename walk.params.yaml.old to walk.params.yaml to undo" in calibrated_beside(recording)


def test_an_earlier_calibration_does_not_count_as_given(tmp_path: Path) -> None:
    recording, mine = tmp_path / "walk.mcap", "sensor:\n  max_range: 40\n"
    write_beside(recording, known(recording).found())
    before = resolve_params(recording, "h2lid-mount", None, [], calibrated=False)
    assert before == resolve_params(None, "h2lid-mount", None, [])
    sidecar(recording).write_text(mine)
    write_beside(recording, known(recording).found())
    assert resolve_params(recording, None, None, [], calibrated=False) == Params().merged_yaml(mine, "mine")
    (tmp_path / "walk.params.yaml.old").unlink()  # then nothing else has the user's parameters
    assert resolve_params(recording, None, None, [], calibrated=False).sensor.max_range == 40


def test_what_the_motion_does_not_determine_is_said_and_not_kept(tmp_path: Path) -> None:
    found = known(tmp_path / "walk.mcap", sure=False)
    assert [text for _, text in table(found)[:3]] == [WALK] * 3
    assert found.found() == {} and found.contradiction() == ""
    with pytest.raises(HemislamError, match="can be kept"):
        write_beside(tmp_path / "walk.mcap", found.found())


def test_a_mounting_that_agrees_with_the_parameters_is_no_contradiction(tmp_path: Path) -> None:
    values = known(tmp_path / "walk.mcap").found()
    right = Params().with_values({name: value for name, value in values.items() if name.startswith("sensor.")})
    found = known(tmp_path / "walk.mcap", params=right)
    assert "turned" not in found.contradiction() and "ms" in found.contradiction()


def test_a_given_mounting_counts_as_much_as_a_drawing_unless_it_is_surely_wrong(tmp_path: Path) -> None:
    found = known(tmp_path / "walk.mcap")
    given = Params().merged({"sensor": {"translation": list(MID360 + 0.01), "rotation": [70.0, -50.0, 104.5]}})
    rough = replace(found.moved, covariance=np.eye(6) * 0.015**2)  # three times that of a drawing
    near = replace(found, params=given, moved=rough)
    assert np.allclose(near.mounting[0], TURN, atol=5e-4)
    assert np.allclose(near.mounting[1], MID360 + 0.009, atol=1e-6)
    assert np.allclose(near.found()["sensor.translation"], MID360 + 0.009, atol=1e-4)
    assert np.allclose(replace(near, params=Params()).mounting[1], MID360)
    far = replace(near, moved=replace(rough, p_imu_lidar=MID360 + 0.2))
    assert np.allclose(far.mounting[1], MID360 + 0.2) and "0.19, 0.18, 0.24 m" in far.contradiction()


def test_what_was_given_is_saved_with_what_was_found(tmp_path: Path) -> None:
    """Calibrating twice keeps the clock of the first time, and a saved file needs no preset beside it."""
    recording = tmp_path / "walk.mcap"
    first = resolve_params(write_beside(recording, known(recording).found()).with_name("walk.mcap"), None, None, [])
    again = known(recording, params=first)
    again = replace(again, turned=replace(again.turned, late=0.0), moved=replace(again.moved, covariance=np.eye(6)))
    params = resolve_params(write_beside(recording, again.found()).with_name("walk.mcap"), None, None, [])
    assert params.recording.imu_time_offset == pytest.approx(0.02)
    assert np.allclose(params.sensor.translation, MID360, atol=1e-4)


def test_numbers_for_programs_are_json_and_the_plot_is_an_image(tmp_path: Path) -> None:
    found = known(tmp_path / "walk.mcap")
    assert json.loads(json.dumps(as_json(found)))["observed"]["rotation"] is True
    drawn = ElementTree.fromstring(residual_plot(found))
    assert drawn.tag.endswith("svg") and len(list(drawn.iter("{http://www.w3.org/2000/svg}polyline"))) == 4
    labels = [text.text or "" for text in drawn.iter("{http://www.w3.org/2000/svg}text") if text.get("class") == "axis"]
    assert len(labels) == 4 and max(map(len, labels)) < 40, "a longer one does not fit beside a chart"


def test_numbers_that_are_not_known_are_no_numbers() -> None:
    unknown = replace(known(Path("walk.mcap")), gyro_noise=Noise(np.nan, np.nan))
    assert json.loads(json.dumps(as_json(unknown), allow_nan=False))["gyro_noise"] == [None, None]
    assert ("noise of the gyroscope", "not known: it takes four seconds of evenly spaced samples") in table(unknown)


def test_samples_that_no_imu_measures_do_not_reach_it(tmp_path: Path) -> None:
    """A spike of the gyroscope, and a first sample stamped 0."""
    entries = rig.walk(turns=70, columns=4)
    of_imu = [sent for topic, _, sent in entries if topic == "/imu"]
    of_imu[0].header = rig.header(0, 2)
    of_imu[300].angular_velocity.x = 300.0
    with open_recording(rig.write(tmp_path / "walk", entries), Params()) as recording:
        excerpt = read_excerpt(recording, Params())
    assert np.abs(excerpt.imu.gyro).max() < 1.0 and excerpt.imu.stamps_ns[0] > rig.START_NS - 10**9
    assert len(excerpt.scans) > 60


def test_a_recording_that_is_too_short_is_refused_in_a_sentence(shared_data: Path) -> None:
    result = CliRunner().invoke(cli, ["calibrate", str(shared_data / "hall_mid360.mcap"), "--duration", "5"])
    assert result.exit_code == 2 and "needs at least 50 scans" in result.output


def test_a_recording_without_an_imu_is_refused_before_it_is_read(tmp_path: Path) -> None:
    alone = [entry for entry in rig.walk(turns=60, columns=4) if entry[0] == "/points"]
    with pytest.raises(HemislamError, match="has no usable IMU, so there is nothing to calibrate"):
        calibrate(rig.write(tmp_path / "walk", alone), Params())


def test_errors_of_scan_lines_are_told_drawn_and_kept(tmp_path: Path) -> None:
    elevations, ranges = np.radians([0.2, -0.2, 0.1, 0.0]), np.array([0.01, -0.01, 0.002, 0.0])
    sigmas = np.tile([[np.radians(0.01)], [0.001]], 4)
    seen = np.array([0.02, 0.02, 0.02, np.nan])
    found = replace(known(tmp_path / "walk.mcap"), lines=Lines(elevations, ranges, sigmas, seen, seen / 2))
    rows = dict(table(found))
    assert rows["elevations of the scan lines"] == "off by 0.15 (RMS), 0.2 at most, ± 0.01 deg"
    assert rows["scan lines on planes"] == "20.0 mm before, 10.0 after"
    assert "not observable" in rows["distance offset of all lines"]
    assert json.loads(json.dumps(as_json(found)))["lines"]["residuals_m"][0][3] is None
    assert "points on planes" in residual_plot(found)
    ElementTree.fromstring(residual_plot(found))
    params = resolve_params(write_beside(tmp_path / "walk.mcap", found.found()).with_name("walk.mcap"), None, None, [])
    assert params.sensor.elevation_corrections == "0.2 -0.2 0.1 0"
    assert params.sensor.range_corrections == "0.01 -0.01 0.002 0"


def test_a_walk_that_never_turns_is_tracked_once_and_gives_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor corrections of scan lines, which a rotation by chance would bring about."""
    write_walk(tmp_path / "walk.mcap", duration_s=8.0, imu_until_s=8.0)
    tracked = list[Any]()
    monkeypatch.setattr("app.calibration.calibrate.track", lambda *call: tracked.append(call[1]) or track(*call))
    found = calibrate(tmp_path / "walk.mcap", Params())
    assert tracked == [None] and found.found() == {}
    rows = dict(table(found))
    assert rows["rotation of the LiDAR on the IMU"] == rows["scan lines"] == WALK
    assert not any("nan" in text for text in rows.values())
