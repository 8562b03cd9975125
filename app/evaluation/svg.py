"""Small charts as inline SVG and images as inline PNG, so that a report is one file."""

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from app.slam.types import F64, U16

PALETTE = ("#2563eb", "#ea580c", "#16a34a", "#9333ea", "#dc2626", "#0891b2", "#ca8a04", "#db2777")
TRUTH = "#111827"
_MOST_POINTS = 700
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 14, 12, 40


@dataclass(frozen=True, slots=True)
class Line:
    """Attributes:
    name, colour: of the line. x, y: (n,). dashed, wide: how it is drawn.
    """

    name: str
    colour: str
    x: F64
    y: F64
    dashed: bool = False
    wide: float = 1.6


def chart(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    equal: bool = False,
    from_zero: bool = False,
    width: int = 560,
    height: int = 300,
) -> str:
    """Lines over axes. `equal`: the same scale on both, as for a map."""
    x0, x1 = _range([line.x for line in lines], from_zero=False)
    y0, y1 = _range([line.y for line in lines], from_zero=from_zero)
    inner_w, inner_h = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM
    if equal:
        scale = max((x1 - x0) / inner_w, (y1 - y0) / inner_h)
        x0, x1 = (x0 + x1 - scale * inner_w) / 2, (x0 + x1 + scale * inner_w) / 2
        y0, y1 = (y0 + y1 - scale * inner_h) / 2, (y0 + y1 + scale * inner_h) / 2

    def at_x(x: F64) -> F64:
        return np.asarray(_LEFT + (x - x0) / (x1 - x0) * inner_w)

    def at_y(y: F64) -> F64:
        return np.asarray(_TOP + inner_h - (y - y0) / (y1 - y0) * inner_h)

    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" class="chart">']
    for value in _ticks(x0, x1, 7):
        px = float(at_x(np.array(value)))
        parts.append(f'<line x1="{px:.1f}" x2="{px:.1f}" y1="{_TOP}" y2="{_TOP + inner_h}" class="grid"/>')
        parts.append(f'<text x="{px:.1f}" y="{_TOP + inner_h + 15}" text-anchor="middle">{value:g}</text>')
    for value in _ticks(y0, y1, 5):
        py = float(at_y(np.array(value)))
        parts.append(f'<line x1="{_LEFT}" x2="{width - _RIGHT}" y1="{py:.1f}" y2="{py:.1f}" class="grid"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{py + 3.5:.1f}" text-anchor="end">{value:g}</text>')
    for line in lines:
        step = max(1, len(line.x) // _MOST_POINTS)
        chosen = np.unique(np.r_[np.arange(0, len(line.x), step), len(line.x) - 1])
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(at_x(line.x[chosen]), at_y(line.y[chosen]), strict=True))
        dash = ' stroke-dasharray="5 4"' if line.dashed else ""
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{line.colour}" stroke-width="{line.wide}"'
            f' stroke-linejoin="round"{dash}><title>{escape(line.name)}</title></polyline>'
        )
    parts.append(
        f'<text x="{_LEFT + inner_w / 2}" y="{height - 6}" text-anchor="middle" class="axis">{escape(x_label)}</text>'
    )
    parts.append(
        f'<text transform="translate(12 {_TOP + inner_h / 2}) rotate(-90)" text-anchor="middle"'
        f' class="axis">{escape(y_label)}</text></svg>'
    )
    return "".join(parts)


def histogram(name: str, colour: str, values: F64, edges: F64) -> Line:
    """The outline of a histogram, as shares in per cent."""
    counts = np.histogram(values, edges)[0] * (100 / max(len(values), 1))
    return Line(name, colour, np.repeat(edges, 2), np.r_[0.0, np.repeat(counts, 2), 0.0])


def stacked(rows: Sequence[tuple[str, Sequence[float]]], parts: Sequence[str], unit: str, width: int = 560) -> str:
    """Horizontal bars, one a row, of several parts each."""
    longest = max((sum(values) for _, values in rows), default=0.0) or 1.0
    left, bar = 110, 22
    scale = (width - left - 60) / longest
    drawn = [f'<svg viewBox="0 0 {width} {len(rows) * (bar + 8) + 4}" role="img" class="chart">']
    for index, (name, values) in enumerate(rows):
        y, x = index * (bar + 8) + 4, float(left)
        drawn.append(f'<text x="{left - 8}" y="{y + 15}" text-anchor="end">{escape(name)}</text>')
        for part, value, colour in zip(parts, values, PALETTE, strict=False):
            drawn.append(
                f'<rect x="{x:.1f}" y="{y}" width="{max(value * scale, 0):.1f}" height="{bar}" fill="{colour}"'
                f' fill-opacity="0.8"><title>{escape(part)} {value:.2f} {unit}</title></rect>'
            )
            x += value * scale
        drawn.append(f'<text x="{x + 6:.1f}" y="{y + 15}">{sum(values):.2f} {unit}</text>')
    return "".join(drawn) + "</svg>"


def legend(entries: Sequence[tuple[str, str]]) -> str:
    marks = "".join(f'<span><i style="background:{colour}"></i>{escape(name)}</span>' for name, colour in entries)
    return f'<div class="legend">{marks}</div>'


def density_image(counts: U16, brightest: float) -> str:
    """Points per pixel as an image tag, dark to bright on a logarithmic scale up to `brightest`."""
    level = np.log1p(counts.astype(np.float64)) / np.log1p(max(brightest, 1.0))
    level = np.where(counts > 0, 0.25 + 0.75 * level, 0.0)  # a single point is seen too
    pixels = np.rint(255 * level.clip(0, 1)).astype(np.uint8)
    ramp = np.linspace(0, 1, 256)[:, None]
    stops = np.array([[13, 17, 33], [46, 69, 140], [72, 166, 180], [190, 227, 150], [255, 255, 240]])
    palette = np.column_stack([np.interp(ramp[:, 0], np.linspace(0, 1, 5), stops[:, k]) for k in range(3)])
    data = base64.b64encode(_png(pixels, np.rint(palette).astype(np.uint8))).decode()
    return f'<img src="data:image/png;base64,{data}" alt="map from above">'


def _png(pixels: np.ndarray, palette: np.ndarray) -> bytes:
    """An 8-bit PNG with a palette (256, 3)."""
    height, width = pixels.shape
    rows = np.zeros((height, width + 1), np.uint8)  # each row begins with its filter: none
    rows[:, 1:] = pixels

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"PLTE", palette.tobytes())
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
        + chunk(b"IEND", b"")
    )


def _range(values: Sequence[F64], *, from_zero: bool) -> tuple[float, float]:
    joined = np.concatenate([*values]) if len(values) else np.zeros(1)
    low, high = (0.0 if from_zero else float(joined.min())), float(joined.max())
    room = 0.04 * (high - low) or 1.0
    return (low if from_zero else low - room), high + room


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers, about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(next(m * power for m in (1, 2, 5, 10) if m * power >= raw))
    return [round(value, 10) + 0.0 for value in np.arange(np.ceil(low / step) * step, high + step * 1e-6, step)]
