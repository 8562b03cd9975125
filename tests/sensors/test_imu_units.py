"""Wrong units or axes of an IMU are detected by gravity, which must rotate as the gyroscope measures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.sensors.imu_units import AS_RECORDED, ImuProbe, Sway, gravity_findings, holds_gravity, settle_imu
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.sections import RecordingParams

G = 9.80665


def at_rest(accel: tuple[float, ...], gyro: tuple[float, ...] = (0, 0, 0), wobble: float = 0.0) -> ImuProbe:
    stamps = 5_000_000 * np.arange(200)
    noise = np.random.default_rng(0).normal(size=(200, 3)) * (wobble or 1e-4)
    return ImuProbe(stamps, stamps, np.array(gyro) + noise, np.array(accel) + 5 * noise)


def carried(gravity: float = G) -> ImuProbe:
    """20 s at 200 Hz of a device that is swung about all axes while walking, with noise: rad/s and m/s^2."""
    at = np.arange(4000) / 200.0
    angles = np.column_stack([0.4 * np.sin(1.1 * at), 0.3 * np.sin(1.7 * at + 1), 0.9 * np.sin(0.6 * at + 2)])
    turned = Rotation.from_euler("xyz", angles)
    rng = np.random.default_rng(1)
    gyro = (
        np.vstack([(turned[:-1].inv() * turned[1:]).as_rotvec() * 200, np.zeros(3)]) + rng.normal(size=(4000, 3)) * 0.01
    )
    steps = np.column_stack([np.sin(11 * at), np.cos(11 * at), 2 * np.sin(22 * at)]) + rng.normal(size=(4000, 3)) * 0.1
    stamps = (at * 1e9).astype(np.int64)
    return ImuProbe(stamps, stamps, gyro, turned.inv().apply(steps + np.array([0, 0, gravity])))


@pytest.mark.parametrize(
    ("norm", "chosen", "scale", "verdict"),
    [
        (1.0, "auto", G, "corrected"),
        (1000.0, "auto", G / 1000, "corrected"),
        (9.79, "auto", 1.0, "fine"),
        (9.79, "m/s2", 1.0, "fine"),
        (9.79, "g", G, "needs you"),
        (13.0, "auto", 1.0, "needs you"),
        (1.4, "auto", G, "needs you"),
        (5.0, "auto", 1.0, "needs you"),
        (1.7, "auto", 1.0, "needs you"),  # a walk without gravity
        (16384.0, "auto", 1.0, "needs you"),  # bare counts
    ],
)
def test_the_unit_of_acceleration_is_known_by_gravity(norm: float, chosen: str, scale: float, verdict: str) -> None:
    probe = at_rest((0.6 * norm, 0.0, -0.8 * norm))
    units, findings = settle_imu(probe, RecordingParams.model_validate({"acceleration_unit": chosen}))
    assert units.apply((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))[1][0] == scale
    assert findings[0].verdict == verdict


def test_a_gyroscope_in_degrees_is_suspected_at_rest_and_corrected_once_it_is_carried() -> None:
    _, findings = settle_imu(at_rest((0, 0, 9.81), gyro=(0, 25.0, 0)), RecordingParams())
    assert findings[-1].verdict == "needs you" and findings[-1].option.endswith("gyroscope_unit=deg/s")
    walk = carried()
    degrees = ImuProbe(walk.log_ns, walk.stamps_ns, np.degrees(walk.gyro), walk.accel)
    units, findings = settle_imu(degrees, RecordingParams())
    np.testing.assert_allclose(units.apply((180.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0], (np.pi, 0, 0))
    assert findings[-1].verdict == "corrected"


def test_a_repeated_stamp_does_not_hide_a_gyroscope_in_degrees() -> None:
    walk = carried()
    stamps = walk.stamps_ns.copy()
    stamps[2000] = stamps[1999]
    units, findings = settle_imu(ImuProbe(stamps, stamps, np.degrees(walk.gyro), walk.accel), RecordingParams())
    assert units.gyro[0][1] == pytest.approx(np.pi / 180) and "deg/s" in findings[-1].text


def test_an_imu_in_order_is_left_as_it_is() -> None:
    units, findings = settle_imu(carried(), RecordingParams())
    assert units == AS_RECORDED and {finding.verdict for finding in findings} == {"fine"}


@pytest.mark.parametrize("axes", ["yxz", "-yxz", "zyx", "x-y-z", "yzx"])
def test_an_accelerometer_with_other_axes_is_named_with_the_option_that_settles_it(axes: str) -> None:
    walk, wanted = carried(), RecordingParams(accelerometer_axes=axes)
    made, _ = settle_imu(walk, wanted)
    wrong = np.array([made.apply((0, 0, 0), tuple(row))[1] for row in walk.accel])  # type: ignore[arg-type]
    probe = ImuProbe(walk.log_ns, walk.stamps_ns, walk.gyro, wrong)
    _, findings = settle_imu(probe, RecordingParams())
    assert findings[-1].subject == "IMU axes" and findings[-1].verdict == "needs you"
    section, _, value = findings[-1].option.partition("=")
    _, settled = settle_imu(probe, RecordingParams.model_validate({section.split(".")[1]: value}))
    assert {finding.verdict for finding in settled} == {"fine"}


def test_a_mirrored_gyroscope_is_mended_by_its_own_axes() -> None:
    walk = carried()
    _, findings = settle_imu(
        ImuProbe(walk.log_ns, walk.stamps_ns, walk.gyro * [1, -1, 1], walk.accel), RecordingParams()
    )
    assert findings[-1].option == "--set recording.gyroscope_axes=x-yz"


def test_a_gap_of_hours_neither_takes_long_nor_hides_exchanged_axes() -> None:
    walk = carried()
    stamps = walk.stamps_ns + np.where(np.arange(4000) < 100, 0, 30_000_000_000_000)
    sway = Sway.of(stamps, walk.gyro, walk.accel)
    assert sway is not None and 60 < len(sway.begin) < 80  # four a second of the 19.5 s after the gap
    _, findings = settle_imu(ImuProbe(stamps, stamps, walk.gyro * [1, -1, 1], walk.accel), RecordingParams())
    assert findings[-1].option == "--set recording.gyroscope_axes=x-yz"


def test_an_axis_that_is_stuck_is_named() -> None:
    walk = carried()
    walk.gyro[:, 1] = 0.25
    _, findings = settle_imu(walk, RecordingParams())
    assert "gyroscope y (0.25)" in findings[-1].text and findings[-1].verdict == "needs you"


def test_an_accelerometer_that_reads_nothing_is_refused() -> None:
    walk = carried()
    with pytest.raises(HemislamError, match="reads 0 on all axes"):
        settle_imu(ImuProbe(walk.log_ns, walk.stamps_ns, walk.gyro, 0 * walk.accel), RecordingParams())


def test_gravity_is_told_from_a_walk_without_it_in_every_unit() -> None:
    walk, steps = carried(), carried(gravity=0.0).accel
    for unit in (1.0, 1 / G, 1000 / G):
        assert holds_gravity(replace(walk, accel=unit * walk.accel))
        assert not holds_gravity(replace(walk, accel=unit * steps))
    assert not holds_gravity(replace(walk, accel=np.full_like(walk.accel, 0.02))), "at rest, a bias remains"


@pytest.mark.parametrize("axes", ["xxy", "xy", "xyzz", "--xyz", "abc", ""])
def test_axes_that_name_no_three_axes_are_refused(axes: str) -> None:
    with pytest.raises(ValueError, match="pattern"):
        RecordingParams(accelerometer_axes=axes)


def test_down_is_reported_in_the_lidar_frame_through_the_mount() -> None:
    """IMU upright, LiDAR pitched by +90 deg: its x axis then points down."""
    params = Params().merged({"sensor": {"rotation": [0, 90, 0], "translation": [0, 0, 0.1]}})
    gravity, mount = gravity_findings(at_rest((0, 0, 9.81)), AS_RECORDED, params)
    assert "0 deg from the LiDAR's +x axis" in gravity.text
    assert (gravity.verdict, mount.verdict) == ("fine", "fine")


def test_a_mount_that_was_never_given_and_a_moving_start_are_named() -> None:
    gravity, mount = gravity_findings(at_rest((9.81, 0, 0), wobble=0.2), AS_RECORDED, Params())
    assert "moves" in gravity.text and gravity.verdict == "corrected"
    assert mount.verdict == "needs you" and "sensor.translation" in mount.option
