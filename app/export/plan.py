"""Plans: an occupancy grid for robots, a floor plan, and the terrain. North or the map's y is up."""

from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import numpy.typing as npt
import rasterio.features
from PIL import Image
from rasterio.io import MemoryFile
from rasterio.transform import from_origin
from scipy import ndimage

from app.export.raster import Raster
from app.export.results import Results

FREE, WALL, UNKNOWN = 254, 0, 205
"""Grey values that nav2's map_server expects."""
LEAST_POINTS = 3
"""Fewest points of a wall in a cell; fewer may be a person who walked past."""


def write_pgm(path: Path, results: Results) -> None:
    """Write a grid of walls, free cells (seen as ground) and unknown cells, in the map's frame."""
    raster = results.raster_in_map
    seen = raster.ground > 0
    free = seen | ndimage.binary_closing(seen, iterations=2)  # type: ignore[attr-defined]  # no types
    grey = np.where(free, FREE, UNKNOWN).astype(np.uint8)
    grey[raster.walls >= LEAST_POINTS] = WALL
    rows, columns = grey.shape
    path.write_bytes(f"P5\n{columns} {rows}\n255\n".encode("ascii") + np.flipud(grey).tobytes())


def write_yaml(path: Path, results: Results) -> None:
    """Write the file that nav2's map_server needs with the image."""
    raster = results.raster_in_map
    x, y = raster.origin[:2]
    path.write_text(
        f"image: occupancy.pgm\nmode: trinary\nresolution: {raster.cell:g}\norigin: [{x:.3f}, {y:.3f}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="ascii",
    )


def write_floor_png(path: Path, results: Results) -> None:
    """Write a horizontal slice, black on white; the more points, the darker."""
    cut = results.raster.cut
    grey = 255 - np.minimum(cut * 32, 255)
    Image.fromarray(np.flipud(grey).astype(np.uint8)).save(path, format="PNG")


def write_world_file(path: Path, results: Results) -> None:
    """Write the position of floor.png for GIS programs: size and rotation of a pixel, middle of the upper left one."""
    at = _transform(results.raster)
    numbers = (at.a, at.d, at.b, at.e, at.c + at.a / 2, at.f + at.e / 2)
    path.write_text("".join(f"{number:.4f}\n" for number in numbers), encoding="ascii")


def write_dxf(path: Path, results: Results) -> None:
    """Write the outlines of the slice, in metres, on the layer `walls`."""
    raster = results.raster
    walls = (np.flipud(raster.cut) >= LEAST_POINTS).astype(np.uint8)
    drawing: Any = ezdxf.new("R2010", units=6)
    drawing.layers.add("walls")
    space = drawing.modelspace()
    for shape, _ in rasterio.features.shapes(walls, mask=walls > 0, connectivity=8, transform=_transform(raster)):
        for ring in shape["coordinates"]:
            space.add_lwpolyline(ring[:-1], close=True, dxfattribs={"layer": "walls"})
    with path.open("w", encoding="utf-8") as file:
        drawing.write(file)


def write_terrain(path: Path, results: Results) -> None:
    """Write the mean height of the ground in each cell, m; NaN where no ground was seen."""
    raster = results.coarse_raster
    above = "" if results.where is None else f", {results.where.height}"
    _write_tiff(path, results, raster, raster.height, f"height of the ground, m{above}")


def write_density(path: Path, results: Results) -> None:
    """Write the number of points per square metre."""
    raster = results.coarse_raster
    _write_tiff(path, results, raster, (raster.points / raster.cell**2).astype(np.float32), "points per square metre")


def _write_tiff(path: Path, results: Results, raster: Raster, values: npt.NDArray[np.float32], what: str) -> None:
    rows, columns = values.shape
    memory = MemoryFile()  # GDAL does not report a failed disk
    with memory.open(
        driver="GTiff",
        height=rows,
        width=columns,
        count=1,
        dtype="float32",
        nodata=float("nan"),
        compress="deflate",
        transform=_transform(raster),
        crs=None if results.where is None else results.where.raster_crs,
    ) as file:
        file.set_band_description(1, what)
        file.write(np.flipud(values), 1)
    path.write_bytes(memory.read())


def _transform(raster: Raster) -> Any:
    """Convert columns and rows, counted from the north, to coordinates."""
    x, y = raster.origin[:2]
    return from_origin(x, y + raster.points.shape[0] * raster.cell, raster.cell, raster.cell)
