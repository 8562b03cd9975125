"""The position of a map on Earth. Oracle: pyproj's own geodesics, which do not use our grid arithmetic."""

from pathlib import Path

import numpy as np
import pyproj
import pytest

from app.georeference import reference
from app.georeference.reference import GeoReference
from app.slam import lie
from app.slam.errors import HemislamError

ORIGIN = (533843.632, 5379901.251, 317.899)


def reference_of(yaw_degrees: float, **more: object) -> GeoReference:
    rows = lie.from_rpy_degrees((0.0, 0.0, yaw_degrees)).tolist()
    return GeoReference("EPSG:32632", ORIGIN, tuple(map(tuple, rows)), **more)  # type: ignore[arg-type]


def test_a_step_ahead_of_a_map_turned_to_the_north_goes_north() -> None:
    east, north, height = reference_of(90.0).to_crs(np.array([[10.0, 0.0, 2.0]]))[0] - ORIGIN
    assert (east, north, height) == pytest.approx((0.0, 10.0, 2.0), abs=1e-8)


def test_a_web_mercator_map_in_the_far_north_is_read_as_written() -> None:
    where = GeoReference("EPSG:3857", ORIGIN, scale=reference.crs.grid_scale("EPSG:3857", 78.2, 15.6, 0.0))
    assert where.scale > 4 and GeoReference.from_json(where.to_json()) == where


def test_there_and_back_keeps_a_micrometre() -> None:
    points = np.random.default_rng(1).uniform(-500, 500, (100, 3))
    where = reference_of(33.0, scale=0.99961)
    np.testing.assert_allclose(where.from_crs(where.to_crs(points)), points, atol=1e-6)


def test_float32_points_get_coordinates_to_a_millimetre() -> None:
    points = np.array([[1.001, 2.002, 3.003]], np.float32)
    out = reference_of(0.0).to_crs(points)
    assert out.dtype == np.float64
    np.testing.assert_allclose(out[0] - ORIGIN, [1.001, 2.002, 3.003], atol=1e-5)


def test_a_hundred_metres_on_the_ground_are_a_hundred_metres_on_the_ellipsoid() -> None:
    scale = reference.crs.grid_scale("EPSG:32632", 48.57, 9.46, 0.0)
    ends = reference_of(20.0, scale=scale).to_geographic(np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]))
    (latitude, further), (longitude, away) = ends[:, 0], ends[:, 1]
    assert pyproj.Geod(ellps="WGS84").inv(longitude, latitude, away, further)[2] == pytest.approx(100.0, abs=1e-3)
    assert abs(scale - 1.0) > 3e-4  # without it, 3 cm would be missing


def test_a_georeference_is_read_from_its_file_as_it_was_written(tmp_path: Path) -> None:
    where = reference_of(12.3456789, scale=0.9996123, height="orthometric (EGM2008)")
    (tmp_path / reference.FILE).write_text(where.to_json())
    assert reference.read(tmp_path) == (where, "")
    assert reference.read(tmp_path / "nowhere") == (None, "")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "not a georeference"),
        ('{"crs": "EPSG:4326", "origin": [0, 0, 0]}', "not a plane grid"),
        ('{"crs": "EPSG:32632", "origin": [NaN, 0, 0]}', "not a georeference .*finite number"),
        ('{"crs": "EPSG:32632", "origin": [0, 0, 0], "scale": 0}', "not a georeference .*its numbers"),
        ('{"crs": "EPSG:32632", "origin": [0, 0, 0], "scale": NaN}', "not a georeference .*its numbers"),
        ('{"crs": "EPSG:32632", "origin": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}', "its numbers"),
    ],
)
def test_a_file_that_is_no_georeference_is_refused_in_one_sentence(text: str, words: str) -> None:
    with pytest.raises(HemislamError, match=words):
        GeoReference.from_json(text)


def test_the_coordinate_system_is_written_as_text_that_names_it() -> None:
    assert pyproj.CRS(reference_of(0.0).wkt1()).equals(pyproj.CRS("EPSG:32632").to_3d())
    assert pyproj.CRS(reference_of(0.0).raster_crs).to_epsg() == 32632  # GDAL loses a third axis in a GeoTIFF
    named = reference_of(0.0, height="EPSG:3855")
    assert pyproj.CRS(named.wkt1()).equals(pyproj.CRS(named.raster_crs)) and "3855" in named.wkt1()
