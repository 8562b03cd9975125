"""Truth in every format gives the same poses; unusable truth is refused with one sentence.

Tests app/evaluation/truth_match.py.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from app.evaluation.truth import H2LID_LEVER, TruePoses, check_overlap, read_truth
from app.evaluation.truth_match import find_offset, match
from app.slam.errors import HemislamError
from app.slam.metrics import ate, rpe
from app.slam.trajectory import Trajectory, write_tum
from tests.evaluation import walks


def seen_elsewhere(walk: Trajectory, seed: int = 5) -> Trajectory:
    """The same walk in the odometry's own world."""
    turn = Rotation.from_rotvec([0, 0, seed * 0.7])
    moved = turn.apply(walk.positions) + np.array([3, -7, 1])
    return Trajectory(walk.stamps_ns, moved, (turn * walk.rotations).as_quat())


ESTIMATE = seen_elsewhere(walks.wandering(walks.frames()))


@pytest.fixture(scope="module")
def gnss(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """At 200 Hz, 20 s longer than the recording on both sides, in seconds of the GPS week."""
    walk = walks.wandering(np.arange(-20.0, 100.0, 0.005))
    head = "GPSTime Easting Northing H-Ell Heading Pitch Roll Latitude Longitude VEast VNorth VUp Q"
    lines = [head, *walks.gnss_lines(walk, 9879.920, H2LID_LEVER)]
    return walks.write(tmp_path_factory.mktemp("truth") / "gnss.txt", lines)


def test_the_gnss_table_is_brought_into_clock_point_and_axes_of_the_imu(gnss: Path) -> None:
    matched = match(read_truth(str(gnss)), ESTIMATE)
    true_offset = walks.START_NS * 1e-9 - 20.0 - 9879.920
    assert matched.offset_s == pytest.approx(true_offset, abs=0.002)
    error = ate(ESTIMATE, matched.trajectory)
    assert error.position.max < 0.01  # the table is written in millimetres, time is found to milliseconds
    assert error.rotation.max < 0.2
    relative = rpe(ESTIMATE, matched.trajectory, metres=10)
    assert relative is not None and relative.position.max < 0.01
    said = " ".join(matched.notes)
    assert "clock" in said and "lever arm" in said and "axes" in said


def test_without_its_lever_arm_the_antenna_is_distinguished_from_the_imu(gnss: Path) -> None:
    with pytest.raises(HemislamError, match="lever arm"):
        read_truth(str(gnss), lever=(float("inf"), 0.0, 0.0))
    matched = match(read_truth(str(gnss), lever=(0.0, 0.0, 0.0)), ESTIMATE)
    assert 0.1 < ate(ESTIMATE, matched.trajectory).position.max < 0.6  # 0.45 m of arm, turned about


@pytest.mark.parametrize("offset_s", [-33.333, 0.0, 4.567])
def test_the_offset_of_two_clocks_is_found_from_the_motion(offset_s: float) -> None:
    truth = walks.wandering(np.arange(-15.0, 90.0, 0.01))
    shifted = Trajectory(truth.stamps_ns - round(offset_s * 1e9), truth.positions, truth.quaternions)
    for by_rotation in (True, False):
        found_s, correlation = find_offset(ESTIMATE, shifted, by_rotation=by_rotation)
        assert found_s == pytest.approx(offset_s, abs=0.005)
        assert correlation > 0.99


def test_the_truth_of_another_walk_has_no_offset() -> None:
    rng = np.random.default_rng(0)
    stamps = walks.START_NS + np.arange(8000) * 10_000_000
    turning = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.02, size=(8000, 3)), axis=0) * [0, 0, 1])
    other = Trajectory(stamps, rng.normal(size=(8000, 3)).cumsum(axis=0) * 0.01, turning.as_quat())
    with pytest.raises(HemislamError, match="matches that of the recording at no offset"):
        find_offset(ESTIMATE, other, by_rotation=True)


def kitti_lines(walk: Trajectory) -> list[str]:
    rows = np.concatenate([walk.rotations.as_matrix(), walk.positions[:, :, None]], axis=2).reshape(-1, 12)
    return [" ".join(f"{value:.9e}" for value in row) for row in rows]


def test_kitti_poses_belong_to_frames_or_to_the_times_beside_them(tmp_path: Path) -> None:
    walk = walks.wandering(walks.frames())
    path = walks.write(tmp_path / "00.txt", kitti_lines(walk))
    assert ate(ESTIMATE, match(read_truth(str(path)), ESTIMATE).trajectory).position.max < 1e-6
    with pytest.raises(HemislamError, match=r"holds 799 poses without times, but the recording 700 frames"):
        match(read_truth(str(path)), ESTIMATE.chosen(np.arange(len(ESTIMATE)) < 700))

    walks.write(tmp_path / "times.txt", [f"{t:.6f}" for t in (walk.stamps_ns - walk.stamps_ns[0]) * 1e-9])
    matched = match(read_truth(str(path)), ESTIMATE.chosen(np.arange(len(ESTIMATE)) < 700))
    assert matched.offset_s == pytest.approx(walks.START_NS * 1e-9 + 0.1, abs=0.002)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        (b"\xff\xfe\x00", "times.txt is not a text file; it holds one time per line"),
        (b"# s\n0.0 0\n0.1 1\n0.2 2\n", "line 2 has 2 columns, not 1"),
        (b"0.0\n0.1\n", "holds 2 times for 3 poses"),
        (b"1700000000000000000\n1700000000100000000\n1700000000200000000\n", "not in seconds"),
    ],
)
def test_malformed_times_beside_kitti_poses_are_refused(tmp_path: Path, times: bytes, says: str) -> None:
    path = walks.write(tmp_path / "poses.txt", ["1 0 0 0 0 1 0 0 0 0 1 0"] * 3)
    (tmp_path / "times.txt").write_bytes(times)
    with pytest.raises(HemislamError, match=says):
        read_truth(str(path))


def write_topic(path: Path, kind: str, messages: list[tuple[int, dict[str, object]]]) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/truth", kind, typestore=store)
        for stamp, values in messages:
            time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            header = types["std_msgs/msg/Header"](stamp=time, frame_id="map")
            writer.write(connection, stamp, store.serialize_cdr(types[kind](header=header, **values), kind))
    return path


def _stamped(types: Any, pose: Any) -> dict[str, Any]:
    return {"pose": pose}


def _with_covariance(types: Any, pose: Any) -> dict[str, Any]:
    return {"pose": types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))}


def _odometry(types: Any, pose: Any) -> dict[str, Any]:
    none = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=none, angular=none)
    still = types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return _with_covariance(types, pose) | {"child_frame_id": "body", "twist": still}


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("geometry_msgs/msg/PoseStamped", _stamped),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", _with_covariance),
        ("nav_msgs/msg/Odometry", _odometry),
    ],
)
def test_poses_of_a_topic_are_truth(tmp_path: Path, kind: str, values: Callable[[Any, Any], dict[str, Any]]) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE).types
    walk = walks.wandering(np.arange(0.0, 80.0, 0.05))
    body = (walk.rotations * walks.R_BODY_IMU.inv()).as_quat()
    messages = []
    for stamp, p, q in zip(walk.stamps_ns, walk.positions, body, strict=True):
        position = types["geometry_msgs/msg/Point"](*map(float, p))
        pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](*map(float, q)))
        messages.append((int(stamp), values(types, pose)))
    recording = write_topic(tmp_path / "rec", kind, messages)
    matched = match(read_truth("topic:/truth", recording), ESTIMATE)
    error = ate(ESTIMATE, matched.trajectory)
    assert error.position.max < 0.01 and error.rotation.max < 0.2
    with pytest.raises(HemislamError, match=r"no topic /odom to take as truth; it has /truth\."):
        read_truth("topic:/odom", recording)


def test_a_topic_whose_orientation_is_not_known_once_is_refused(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE).types
    messages = []
    for k in range(5):
        turn = types["geometry_msgs/msg/Quaternion"](float("nan") if k == 3 else 0.0, 0.0, 0.0, 1.0)
        pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](0.1 * k, 0.0, 0.0), turn)
        messages.append((walks.START_NS + k * 100_000_000, _stamped(types, pose)))
    recording = write_topic(tmp_path / "rec", "geometry_msgs/msg/PoseStamped", messages)
    with pytest.raises(HemislamError, match="not unit quaternions"):
        read_truth("topic:/truth", recording)


def test_satellite_fixes_are_metres_east_north_up(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_HUMBLE).types
    walk = walks.wandering(np.arange(0.0, 80.0, 0.5))
    # An independent way onto the ellipsoid: radii of curvature at the start, good to millimetres over 100 m.
    latitude, longitude = np.radians(30.5388466765), np.radians(114.3526809197)
    a, e2 = 6_378_137.0, 0.00669437999014
    meridian = a * (1 - e2) / (1 - e2 * np.sin(latitude) ** 2) ** 1.5
    vertical = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    messages = []
    for stamp, (x, y, z) in zip(walk.stamps_ns, walk.positions, strict=True):
        fix = {
            "status": types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
            "latitude": float(np.degrees(latitude + y / meridian)),
            "longitude": float(np.degrees(longitude + x / (vertical * np.cos(latitude)))),
            "altitude": float(20.0 + z),
            "position_covariance": np.zeros(9),
            "position_covariance_type": 0,
        }
        messages.append((int(stamp), fix))
    recording = write_topic(tmp_path / "rec", "sensor_msgs/msg/NavSatFix", messages)
    truth = read_truth("topic:/truth", recording)
    np.testing.assert_allclose(truth.positions, walk.positions - walk.positions[0], atol=0.01)
    matched = match(truth, ESTIMATE)
    assert not matched.has_rotation
    assert ate(ESTIMATE, matched.trajectory).position.max < 0.06  # chords of half a second


def test_a_device_that_sways_between_fixes_has_no_error_of_motion_by_that() -> None:
    """Its orientations are known only from the estimate, ten times a second, and the fixes come twice a second."""
    seconds = walks.frames()
    walk = walks.wandering(seconds)
    sway = Rotation.from_rotvec(0.15 * np.sin(9.0 * seconds)[:, None] * [1.0, 0.0, 0.0])
    estimate = seen_elsewhere(Trajectory(walk.stamps_ns, walk.positions, (walk.rotations * sway).as_quat()))
    fixes = walk.chosen(np.arange(0, len(walk), 5))
    matched = match(TruePoses("fixes", "fixes", fixes.stamps_ns, fixes.positions, None), estimate)
    found = rpe(estimate, matched.trajectory, metres=20.0)
    assert found is not None and found.position.max < 0.1


def test_a_truth_in_the_imus_axes_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    write_tum(path, walks.wandering(walks.frames()))
    matched = match(read_truth(str(path)), ESTIMATE)
    assert matched.notes == () and matched.offset_s == 0.0
    assert ate(ESTIMATE, matched.trajectory).position.max < 1e-6


def test_axes_that_a_straight_walk_does_not_determine_are_not_guessed() -> None:
    """Motion is compared nevertheless: guessed axes would bring along a roll about the way of any size."""
    seconds, rng = walks.frames(20.0), np.random.default_rng(3)
    walk = walks.wandering(seconds)
    way = np.column_stack([seconds, 0 * seconds, 0 * seconds])
    at, true_at = (way + rng.normal(scale=scale, size=way.shape) for scale in (0.003, 0.001))
    estimate = seen_elsewhere(Trajectory(walk.stamps_ns, at, walk.quaternions))
    body = (walk.rotations * walks.R_BODY_IMU.inv()).as_quat()
    matched = match(TruePoses("The truth", "odometry", walk.stamps_ns, true_at, body, own_axes=True), estimate)
    assert not matched.has_rotation
    assert any("does not determine the rotation between them" in note for note in matched.notes)
    moved = rpe(estimate, matched.trajectory, metres=1)
    assert moved is not None and moved.position.max < 0.03


GOOD = "1700000000.{} {} 0 0 0 0 0 1"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([], "holds no poses"),
        (["1 2 3"], "line 1 has 3 columns; TUM has 8 columns"),
        (["1 0 0 0 0 1 0 0 0 0 1", "x"], "line 1 has 11 columns"),
        (["1 0 0 0 0 1 0 0 0 0 1 0"], "holds 1 poses; at least 3"),
        (["1 0 0 0 0 1 0 0 0 0 1 0", "1 0 0"], "line 2 has 3 columns, not 12"),
        (["1 0 0 0 0 1 0 0 0 0 nan 0"] * 3, "line 1 holds NaN"),
        (["2 0 0 0 0 1 0 0 0 0 1 0"] * 3, "pose 1: the left 3x3 of its 3x4 matrix is not a rotation"),
        (["-5 " + "0 " * 12] * 3, "not in seconds of the GPS week"),
        (
            [GOOD.format(k, k * 0.1 + (40.0 if k > 4 else 0.0)) for k in range(10)],
            "jumps by 40.1 m within 0.1 s, 0.4 s",
        ),
        ([f"{t} 0 0 0 0 0 0 0 0 0 0 0 0" for t in (5, 4, 6)], "Time does not increase at pose 2"),
    ],
)
def test_a_bad_truth_is_refused_in_one_sentence(tmp_path: Path, lines: list[str], says: str) -> None:
    path = walks.write(tmp_path / "truth.txt", lines)
    with pytest.raises(HemislamError, match=says.replace("(", r"\(")) as refused:
        read_truth(str(path))
    assert "\n" not in str(refused.value)


def test_a_truth_of_another_day_is_refused_before_anything_runs(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    write_tum(path, walks.wandering(walks.frames()))
    with pytest.raises(HemislamError, match=r"but the recording 1700086400\.0 s to 1700086460\.0 s"):
        check_overlap(read_truth(str(path)), walks.START_NS + 86_400_000_000_000, 60.0)
