"""The coordinate system for a place. Oracle: the areas of use stated by EPSG."""

import math

import pyproj
import pytest

from app.georeference import crs
from app.slam.errors import HemislamError

PLACES = [
    (48.14, 11.58),
    (60.39, 5.32),
    (78.22, 15.65),
    (-33.86, 151.21),
    (30.54, 114.35),
    (0.01, -179.9),
    (85.0, 10.0),
]


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
def test_the_proposed_grid_is_made_for_its_place(latitude: float, longitude: float) -> None:
    name = crs.utm(latitude, longitude)
    area = pyproj.CRS(name).area_of_use
    assert area is not None and area.south <= latitude <= area.north
    assert area.west <= longitude <= area.east or (latitude, longitude) in PLACES[1:3]  # the exceptions of Norway
    crs.check_place(name, latitude, longitude)


def test_a_grid_of_the_other_side_of_the_earth_is_refused_and_the_right_one_named() -> None:
    with pytest.raises(HemislamError, match=r"is not made for latitude 48.1400°.* EPSG:32632 is"):
        crs.check_place("EPSG:32756", 48.14, 11.58)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("EPSG:1", "names no"),
        ("Mars", "names no"),
        ("EPSG:4326", "not a plane"),
        ("EPSG:2263", "not in metres"),
        ("EPSG:2048", "counts towards the west"),
        ("EPSG:5513", "counts towards the west"),
        ("EPSG:2218", "counts towards the west"),
        ("EPSG:5555", "give EPSG:25832 and, as that of heights, EPSG:5783"),
    ],
)
def test_what_is_no_grid_in_metres_is_refused(name: str, words: str) -> None:
    with pytest.raises(HemislamError, match=words):
        crs.projected(name)


@pytest.mark.parametrize("name", ["EPSG:31467", "EPSG:2193", "EPSG:5514", "ESRI:102562", "EPSG:3052", "EPSG:32661"])
def test_a_grid_of_any_order_of_axes_has_its_first_axis_to_the_east_or_is_refused(name: str) -> None:
    """Oracle: a step to the north, and one to the east, by pyproj's own geodesic."""
    try:
        area = crs.projected(name).area_of_use
    except HemislamError:
        assert "west" in {axis.direction for axis in pyproj.CRS(name).axis_info}
        return
    assert area is not None
    longitude, latitude = (area.west + area.east) / 2, (area.south + area.north) / 2
    geod, to_grid = pyproj.Geod(ellps="WGS84"), crs.transformer(crs.WGS84, name)
    here = to_grid.transform(longitude, latitude)
    for azimuth, (east, north) in ((90.0, (100.0, 0.0)), (0.0, (0.0, 100.0))):
        there = to_grid.transform(*geod.fwd(longitude, latitude, azimuth, 100.0)[:2])
        moved = there[0] - here[0], there[1] - here[1]
        assert moved == pytest.approx((east, north), abs=20.0)


def test_utm_is_narrower_than_the_ground_in_the_middle_of_a_zone_and_at_height() -> None:
    assert crs.grid_scale("EPSG:32632", 48.0, 9.0, 0.0) == pytest.approx(0.9996, abs=1e-6)
    assert crs.grid_scale("EPSG:32632", 48.0, 9.0, 1000.0) == pytest.approx(0.9996 * (1 - 1.57e-4), abs=1e-6)


@pytest.mark.parametrize("name", ["EPSG:25832", "EPSG:31467", "EPSG:3035", "EPSG:3034"])
def test_a_grid_stretches_as_the_ellipse_of_its_distortion_says(name: str) -> None:
    """Oracle: the factors of PROJ."""
    factors = pyproj.Proj(pyproj.CRS(name)).get_factors(9.5, 48.0)
    told = factors.tissot_semimajor, factors.tissot_semiminor
    assert crs.stretches(name, 48.0, 9.5) == pytest.approx(told, rel=2e-5)  # the shift of its datum stretches it too


def test_web_mercator_stretches_by_the_radii_of_the_ellipsoid() -> None:
    """PROJ gives the factors of a sphere for it."""
    e2, sine, cosine = 0.00669437999, math.sin(math.radians(48.0)), math.cos(math.radians(48.0))
    across = math.sqrt(1 - e2 * sine**2) / cosine
    along = (1 - e2 * sine**2) ** 1.5 / (1 - e2) / cosine
    assert crs.stretches("EPSG:3857", 48.0, 11.0) == pytest.approx((along, across), rel=1e-8)


def test_a_grid_that_changes_the_shape_of_a_map_is_told() -> None:
    told = crs.distortion("EPSG:3857", 1_288_513.8, 6_129_650.0)
    assert "EPSG:3857 stretches lengths by 0.30 % more in one direction" in told and "EPSG:32632" in told
    assert crs.distortion("EPSG:32632", 691_561.7, 5_334_716.1) == ""


def test_heights_stand_in_the_text_of_a_coordinate_system() -> None:
    text = crs.wkt1("EPSG:32632", crs.ELLIPSOIDAL)
    assert text.startswith("COMPD_CS") and pyproj.CRS(text).equals(pyproj.CRS("EPSG:32632").to_3d())
    assert pyproj.CRS(crs.wkt1("EPSG:25832", "EPSG:7837")).equals(pyproj.CRS("EPSG:25832+7837"))
    assert pyproj.CRS(crs.wkt1("EPSG:32632", "above the door sill")).equals(pyproj.CRS("EPSG:32632"))


@pytest.mark.parametrize(
    ("height", "words"),
    [("EPSG:1", "names no"), ("EPSG:32632", "not one of heights"), ("EPSG:5715", "not one of heights")],
)
def test_what_is_no_system_of_heights_is_refused(height: str, words: str) -> None:
    with pytest.raises(HemislamError, match=words):
        crs.vertical(height)
