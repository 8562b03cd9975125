"""What a live source learns of its sensors in the first seconds, and what it says if it learns too little."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.sensors.live.intake import Intake
from app.sensors.live.status import Status
from app.sensors.recording import ImuEntry
from app.slam.params import Params
from app.slam.types import Scan
from tests.sensors.live import sensor

MILLISECOND_NS = 1_000_000
DEGREES = 180 / np.pi


def scan(stamp_ns: int) -> Scan:
    points, offsets = np.ones((10, 3), np.float32), np.linspace(0, 1e8, 10).astype(np.int32)
    return Scan(stamp_ns, points, offsets, points[:, 0], np.zeros(10, np.uint16))


def sway(intake: Intake, rest_s: float, unit: float) -> tuple[list[str], list[ImuEntry]]:
    """News and samples of six seconds in which a hand turns the device, after it has been at rest."""
    noise = np.random.default_rng(0)
    turned = Rotation.identity()
    for k in range(1200):
        now = sensor.START_NS + k * 5 * MILLISECOND_NS
        at = k * 0.005
        rates = np.array([0.6 * np.sin(2 * at), 0.8 * np.sin(1.3 * at), 0.5 * np.cos(at)]) * (at >= rest_s)
        turned *= Rotation.from_rotvec(rates * 0.005)
        gyro, accel = rates * unit, turned.inv().apply([0.0, 0.0, 9.81])
        (x, y, z), (u, v, w) = gyro + noise.normal(size=3) * 1e-3, accel + noise.normal(size=3) * 0.02
        intake.put_imu(now, (x, y, z), (u, v, w), now)
        if k % 20 == 19:
            intake.put_scan(scan(now - 100 * MILLISECOND_NS), now)
    found, _ = intake.take(0.0, scan=False)
    return [e.text for e in found if isinstance(e, Status)], [e for e in found if isinstance(e, ImuEntry)]


def test_a_gyroscope_in_degrees_is_found_if_the_device_turns_from_the_start() -> None:
    (text,), samples = sway(Intake(Params()), 0.0, DEGREES)
    assert "in deg/s, by how gravity turns" in text
    assert len(samples) == 1200
    assert np.abs([sample.gyro for sample in samples]).max() < 1.0


def test_a_gyroscope_in_degrees_that_rested_first_is_suspected_once() -> None:
    (text,), _ = sway(Intake(Params()), 2.5, DEGREES)
    assert "too fast for a hand in rad/s: it may be in deg/s" in text
    assert text.endswith("; start hemislam with --set recording.gyroscope_unit=deg/s")


@pytest.mark.parametrize(
    ("rest_s", "unit", "chosen"), [(2.5, 1.0, "auto"), (0.0, 1.0, "auto"), (2.5, DEGREES, "deg/s")]
)
def test_of_a_gyroscope_in_order_nothing_is_said(rest_s: float, unit: float, chosen: str) -> None:
    news, samples = sway(Intake(Params().with_values({"recording.gyroscope_unit": chosen})), rest_s, unit)
    assert news == []
    assert len(samples) == 1200


def play(lidar_s: float, imu_s: float, cloud_delay_s: float = 0.005) -> tuple[str, list[str]]:
    """Which clock is used, and the news, if the stamps are so far ahead of the host's clock."""
    intake, events = Intake(Params()), []
    noise = np.random.default_rng(0)
    for k in range(400):
        now = sensor.START_NS + k * 5 * MILLISECOND_NS
        events.append((now + 2 * MILLISECOND_NS, "imu", now + round(imu_s * 1e9)))
        if k % 20 == 19:
            stamp = now - 100 * MILLISECOND_NS + round(lidar_s * 1e9)
            events.append((now + round(cloud_delay_s * 1e9), "lidar", stamp))
    for arrival, name, stamp in sorted(events):
        if name == "lidar":
            intake.put_scan(scan(stamp), arrival)
            continue
        (wx, wy, wz), (x, y, z) = noise.normal(size=(2, 3)) * 1e-2
        intake.put_imu(stamp, (wx, wy, wz), (x, y, 9.81 + z), arrival)
    found, _ = intake.take(0.0, scan=False)
    return intake.state().clock, [entry.text for entry in found if isinstance(entry, Status)]


def test_clouds_that_a_slow_network_delays_keep_their_stamps() -> None:
    clock, (text,) = play(0.0, 0.0, cloud_delay_s=0.3)
    assert clock == "sensor"
    assert "as over a slow network" in text and "?clock=host" in text
    assert play(0.0, 0.0) == ("sensor", [])


@pytest.mark.parametrize(("lidar_s", "imu_s"), [(0.0, 0.3), (0.0, -0.5), (-3.0, 0.0), (-1e9, 0.0), (0.0, -1e9)])
def test_a_clock_that_is_wrong_is_not_taken_for_a_slow_network(lidar_s: float, imu_s: float) -> None:
    clock, (text,) = play(lidar_s, imu_s)
    assert clock == "host"
    assert "stamped by the host's clock instead" in text
