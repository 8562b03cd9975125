"""LAS and LAZ as laspy reads them: coordinates to a millimetre, time, classes and coordinate system intact."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from pypcd4 import PointCloud
from test_results import START_NS, keyframe, logged

from app.export.exports import of_formats, save_results
from app.export.points import Choice, blocks
from app.export.results import Results
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.run_log import RunInfo
from app.slam.types import GROUND, MOVING, NON_GROUND, SEED

UTM = GeoReference("EPSG:32632", (456_789.25, 5_432_100.5, 312.0), ((0.6, -0.8, 0), (0.8, 0.6, 0), (0, 0, 1)))


def room(where: GeoReference | None = None) -> Results:
    """Four keyframes of 500 points, 40 m around the origin."""
    rng = np.random.default_rng(5)
    keyframes = []
    for index in range(4):
        labels = rng.choice([GROUND, NON_GROUND], 500).tolist()
        one = keyframe(index, rng.uniform(-40, 40, (500, 3)).tolist(), labels)
        one.cloud.ring[:] = np.arange(500) % 32
        one.cloud.offsets_ns[:] = np.arange(500) * 200_000
        keyframes.append(one)
    return Results(logged(), keyframes, RunInfo(Path("walk.mcap"), Params()), where=where)


@pytest.mark.parametrize("kind", ["las", "laz"])
@pytest.mark.parametrize("where", [None, UTM])
def test_points_are_read_back_to_a_millimetre_with_all_they_have(
    tmp_path: Path, kind: str, where: GeoReference | None
) -> None:
    results = room(where)
    save_results(tmp_path, results, of_formats([kind]))
    las = laspy.read(tmp_path / f"map.{kind}")
    points = np.concatenate([block.points for block in blocks(results.keyframes, MapFrame(), Choice())])
    expected = points if where is None else where.to_crs(points)
    np.testing.assert_allclose(las.xyz, expected, atol=0.00051)
    np.testing.assert_allclose(
        [las.header.mins, las.header.maxs], [expected.min(axis=0), expected.max(axis=0)], atol=1e-3
    )
    cloud = [one.cloud for one in results.keyframes]
    assert las.user_data.tolist() == [ring for one in cloud for ring in one.ring]
    assert las.intensity.tolist() == [value for one in cloud for value in one.intensity]
    ground = np.concatenate([one.labels for one in cloud]) == GROUND
    assert np.array_equal(np.asarray(las.classification), np.where(ground, 2, 1))
    unix_s = np.asarray(las.gps_time) + 1e9 + 315_964_800 - 18
    begins = (START_NS - 499 * 200_000) * 1e-9
    np.testing.assert_allclose(unix_s[:500] - begins, np.arange(500) * 2e-4, atol=1e-6)
    crs = las.header.parse_crs()
    assert crs is None if where is None else pyproj.CRS("EPSG:32632").to_3d().equals(crs)


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_results(tmp_path / name, room(UTM), of_formats(["laz"]))
    assert (tmp_path / "a" / "map.laz").read_bytes() == (tmp_path / "b" / "map.laz").read_bytes()


def test_progress_ends_at_one_and_a_name_that_is_no_format_is_refused(tmp_path: Path) -> None:
    results, shares = room(), list[float]()
    results.progress = shares.append
    save_results(tmp_path, results, of_formats(["las", "laz"]))
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) == 8
    shares.clear()
    save_results(tmp_path, results, of_formats(["las", "html"]), replace=True)
    assert shares == sorted(shares) and shares[-1] == 1.0, "a page reads the points twice"
    with pytest.raises(HemislamError, match="no format lax; choose from tum"):
        of_formats(["laz", "lax"])


def test_what_moves_is_class_18_and_left_out_if_asked(tmp_path: Path) -> None:
    labels = [NON_GROUND, GROUND, SEED, MOVING]
    results = Results(
        logged(), [keyframe(0, [[k, 0, 0] for k in range(4)], labels)], RunInfo(Path("walk.mcap"), Params())
    )
    save_results(tmp_path, results, of_formats(["las", "pcd"]))
    assert laspy.read(tmp_path / "map.las").classification.tolist() == [1, 2, 2, 18]
    cloud = PointCloud.from_path(tmp_path / "map.pcd")
    assert cloud.pc_data["ground"].tolist() == [0, 1, 1, 0] and cloud.pc_data["moving"].tolist() == [0, 0, 0, 1]
    results.choice = Choice(moving=False)
    save_results(tmp_path, results, of_formats(["las"]), replace=True)
    assert laspy.read(tmp_path / "map.las").classification.tolist() == [1, 2, 2]
