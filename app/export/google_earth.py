"""KMZ for Google Earth: the trajectory, the map from above on the ground, and the keyframes with their times."""

import io
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from app.export.paths import name_of, utc_text
from app.export.raster import Raster
from app.export.results import Results

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
GROUND, REST = (150, 190, 220), (255, 140, 40)
"""Colours of cells that contain only ground, and of all other cells."""


def write(path: Path, results: Results) -> None:
    """Everything is placed on Google Earth's ground, since its heights do not match those of a survey."""
    raster = results.coarse_raster
    ElementTree.register_namespace("", KML)
    ElementTree.register_namespace("gx", GX)
    text = ElementTree.tostring(_document(results, raster), encoding="utf-8", xml_declaration=True)
    picture = io.BytesIO()
    Image.fromarray(np.flipud(_picture(raster)), "RGBA").save(picture, format="PNG")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in (("doc.kml", text), ("map.png", picture.getvalue())):
            file.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)


def _document(results: Results, raster: Raster) -> ElementTree.Element:
    assert results.where is not None
    root = ElementTree.Element(f"{{{KML}}}kml")
    document = _add(root, "Document")
    _add(document, "name", name_of(results.info.recording))
    style = _add(document, "Style", id="walk")
    line = _add(style, "LineStyle")
    _add(line, "color", "ff2828ff")  # alpha, blue, green, red
    _add(line, "width", "3")
    overlay = _add(document, "GroundOverlay")
    _add(overlay, "name", "Map from above")
    _add(overlay, "color", "d0ffffff")
    _add(_add(overlay, "Icon"), "href", "map.png")
    quad = ElementTree.SubElement(overlay, f"{{{GX}}}LatLonQuad")
    _add(quad, "coordinates", _corners(results, raster))
    walk = _add(document, "Placemark")
    _add(walk, "name", "Walk")
    _add(walk, "styleUrl", "#walk")
    path = _add(walk, "LineString")
    _add(path, "tessellate", "1")
    _add(path, "coordinates", _places(results, results.trajectory.positions))
    folder = _add(document, "Folder")
    _add(folder, "name", "Keyframes")
    _add(folder, "visibility", "0")
    for block in results.still_blocks():
        mark = _add(folder, "Placemark")
        _add(mark, "name", str(block.keyframe))
        _add(mark, "visibility", "0")
        _add(_add(mark, "TimeStamp"), "when", utc_text(block.stamp_ns))
        _add(_add(mark, "Point"), "coordinates", _places(results, block.T_map_lidar[None, :3, 3]))
    return root


def _add(parent: ElementTree.Element, name: str, text: str | None = None, **attributes: str) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, f"{{{KML}}}{name}", attributes)
    element.text = text
    return element


def _places(results: Results, points: Any) -> str:
    """`longitude,latitude,height` of points (n, 3) m in the map."""
    assert results.where is not None
    return " ".join(f"{lon:.9f},{lat:.9f},{height:.3f}" for lat, lon, height in results.where.to_geographic(points))


def _corners(results: Results, raster: Raster) -> str:
    """Corners of the picture, anticlockwise from the lower left."""
    assert results.where is not None
    rows, columns = raster.points.shape
    east, north = raster.cell * columns, raster.cell * rows
    corners = np.array([[0, 0, 0], [east, 0, 0], [east, north, 0], [0, north, 0]]) + raster.origin
    return _places(results, results.where.from_crs(corners))


def _picture(raster: Raster) -> np.ndarray:
    """(rows, columns, 4) uint8, transparent where nothing was seen, and more opaque where there are more points."""
    rgba = np.zeros((*raster.points.shape, 4), np.uint8)
    rgba[..., :3] = np.where((raster.points > raster.ground)[..., None], REST, GROUND)
    often = np.log1p(raster.points / max(1.0, float(np.median(raster.points[raster.points > 0]))))
    rgba[..., 3] = np.where(raster.points > 0, 90 + 165 * np.clip(often / np.log(3), 0, 1), 0)
    return rgba
