"""Plans of a room of known size, as rasterio, ezdxf, PIL and a YAML reader see them.

Tests app/export/plan.py, app/export/raster.py.
"""

from dataclasses import replace
from pathlib import Path

import ezdxf
import numpy as np
import pyproj
import pytest
import rasterio
import yaml
from PIL import Image
from test_las import UTM
from test_results import keyframe, logged

from app.export.box import Box
from app.export.exports import of_formats, save_results
from app.export.points import Choice
from app.export.results import Results
from app.georeference.reference import GeoReference
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.run_log import RunInfo
from app.slam.types import GROUND, MOVING, NON_GROUND

LOW, HIGH, FLOOR = (-3.0, -2.0), (3.0, 2.0), -1.2
"""m: where the walls and the floor of the room are."""


def room(where: GeoReference | None = None) -> Results:
    """A floor, four walls and a short one 2.5 m high, and a table of 0.7 m, a point every 2 cm."""
    x, y = np.meshgrid(np.arange(-2.99, 3, 0.02), np.arange(-1.99, 2, 0.02))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, FLOOR)])
    up = FLOOR + np.arange(0.02, 2.5, 0.02)
    walls = [np.array([(side, b, z) for b in np.arange(-1.99, 2, 0.02) for z in up]) for side in (LOW[0], HIGH[0])]
    walls += [np.array([(b, side, z) for b in np.arange(-2.99, 3, 0.02) for z in up]) for side in (LOW[1], HIGH[1])]
    walls += [np.array([(b, 1.02, z) for b in np.arange(-2.99, -1.5, 0.02) for z in up])]
    table = np.array([(a, b, FLOOR + 0.7) for a in np.arange(0, 1, 0.02) for b in np.arange(0, 0.5, 0.02)])
    points = np.vstack([floor, *walls, table])
    labels = [GROUND] * len(floor) + [NON_GROUND] * (len(points) - len(floor))
    one = keyframe(0, points.tolist(), labels)
    T = one.T_odom_imu @ one.T_imu_lidar
    one.cloud.points[:] = (points - T[:3, 3]) @ T[:3, :3]
    return Results(logged(), [one], RunInfo(Path("walk.mcap"), Params()), where=where)


def test_a_robot_finds_the_floor_free_and_the_walls_where_they_are(tmp_path: Path) -> None:
    save_results(tmp_path, room(), of_formats(["occupancy"]))
    about = yaml.safe_load((tmp_path / "occupancy.yaml").read_text())
    grid = np.flipud(np.asarray(Image.open(tmp_path / about["image"])))

    def at(x: float, y: float) -> int:
        column, row = ((np.array([x, y]) - about["origin"][:2]) / about["resolution"]).astype(int)
        return int(grid[row, column])

    assert at(-1.5, -1.0) == at(2.0, 1.5) == 254
    assert at(-3.0, 0.5) == at(3.0, -1.0) == at(1.0, 2.0) == 0, "walls"
    assert at(0.5, 0.25) == 0, "a table stands in the way"
    assert (grid == 205).any(), "outside nothing is known"


@pytest.mark.parametrize("where", [None, UTM])
def test_the_floor_plan_shows_walls_but_no_table(tmp_path: Path, where: GeoReference | None) -> None:
    save_results(tmp_path, room(where), of_formats(["floor", "dxf"]))
    drawing = ezdxf.readfile(tmp_path / "floor.dxf")
    corners = np.array([point for line in drawing.modelspace() for point in line.get_points("xy")])
    points = (
        corners if where is None else where.from_crs(np.column_stack([corners, np.full(len(corners), 312.0)]))[:, :2]
    )
    cell = 0.05 * 2**0.5 + 1e-6
    np.testing.assert_allclose(points.min(axis=0), LOW, atol=cell)
    np.testing.assert_allclose(points.max(axis=0), HIGH, atol=cell)
    assert not ((np.abs(points - [0.5, 0.25]) < 0.6).all(axis=1)).any()
    width, _, _, height, *first = map(float, (tmp_path / "floor.pgw").read_text().split())
    assert width == -height == 0.05
    picture = np.asarray(Image.open(tmp_path / "floor.png"))

    def darkest(x: float, y: float) -> int:
        """Of the pixels within 5 cm of a place in the map."""
        place = np.array([x, y]) if where is None else where.to_crs(np.array([[x, y, FLOOR]]))[0, :2]
        column, row = np.rint((place - first) / [width, height]).astype(int)
        return int(picture[row - 1 : row + 2, column - 1 : column + 2].min())

    assert darkest(-2.2, 1.02) < 100, "the short wall"
    assert darkest(2.2, 1.02) == darkest(-2.2, -1.02) == darkest(2.2, -1.02) == 255, "and not its mirror images"


def test_a_geotiff_names_the_system_of_its_heights(tmp_path: Path) -> None:
    save_results(tmp_path, room(replace(UTM, height="EPSG:3855")), of_formats(["terrain"]))
    with rasterio.open(tmp_path / "terrain.tif") as terrain:
        assert pyproj.CRS(terrain.crs.to_wkt()).equals(pyproj.CRS("EPSG:32632+3855"))


def test_geotiffs_give_height_and_density_in_the_coordinate_system(tmp_path: Path) -> None:
    save_results(tmp_path, room(UTM), of_formats(["terrain", "density"]))
    place = UTM.to_crs(np.array([[-1.5, -1.0, FLOOR]]))[0]
    with rasterio.open(tmp_path / "terrain.tif") as terrain, rasterio.open(tmp_path / "density.tif") as density:
        assert terrain.crs.to_epsg() == density.crs.to_epsg() == 32632
        assert terrain.descriptions == ("height of the ground, m, ellipsoidal",)
        assert next(terrain.sample([place[:2]]))[0] == pytest.approx(place[2], abs=1e-3)
        assert next(density.sample([place[:2]]))[0] == pytest.approx(1 / 0.02**2, rel=0.15)
        corner = (terrain.bounds.left + 0.1, terrain.bounds.bottom + 0.1)  # of the raster; the room stands aslant in it
        assert np.isnan(next(terrain.sample([corner]))[0]) and next(density.sample([corner]))[0] == 0
    with Image.open(tmp_path / "terrain.tif") as picture:  # by a reader that knows nothing of GDAL
        scale, tie, keys = (picture.tag_v2[tag] for tag in (33550, 33922, 34735))  # type: ignore[attr-defined]
        column, row = ((place[:2] - tie[3:5]) / [scale[0], -scale[1]]).astype(int)
        assert np.asarray(picture)[row, column] == pytest.approx(place[2], abs=1e-3)
    assert dict(zip(keys[4::4], keys[7::4], strict=True))[3072] == 32632


def test_a_plan_needs_ground_and_points(tmp_path: Path) -> None:
    results = room()
    results.keyframes[0].cloud.labels[:] = NON_GROUND
    with pytest.raises(HemislamError, match="No point of the map is ground"):
        save_results(tmp_path, results, of_formats(["terrain"]))
    results.choice = Choice(box=Box((90.0, 90, 90), (91, 91, 91)))
    with pytest.raises(HemislamError, match="no points in the box; choose another one"):
        save_results(tmp_path, results, of_formats(["terrain"]))


def test_a_person_who_walked_past_is_in_no_plan(tmp_path: Path) -> None:
    still = room()
    save_results(tmp_path, still, of_formats(["occupancy", "floor", "density"]))
    expected = {name: (tmp_path / name).read_bytes() for name in ("occupancy.pgm", "floor.png", "density.tif")}
    heights = FLOOR + np.arange(0.1, 1.8, 0.02)
    body = np.array([(x, y, z) for x in (-1.5, -1.4) for y in (-1.0, -0.9) for z in heights])
    passing = keyframe(1, body.tolist(), [MOVING] * len(body))
    T = passing.T_odom_imu @ passing.T_imu_lidar
    passing.cloud.points[:] = (body - T[:3, 3]) @ T[:3, :3]
    results = Results(logged(), [still.keyframes[0], passing], still.info)
    save_results(tmp_path, results, of_formats(["occupancy", "floor", "density"]), replace=True)
    assert {name: (tmp_path / name).read_bytes() for name in expected} == expected
