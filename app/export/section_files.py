"""Sections and profiles as PNG, SVG and DXF: chainage to the right, height up, both in metres at the same scale."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from app.export.paths import name_of, write_xml
from app.export.results import Results
from app.export.section import Slab

GROUND, OTHER = "#0f8f7a", "#20262e"
_GRID, _TEXT = "#c9d0d8", "#4a5560"
_MARGIN: Final = (90, 40, 40, 60)
"""Margins for numbers at the left, top, right and bottom of a picture, pixels."""
_APART: Final = 90, 25
"""Least distances between two numbers, horizontally and vertically, pixels."""
_MM: Final = 10.0
"""Millimetres in an SVG per metre: scale 1:100."""


def write_png(path: Path, results: Results, section: Slab) -> None:
    """Draw a pixel for each cell, darker with more points; ground in green."""
    rows, columns = section.points.shape
    left, top, right, bottom = _MARGIN
    picture = Image.new("RGB", (left + columns + right, top + rows + bottom), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(14)
    steps = [_step(apart * section.cell) for apart in _APART]

    def pixel(chainage: float, height: float) -> tuple[float, float]:
        x, y = (np.array([chainage, height]) - section.origin) / section.cell
        return left + x, top + rows - y

    for at in _ticks(section, 0, steps[0]):
        x, _ = pixel(at, 0)
        draw.line((x, top, x, top + rows), _GRID)
        draw.text((x, top + rows + 8), f"{at:g}", _TEXT, font, anchor="mt")
    for at in _ticks(section, 1, steps[1]):
        _, y = pixel(0, at)
        draw.line((left, y, left + columns, y), _GRID)
        draw.text((left - 8, y), f"{at:g}", _TEXT, font, anchor="rm")
    draw.text((left, top - 12), _title(results), _TEXT, font, anchor="ls")
    draw.text((left, top + rows + 32), _caption(results), _TEXT, font, anchor="lt")
    black = max(4.0, float(np.percentile(section.points[section.points > 0], 90)))  # points in a black cell
    share = np.where(section.points > 0, 90 + 165 * np.minimum(section.points / black, 1.0), 0.0)
    is_ground = 2 * section.ground > section.points
    for colour, which in ((OTHER, ~is_ground), (GROUND, is_ground)):
        mask = Image.fromarray(np.flipud(np.where(which, share, 0)).astype(np.uint8))
        picture.paste(colour, (left, top), mask)
    picture.save(path, format="PNG")


def write_svg(path: Path, results: Results, section: Slab) -> None:
    """Draw at 1:100 over a grid: a dot for each non-empty cell, at the mean of its points to the millimetre."""
    (length, height), steps = section.size.tolist(), [_step(apart / 4 / _MM) for apart in _APART]
    size = length + 3.0, height + 2.5  # m, with the margins
    root = ElementTree.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "width": f"{size[0] * _MM:.2f}mm",
            "height": f"{size[1] * _MM:.2f}mm",
            "viewBox": f"{section.origin[0] - 2:.3f} {-section.origin[1] - height - 1:.3f} {size[0]:.3f} {size[1]:.3f}",
            "font-family": "sans-serif",
            "font-size": "0.28",
            "fill": _TEXT,
        },
    )
    x0, y0 = section.origin
    ElementTree.SubElement(root, "title").text = _title(results)
    lines = [f"M{at:g} {-y0:.3f}v{-height:.3f}" for at in _ticks(section, 0, steps[0])]
    lines += [f"M{x0:.3f} {-at:g}h{length:.3f}" for at in _ticks(section, 1, steps[1])]
    _path(root, "grid", lines, _GRID, 0.01)
    for at in _ticks(section, 0, steps[0]):
        _text(root, f"{at:g}", at, -y0 + 0.45, "middle")
    for at in _ticks(section, 1, steps[1]):
        _text(root, f"{at:g}", x0 - 0.15, -at + 0.1, "end")
    _text(root, _title(results), x0, -y0 - height - 0.4, "start")
    _text(root, f"{_caption(results)}; 1:100", x0, -y0 + 1.0, "start")
    places, is_ground = section.means()
    for name, colour, which in (("points", OTHER, ~is_ground), ("ground", GROUND, is_ground)):
        _path(root, name, [f"M{x:.3f} {-y:.3f}h0" for x, y in places[which].tolist()], colour, section.cell)
    write_xml(path, root)


def write_dxf(path: Path, results: Results, section: Slab) -> None:
    """Write a point for each non-empty cell, at the mean of its points, in metres: x is chainage, y height."""
    import ezdxf  # from the extra `plan`

    drawing: Any = ezdxf.new("R2010", units=6)
    space = drawing.modelspace()
    at, is_ground = section.means()
    for name, colour, which in (("points", 7, ~is_ground), ("ground", 3, is_ground)):
        drawing.layers.add(name, color=colour)
        for x, y in at[which].tolist():
            space.add_point((x, y), dxfattribs={"layer": name})
    with path.open("w", encoding="utf-8") as file:
        drawing.write(file)


def _title(results: Results) -> str:
    return name_of(results.info.recording)


def _caption(results: Results) -> str:
    above = f" ({results.where.height})" if results.where is not None else " in the map"
    return f"Chainage and height{above}, metres"


def _step(least: float) -> float:
    """The smallest value of 1, 2 or 5 times a power of ten that is not less than `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least * (1 - 1e-9))


def _ticks(section: Slab, axis: int, step: float) -> Iterator[float]:
    low = float(section.origin[axis])
    first, last = math.ceil(low / step - 1e-9), math.floor((low + section.size[axis]) / step + 1e-9)
    yield from (round(number * step, 6) for number in range(first, last + 1))


def _path(root: ElementTree.Element, name: str, parts: list[str], colour: str, width: float) -> None:
    style = {"id": name, "d": "".join(parts), "stroke": colour, "stroke-width": f"{width:g}", "fill": "none"}
    ElementTree.SubElement(root, "path", style | {"stroke-linecap": "round"})


def _text(root: ElementTree.Element, text: str, x: float, y: float, anchor: str) -> None:
    ElementTree.SubElement(root, "text", {"x": f"{x:.3f}", "y": f"{y:.3f}", "text-anchor": anchor}).text = text
