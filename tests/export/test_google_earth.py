"""A KMZ as Google Earth reads it: valid by the schema of KML 2.2, and at positions that pyproj confirms."""

import importlib
import importlib.resources
import io
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
from PIL import Image
from test_las import UTM
from test_plan import room

from app.export.exports import of_formats, save_results
from app.slam.errors import HemislamError

KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"


def places(element: ElementTree.Element | None) -> np.ndarray:
    """(n, 2) eastings and northings of `coordinates`."""
    assert element is not None and element.text
    read = np.array([[float(number) for number in place.split(",")] for place in element.text.split()])
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    return np.column_stack(to_utm.transform(read[:, 0], read[:, 1]))


def test_walk_picture_and_keyframes_lie_where_they_are(tmp_path: Path) -> None:
    results = room(UTM)
    save_results(tmp_path, results, of_formats(["kmz"]))
    with zipfile.ZipFile(tmp_path / "map.kmz") as file:
        assert file.namelist() == ["doc.kml", "map.png"], "doc.kml comes first"
        root = ElementTree.fromstring(file.read("doc.kml"))
        picture = np.asarray(Image.open(io.BytesIO(file.read("map.png"))))
    expected = UTM.to_crs(results.trajectory.positions)[:, :2]
    np.testing.assert_allclose(places(root.find(f".//{KML}LineString/{KML}coordinates")), expected, atol=1e-3)
    sensor = UTM.to_crs(next(results.blocks()).T_map_lidar[None, :3, 3])[:, :2]
    np.testing.assert_allclose(places(root.find(f".//{KML}Point/{KML}coordinates")), sensor, atol=1e-3)
    assert root.findtext(f".//{KML}TimeStamp/{KML}when") == "2023-11-14T22:13:20.150Z"
    lower_left, lower_right, upper_right, _ = places(root.find(f".//{GX}LatLonQuad/{KML}coordinates"))
    assert lower_right[0] > lower_left[0] and upper_right[1] > lower_right[1]
    corner = UTM.to_crs(np.array([[-3.0, -2.0, 0.0]]))[0, :2]
    column, row = ((corner - lower_left) / (upper_right - lower_left) * picture.shape[1::-1]).astype(int)
    assert picture[::-1][row, column, 3] > 100 and picture[0, 0, 3] == 0, "walls show, the outside is transparent"


def test_the_document_is_valid_kml(tmp_path: Path) -> None:
    """By the schemas of OGC KML 2.2 and of Google's extensions to it, which pykml carries."""
    save_results(tmp_path, room(UTM), of_formats(["kmz"]))
    etree: Any = importlib.import_module("lxml.etree")
    with importlib.resources.as_file(importlib.resources.files("pykml") / "schemas") as schemas:
        schema = etree.XMLSchema(etree.parse(str(schemas / "kml22gx.xsd")))
    with zipfile.ZipFile(tmp_path / "map.kmz") as file:
        document = etree.fromstring(file.read("doc.kml"))
    schema.assertValid(document)
    placemark = document.find(f".//{KML}Placemark")
    placemark.append(placemark.find(f"{KML}name"))  # it must come first
    assert not schema.validate(document)


def test_a_kmz_needs_a_place(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"map\.kmz needs a georeferenced map"):
        save_results(tmp_path, room(), of_formats(["kmz"]))
