"""E57, PCD and trajectories as other programs read them.

Tests app/export/e57.py, app/export/paths.py, and the PCD output of app/export/map_file.py.
"""

import csv
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pye57
import pyproj
import pytest
from evo.tools import file_interface
from pypcd4 import PointCloud
from test_las import UTM, room
from test_plan import room as plan_room

from app.export import exports
from app.export.exports import of_formats, save_results
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.run_log import RunInfo
from app.slam.types import MOVING


@pytest.mark.parametrize("where", [None, UTM])
def test_e57_has_a_scan_with_its_pose_for_each_keyframe(tmp_path: Path, where: GeoReference | None) -> None:
    results = room(where)
    for one in results.keyframes:
        one.cloud.offsets_ns[:] = np.roll(one.cloud.offsets_ns, 100)  # rows are not in the order of time
    save_results(tmp_path, results, of_formats(["e57"]))
    file = pye57.E57(str(tmp_path / "map.e57"))
    assert file.scan_count == len(results.keyframes)
    for index, block in enumerate(results.blocks()):
        read = file.read_scan(index, intensity=True, ignore_missing_fields=True)
        points = np.stack([read[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
        sensor = block.T_map_lidar[None, :3, 3]
        expected, place = (
            (block.points, sensor) if where is None else (where.to_crs(block.points), where.to_crs(sensor))
        )
        np.testing.assert_allclose(points, expected, atol=1e-3)
        np.testing.assert_allclose(file.get_header(index).translation, place[0], atol=1e-9)
        np.testing.assert_array_equal(read["intensity"], block.intensity)
        times = [file.get_header(index)[f"acquisition{name}"]["dateTimeValue"].value() for name in ("Start", "End")]
        assert np.array(times) + 315_964_800 - 18 == pytest.approx(
            [block.stamps_ns.min() * 1e-9, block.stamps_ns.max() * 1e-9], abs=1e-5, rel=0
        )
    wkt = file.root["coordinateMetadata"].value()
    assert not wkt if where is None else pyproj.CRS(wkt).equals(pyproj.CRS(where.crs).to_3d())
    file.close()


def test_pcd_holds_every_point_with_ring_and_time(tmp_path: Path) -> None:
    results = room()
    save_results(tmp_path, results, of_formats(["pcd"]))
    cloud = PointCloud.from_path(tmp_path / "map.pcd")
    blocks = list(results.blocks())
    np.testing.assert_allclose(cloud.numpy(("x", "y", "z")), np.concatenate([b.points for b in blocks]), atol=1e-4)
    np.testing.assert_array_equal(cloud.pc_data["ring"], np.concatenate([b.ring for b in blocks]))
    np.testing.assert_allclose(cloud.pc_data["time"], np.concatenate([b.stamps_ns for b in blocks]) * 1e-9, atol=1e-6)


def test_evo_reads_the_same_trajectory_from_tum_and_kitti(tmp_path: Path) -> None:
    save_results(tmp_path, room(), of_formats(["tum", "kitti"]))
    tum = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "trajectory.kitti")
    assert tum.num_poses == kitti.num_poses == 6
    np.testing.assert_allclose(tum.poses_se3, kitti.poses_se3, atol=1e-8)


def test_csv_and_gpx_place_the_walk_on_earth(tmp_path: Path) -> None:
    results = room(UTM)
    save_results(tmp_path, results, of_formats(["csv", "gpx"]))
    with (tmp_path / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    read = np.array([[float(row[f"{name}_m"]) for name in ("easting", "northing", "height")] for row in rows])
    np.testing.assert_allclose(read, UTM.to_crs(results.trajectory.positions), atol=1e-3)
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    points = ElementTree.parse(tmp_path / "trajectory.gpx").findall(".//{http://www.topografix.com/GPX/1/1}trkpt")
    places = np.array([[float(point.get(name, "nan")) for point in points] for name in ("lon", "lat")])
    from_gpx = np.column_stack(to_utm.transform(*places))
    np.testing.assert_allclose(from_gpx, read[:, :2], atol=1e-3)
    assert points[0][1].text == "2023-11-14T22:13:20.150Z"


def test_a_map_without_a_place_gives_no_gpx(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"trajectory\.gpx needs a georeferenced map"):
        save_results(tmp_path, room(), of_formats(["gpx"]))
    save_results(tmp_path, room(), of_formats(["csv"]))
    assert (tmp_path / "trajectory.csv").read_text().startswith("stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n")


def test_a_recording_whose_name_is_no_utf_8_is_delivered(tmp_path: Path) -> None:
    results = plan_room(UTM)
    results.info = RunInfo(Path("w\udce4lk.mcap"), Params())
    save_results(tmp_path, results, of_formats(["gpx", "kmz", "html"]))
    assert "<name>w\\udce4lk</name>" in (tmp_path / "trajectory.gpx").read_text()
    assert "<title>w\\udce4lk</title>" in (tmp_path / "share.html").read_text()


def test_a_page_without_any_point_still_shows_the_walk(tmp_path: Path) -> None:
    results = plan_room()
    results.keyframes[0].cloud.labels[:] = MOVING
    save_results(tmp_path, results, of_formats(["html"]))
    assert "<br>0 points · " in (tmp_path / "share.html").read_text()


def test_what_is_not_installed_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(exports.EXTRAS, "e57", ("no_such_module",))
    with pytest.raises(HemislamError, match=r"pip install 'hemislam\[e57\]'"):
        of_formats(["e57"])


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("kind", ["las", "laz", "e57", "pcd", "ply", "terrain", "html"])
def test_a_full_disk_leaves_the_older_file_and_is_said_in_a_sentence(tmp_path: Path, kind: str) -> None:
    (export,) = of_formats([kind])
    older = tmp_path / export.name
    older.write_bytes(b"older")
    (tmp_path / f".{export.name}.part").symlink_to("/dev/full")
    with pytest.raises(HemislamError, match="cannot be written to"):
        save_results(tmp_path, room(UTM), [export], replace=True)
    assert [path.name for path in tmp_path.iterdir()] == [export.name] and older.read_bytes() == b"older"
